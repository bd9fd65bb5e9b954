__all__ = [
    "load_system",
    "main",
]

from .programs import main
from .systems import load_system
