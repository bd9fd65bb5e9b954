"""The shifts that scores are made of, and the sizes that bound them."""

import math
from dataclasses import replace

import jax.numpy as jnp

from mfvpr.types import Array, Matches
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import at_least_single, masked


def match_shifts(matches: Matches) -> Array:
    """`[K, 2]` points1 - points0 of one pair, px; 0 on padding."""
    start, end = (masked(at_least_single(points), matches.mask) for points in (matches.points0, matches.points1))
    return end - start


def zoomed(matches: Matches, scale: float) -> Matches:
    """One pair's matches as they would be if the candidate did not show the place `scale` times as large as the query.

    Points move about the centers of their images, of the candidate by 1 / sqrt(scale), of the query by sqrt(scale): so
    it is the same whichever image is the query, and errors of a position count alike on both sides.
    """
    if scale == 1:
        return matches
    root = math.sqrt(scale)
    points0 = _about_center(matches.points0, matches.image_size0, root)
    return replace(matches, points0=points0, points1=_about_center(matches.points1, matches.image_size1, 1 / root))


def _about_center(points: Array, image_size: Array, factor: float) -> Array:
    center = at_least_single(image_size)[None] / 2
    return center + factor * (at_least_single(points) - center)


def image_sizes(matches: Matches) -> tuple[Array, Array]:
    """Sizes `[2]` (width, height) of query and candidate, px; 1 for what is no size in a pair without matches."""
    some = jnp.any(matches.mask)
    size0, size1 = at_least_single(matches.image_size0), at_least_single(matches.image_size1)
    usable = lambda size: some | ((size > 0) & jnp.isfinite(size))  # noqa: E731
    return masked(size0, usable(size0), 1.0), masked(size1, usable(size1), 1.0)


def query_features(matches: Matches) -> Array:
    """`[]` float32, how many keypoints the query of one pair has, 1 at least: what scores per feature are divided by.

    Raises:
        InputError: the matches do not know.
    """
    if matches.count0 is None:
        raise InputError("per_feature=True: expected matches that know how many keypoints the query has (count0), got "
                         "None")  # fmt: skip
    return jnp.maximum(jnp.asarray(matches.count0, jnp.float32), 1.0)


def where_usable(found: Array, matches: Matches, shifts: Array, weights: Array, usable: Array) -> Array:
    """What was `found` by weights `[W, K]` of one pair, `[W]` or of the only one; 0 without matches, and NaN where the
    lattice is not usable, a shift or a weight no number: else the tallest bin would be anything."""
    usable = usable & are_numbers(shifts, weights)
    return jnp.where(jnp.any(matches.mask), jnp.where(usable, found, jnp.nan), 0.0)


def are_numbers(shifts: Array, weights: Array) -> Array:
    """`[W]` whether all shifts and the weights `[W, K]` are finite."""
    return jnp.all(jnp.isfinite(shifts)) & jnp.all(jnp.isfinite(weights), axis=1)
