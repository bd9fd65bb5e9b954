"""Bilinear interpolation of maps, at any positions or on a finer grid. Pixel centers are at integers."""

from collections.abc import Iterator
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from mfvpr.core.types import Array


class Neighbors(NamedTuple):
    """Pixels before and after each position on a line, and the position between them."""

    lower: Int[np.ndarray, " positions"]
    upper: Int[np.ndarray, " positions"]
    part: Float[np.ndarray, " positions"]  # in [0, 1], from lower to upper


def sample(
    dense: Float[Array, "height width channels"], points: Float[Array, "*points 2"]
) -> Float[Array, "*points channels"]:
    """Sample a map at positions (x, y) px.

    Pixels outside the map are zero, so values fade out within one pixel of the border, as in `grid_sample` with aligned
    corners and in deformable convolutions.
    """
    height, width, channels = dense.shape
    flat = dense.reshape(height * width, channels)  # one index is faster than two
    total = jnp.zeros((*points.shape[:-1], channels), dense.dtype)
    for y, x, weight in around(points, height, width):
        total += weight[..., None] * flat.at[y * width + x].get(mode="promise_in_bounds")
    return total


def around(
    points: Float[Array, "*points 2"], height: int, width: int
) -> Iterator[tuple[Int[Array, "*points"], Int[Array, "*points"], Float[Array, "*points"]]]:
    """Yield y, x and weight of the four pixels around positions (x, y) px; those outside move inside, with weight 0."""
    low = jnp.floor(points)
    part, pixel = points - low, low.astype(int)
    for down in (0, 1):
        for right in (0, 1):
            x, y = pixel[..., 0] + right, pixel[..., 1] + down
            across = part[..., 0] if right else 1 - part[..., 0]
            along = part[..., 1] if down else 1 - part[..., 1]
            inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
            yield jnp.clip(y, 0, height - 1), jnp.clip(x, 0, width - 1), jnp.where(inside, across * along, 0)


def stretch(
    dense: Float[Array, "*batch height width channels"], rows: int, columns: int
) -> Float[Array, "*batch {rows} {columns} channels"]:
    """Resize maps, with aligned corner pixels."""
    for axis, size in ((-2, columns), (-3, rows)):
        if dense.shape[axis] != size:
            dense = between(dense, neighbors(dense.shape[axis], size), axis)
    return dense


def neighbors(size: int, count: int, window: slice = slice(None)) -> Neighbors:
    """Neighbors of `count` evenly spaced positions, from the first to the last of `size` pixels, in a window."""
    step = np.float32((size - 1) / max(count - 1, 1))
    position = step * np.arange(count, dtype=np.float32)[window]  # rounded as torch rounds it
    lower = np.minimum(position.astype(int), size - 1)
    return Neighbors(lower, np.minimum(lower + 1, size - 1), position - lower.astype(np.float32))


def between(dense: Float[Array, "..."], places: Neighbors, axis: int) -> Float[Array, "..."]:
    """Interpolate `dense` at these places along one axis.

    Reading two neighbors is several times faster than a product with the sparse matrix of the interpolation.
    """
    part = jnp.expand_dims(places.part, [other for other in range(dense.ndim) if other != axis % dense.ndim])
    return (1 - part) * jnp.take(dense, places.lower, axis) + part * jnp.take(dense, places.upper, axis)
