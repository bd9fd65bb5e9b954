"""Shifts of matches, and the image sizes that bound them."""

from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Float

from mfvpr.core.types import Array, Matches
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import at_least_single, masked


def match_shifts(matches: Matches) -> Float[jax.Array, "slots 2"]:
    """Shifts points1 - points0 of one pair's `matches`, slots `[K]`, in px; 0 on padding.

    Example:
        mfvpr.match_shifts(matches)  # [K, 2], (x, y)
    """
    matches = replace(matches)  # checks the shapes, as in `match_weights`
    start, end = (masked(at_least_single(points), matches.mask) for points in (matches.points0, matches.points1))
    return end - start


def require_sizes(*image_sizes: Array | None) -> None:
    """Raise an InputError if the sizes of images are not known."""
    if any(size is None for size in image_sizes):
        raise InputError(
            "image_size: expected the sizes of both images, which this score needs, got None; give "
            "Features.of(..., image_size=(width, height))"
        )


def image_sizes(matches: Matches) -> tuple[Float[jax.Array, "2"], Float[jax.Array, "2"]]:
    """Sizes (width, height) of query and candidate, px, of one pair's `matches`, slots `[K]`.

        (width0, height0), (width1, height1) = mfvpr.image_sizes(matches)

    Without matches, invalid sizes are 1. Sizes that are None raise an `InputError`.
    """
    require_sizes(matches.image_size0, matches.image_size1)
    has_matches = jnp.any(matches.mask)
    size0, size1 = at_least_single(matches.image_size0), at_least_single(matches.image_size1)
    usable = lambda size: has_matches | ((size > 0) & jnp.isfinite(size))  # noqa: E731
    return masked(size0, usable(size0), 1.0), masked(size1, usable(size1), 1.0)
