__all__ = [
    "FeatureCache",
    "NotYet",
    "Shard",
]

from .feature_cache import FeatureCache
from .shards import NotYet, Shard
