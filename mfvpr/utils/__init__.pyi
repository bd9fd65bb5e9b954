__all__ = [
    "Cluster",
    "InputError",
    "NoGradientError",
    "Runtime",
    "Stopwatch",
    "keep_compiled_programs",
    "recipe_of",
]

from .cluster import Cluster
from .compiled_programs import keep_compiled_programs
from .errors import InputError, NoGradientError
from .fingerprints import recipe_of
from .runtime import Runtime, Stopwatch
