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
from .lightglue_matcher import LightGlueMatcher
from .match_set import MatchSet, Scales
from .matcher import Matcher, NearestNeighborMatcher, match_pairs
from .soft import soft_match
