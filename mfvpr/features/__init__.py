"""Images -> keypoints, descriptors and global descriptors.

Read first: extractor (the protocols, and folders of images), sift (the shortest extractor), network (what extractors
with a network share; global descriptors; keypoints), then patch_networks, ssm_features with whitening; vlad
(global descriptors from local ones), feature_set (features on demand).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
