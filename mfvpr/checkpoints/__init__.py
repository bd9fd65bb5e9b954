"""Published network weights: their sources, their conversion to runtime files, and networks with these weights.

Read first: networks (published files and the network of each), files (install, save, load), conversion (tables of
keys), checkpoint (readers).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
