__all__ = [
    "Cluster",
    "InputError",
    "NoGradientError",
    "Runtime",
    "Stopwatch",
    "recipe_of",
]

from .cluster import Cluster
from .errors import InputError, NoGradientError
from .fingerprints import recipe_of
from .progress import Stopwatch
from .runtime import Runtime
