__all__ = [
    "Alternating",
    "DescriptorFiles",
    "ExactSearch",
    "FeatureFiles",
    "MatchFiles",
    "Retrieval",
    "RetrievalResult",
    "Retriever",
    "ShortlistFiles",
    "SsmVoting",
    "StandardizedSearch",
    "WhitenedSearch",
    "fit_to_database",
    "retrieve",
]

from .precomputed import DescriptorFiles, FeatureFiles, MatchFiles, ShortlistFiles
from .retriever import Alternating, Retrieval, RetrievalResult, Retriever, SsmVoting, fit_to_database
from .search import ExactSearch, WhitenedSearch, retrieve
from .standardization import StandardizedSearch
