"""Scores of all candidates of a query, their fusion, and the ranking.

Read first: ranking (score, fuse, rank), grids (whole grids of parameters), fusion (several scores as one),
batched_scoring (many queries), cohort_normalization, results.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
