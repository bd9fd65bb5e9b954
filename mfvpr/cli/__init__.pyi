__all__ = [
    "SettingsError",
    "load_system",
    "main",
]

from .programs import main
from .settings import SettingsError
from .systems import load_system
