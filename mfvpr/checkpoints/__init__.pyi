__all__ = [
    "REGISTRY",
    "WeightsError",
    "custom_entries",
    "entry_of",
    "how_to_install",
    "install",
    "is_installed",
    "load_model",
    "weights_folder",
]

from .files import WeightsError, custom_entries, install, is_installed, load_model, weights_folder
from .networks import REGISTRY, entry_of, how_to_install
