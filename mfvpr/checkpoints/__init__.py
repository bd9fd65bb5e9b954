"""Published network weights: where they are, their conversion to runtime files, and networks filled with them.

Read first: registry (what there is), files (install, save, load), conversion (layouts), networks (which network an
entry fills), then the readers: torch_files, numpy_files.

Imports io, networks, utils.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
