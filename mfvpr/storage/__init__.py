"""The cache of features and matches on disk, and the file of a map.

Read first: feature_cache (what is cached for a folder of images, by which recipe), cache_files (one file for each
image or query), maps (a map: one SQLite file).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
