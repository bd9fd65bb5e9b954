__all__ = [
    "FeatureCache",
    "Recipes",
    "Vectors",
]

from .feature_cache import FeatureCache, Vectors
from .recipes import Recipes
