"""Files, hashes, errors, progress and arithmetic that several packages need.

Read first: errors, fields (settings), files, numerics, then what you need: fingerprints (recipes of results), runtime
(progress, threads, devices), cluster, compiled_programs (on disk).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
