"""Read, check and write features, global descriptors and shortlists of other programs.

Read first: features (the formats, and global descriptors), then the readers: containers (arrays by image, and the names
of images), pair_files (matches), object_files (MATLAB and pickles as data).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
