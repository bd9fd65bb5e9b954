__all__ = [
    "Archive",
    "NotYet",
    "Shard",
]

from .feature_cache import Archive
from .shards import NotYet, Shard
