"""Scores of other systems, learned weights, and all scores and weights by name.

Read first: homography, then spatial_scores and grid_anchors; `scorers` has names for all scores.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
