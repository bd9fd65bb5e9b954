"""Read, check and write features, global descriptors and shortlists of other programs.

Read first: features and descriptors (the formats), names (matches entries of a file to images), then the readers:
containers (arrays by image), and formats/ (matches, and MATLAB files and pickles, read as data).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
