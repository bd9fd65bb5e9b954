__all__ = [
    "CrossCheck",
    "LightGlueMatching",
    "MatchSet",
    "Matcher",
    "Matching",
    "Scales",
    "compact",
    "filter_matches",
    "match",
    "match_candidates",
    "match_pairs",
    "soft_match",
]

from .lightglue import LightGlueMatching
from .match_set import MatchSet, Scales
from .matcher import Matcher, Matching, match_pairs
from .nearest_neighbors import CrossCheck, compact, filter_matches, match, match_candidates
from .soft import soft_match
