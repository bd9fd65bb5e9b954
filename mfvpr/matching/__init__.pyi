__all__ = [
    "CrossCheck",
    "HostMatcher",
    "LightGlueMatcher",
    "MatchSet",
    "Matcher",
    "NearestNeighborMatcher",
    "Scales",
    "compact",
    "filter_matches",
    "match",
    "match_candidates",
    "match_pairs",
    "soft_match",
]

from .host import HostMatcher
from .lightglue import LightGlueMatcher
from .match_set import MatchSet, Scales
from .matcher import Matcher, NearestNeighborMatcher, match_pairs
from .nearest_neighbors import CrossCheck, compact, filter_matches, match, match_candidates
from .soft import soft_match
