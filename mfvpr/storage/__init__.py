"""The cache of features and matches on disk, and its file formats.

Read first: feature_cache (what is cached for a folder of images), rows (a store: one file per image), features,
matches, map_entries and maps (formats of rows), manifest (what a store belongs to).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
