"""Files, hashes, errors, progress and arithmetic that several packages need.

Read first: errors, files, numerics, then what you need: fingerprints (recipes of results), arrays (their
files), progress, runtime, cluster, compiled_programs (on disk), threads, ragged (padding), whitening, versions.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
