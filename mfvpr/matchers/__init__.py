"""Matchers as values, and matches of many queries with their candidates.

Read first: matcher (nearest neighbors, LightGlue, soft matching), host_matcher; then match_set (matches of
shortlists, and of many queries).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
