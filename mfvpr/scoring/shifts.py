"""The shifts that scores are made of, and the sizes that bound them."""

import jax.numpy as jnp

from mfvpr.numerics import as_float, masked
from mfvpr.types import Array, Matches


def match_shifts(matches: Matches) -> Array:
    """`[K, 2]` points1 - points0 of one pair, px; 0 on padding."""
    return masked(as_float(matches.points1), matches.mask) - masked(as_float(matches.points0), matches.mask)


def image_sizes(matches: Matches) -> tuple[Array, Array]:
    """Sizes `[2]` (width, height) of query and candidate, px; 1 for what is no size in a pair without matches."""
    some = jnp.any(matches.mask)
    size0, size1 = as_float(matches.image_size0), as_float(matches.image_size1)
    usable = lambda size: some | ((size > 0) & jnp.isfinite(size))  # noqa: E731
    return masked(size0, usable(size0), 1.0), masked(size1, usable(size1), 1.0)
