__all__ = [
    "SettingsError",
    "assembly",
    "settings",
]

from . import assembly, settings
from .settings import SettingsError
