"""The shifts that scores are made of."""

from mfvpr.numerics import as_float, masked
from mfvpr.types import Array, Matches


def match_shifts(matches: Matches) -> Array:
    """`[K, 2]` points1 - points0 of one pair, px; 0 on padding."""
    return masked(as_float(matches.points1), matches.mask) - masked(as_float(matches.points0), matches.mask)
