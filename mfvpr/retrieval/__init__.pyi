__all__ = [
    "DescriptorFiles",
    "ExactSearch",
    "FeatureFiles",
    "MatchFiles",
    "Retrieval",
    "RetrievalResult",
    "Retriever",
    "ShortlistFiles",
    "SsmVoting",
    "WhitenedSearch",
    "fit_to_database",
    "retrieve",
]

from .precomputed import DescriptorFiles, FeatureFiles, MatchFiles, ShortlistFiles
from .retriever import Retrieval, RetrievalResult, Retriever, SsmVoting, fit_to_database
from .search import ExactSearch, WhitenedSearch, retrieve
