__all__ = [
    "REGISTRY",
    "WeightsError",
    "entry_of",
    "install",
    "is_installed",
    "load_model",
    "weights_folder",
]

from .files import WeightsError, install, is_installed, load_model, weights_folder
from .registry import REGISTRY, entry_of
