__all__ = [
    "DescriptorFiles",
    "ExactSearch",
    "FeatureFiles",
    "Filter",
    "Filtered",
    "Retrieval",
    "ShortlistFiles",
    "SsmVoting",
    "WhitenedSearch",
    "fit_to_database",
    "retrieve",
]

from .fitting import fit_to_database
from .precomputed import DescriptorFiles, FeatureFiles, ShortlistFiles
from .retriever import Filter, Filtered, Retrieval
from .search import ExactSearch, WhitenedSearch, retrieve
from .ssm_voting import SsmVoting
