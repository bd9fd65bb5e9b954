"""Compiled scores for programs in other languages: StableHLO, ONNX, and arrays to check them with.

Read first: folders (the files of an export), programs (the functions that are exported), program_formats.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
