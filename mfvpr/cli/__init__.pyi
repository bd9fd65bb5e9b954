__all__ = [
    "load_system",
    "main",
]

from .command_line import load_system
from .programs import main
