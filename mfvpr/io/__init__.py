"""Read, check and write features, global descriptors and shortlists of other programs.

Read first: features (the formats, and global descriptors), names (matches entries of a file to images), then the
readers: containers (arrays by image), pair_files (matches), object_files (MATLAB and pickles as data).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
