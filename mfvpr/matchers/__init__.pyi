__all__ = [
    "HostMatcher",
    "LightGlueMatcher",
    "MatchSet",
    "Matcher",
    "NearestNeighborMatcher",
    "Scales",
    "match_pairs",
    "soft_match",
]

from .host_matcher import HostMatcher
from .match_set import MatchSet, Scales
from .matcher import LightGlueMatcher, Matcher, NearestNeighborMatcher, match_pairs, soft_match
