"""Published network weights: their sources, their conversion to runtime files, and networks with these weights.

Read first: published.yaml (files, sources and the network of each), networks (their entries), files (install, save,
load), keys.yaml and conversion (keys of checkpoints), checkpoint (readers).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
