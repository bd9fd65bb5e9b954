__all__ = [
    "FeatureCache",
]

from .feature_cache import FeatureCache
