__all__ = [
    "FeatureCache",
    "Recipes",
    "Vectors",
]

from .feature_cache import FeatureCache, Recipes, Vectors
