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

from .fitting import fit_to_database
from .precomputed import DescriptorFiles, FeatureFiles, MatchFiles, ShortlistFiles
from .retriever import Retrieval, RetrievalResult, Retriever
from .search import ExactSearch, WhitenedSearch, retrieve
from .ssm_voting import SsmVoting
