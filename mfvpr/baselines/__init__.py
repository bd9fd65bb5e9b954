"""Scores of other systems, learned weights, and all scores and weights by name.

Read first: homography (with planes), then lost, phrases, rapid, grid_anchors; scorers and weight_registry have names.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
