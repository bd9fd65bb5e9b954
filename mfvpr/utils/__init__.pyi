__all__ = [
    "InputError",
    "NoGradientError",
    "Stopwatch",
    "recipe_of",
]

from .errors import InputError, NoGradientError
from .fingerprints import recipe_of
from .progress import Stopwatch
