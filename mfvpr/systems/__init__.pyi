__all__ = [
    "assembly",
    "choices",
]

from . import assembly, choices
