__all__ = [
    "REGISTRY",
    "WeightsError",
    "entry_of",
    "how_to_install",
    "install",
    "is_installed",
    "load_model",
    "own_entries",
    "weights_folder",
]

from .files import WeightsError, install, is_installed, load_model, own_entries, weights_folder
from .networks import REGISTRY, entry_of, how_to_install
