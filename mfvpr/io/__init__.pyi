__all__ = [
    "ImportedFeatures",
    "open_features",
    "read_global_descriptors",
    "read_shortlist",
    "reranked_shortlist",
    "write_features",
    "write_global_descriptors",
    "write_shortlist",
]

from .descriptors import read_global_descriptors, write_global_descriptors
from .features import ImportedFeatures, open_features, write_features
from .shortlists import read_shortlist, reranked_shortlist, write_shortlist
