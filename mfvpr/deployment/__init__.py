"""Compiled scores for programs in other languages: StableHLO, ONNX, and arrays to check them with.

Read first: programs (the functions that are exported), folders (the files of an export).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
