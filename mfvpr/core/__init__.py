"""The paper's methods on arrays: matches of two images, their scores, grids of parameters, rankings, and recalls.

Read first: types, nearest_neighbors (one pair), scorer (the contract), aggregate (the shortest score), histogram,
anchor; then ranking (score, fuse, rank), grids (many parameter values), metrics. Parts: weights (of matches),
parameters (by dotted name), similarity and checked (products), shifts, lattice and tallest (histogram).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
