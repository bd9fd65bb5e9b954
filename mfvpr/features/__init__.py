"""Images -> keypoints, descriptors and global descriptors.

Read first: extractor (the protocols), sift (the shortest extractor), network (what the extractors with a network
share, and their batches), then the others; vlad (global descriptors from local ones), feature_set (features on
demand), feature_extraction (folders of images, on threads).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
