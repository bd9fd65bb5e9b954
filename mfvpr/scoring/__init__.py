"""Scores of one pair of images from its matches alone: Matches -> a number.

Read first: scorer (the contract), aggregate (the shortest score), histogram, anchor, then the others; weights (of
matches), fields (units, bounds and choices of settings), registry (scores by name). Parts of scores: shifts, lattice
and tallest (histogram), planes (homography), parameters (by dotted name).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
