__all__ = [
    "InputError",
    "NoGradientError",
    "Runtime",
    "Stopwatch",
    "recipe_of",
]

from .errors import InputError, NoGradientError
from .fingerprints import recipe_of
from .progress import Stopwatch
from .runtime import Runtime
