"""The shifts that scores are made of, and the sizes that bound them."""

import jax.numpy as jnp

from mfvpr.numerics import at_least_single, masked
from mfvpr.types import Array, Matches


def match_shifts(matches: Matches) -> Array:
    """`[K, 2]` points1 - points0 of one pair, px; 0 on padding."""
    start, end = (masked(at_least_single(points), matches.mask) for points in (matches.points0, matches.points1))
    return end - start


def image_sizes(matches: Matches) -> tuple[Array, Array]:
    """Sizes `[2]` (width, height) of query and candidate, px; 1 for what is no size in a pair without matches."""
    some = jnp.any(matches.mask)
    size0, size1 = at_least_single(matches.image_size0), at_least_single(matches.image_size1)
    usable = lambda size: some | ((size > 0) & jnp.isfinite(size))  # noqa: E731
    return masked(size0, usable(size0), 1.0), masked(size1, usable(size1), 1.0)
