"""Similarity matrix -> the nearest neighbors of its rows and columns, the first index where several are equal.

Each direction reads the matrix once: the largest of every block of some thirty entries, of which one is then looked at
again. `argmax` would read it once as well, and take several times longer on XLA's CPU backend.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from mfvpr.types import Array

BLOCK = 32


class Nearest(NamedTuple):
    """Of every row or column: the `index` `[n]` int32 of its largest similarity and that `similarity` `[n]`.

    Where all are -inf there is none: the index is 0.
    """

    index: Array
    similarity: Array


def nearest(similarity: Array, axis: int) -> Nearest:
    """The largest entries of `similarity` `[N0, N1]` along an axis: 1 for the rows' neighbors, 0 for the columns'."""
    blocks = _blocks(similarity, axis)
    return _look(blocks, jnp.max(blocks, axis=axis + 1), axis)


def nearest_two(similarity: Array) -> tuple[Nearest, Nearest]:
    """The nearest and the second nearest neighbor of every row of `similarity` `[N0, N1]`."""
    blocks = _blocks(similarity, 1)
    tops = jnp.max(blocks, axis=2)
    best = _look(blocks, tops, 1)
    block, place = jnp.divmod(best.index, blocks.shape[2])
    beside = _without(_block(blocks, block, 1), place)
    elsewhere = _look(blocks, _without(tops, block), 1)
    top = jnp.max(beside, axis=1)
    index = block * blocks.shape[2] + first(beside == top[:, None], 1)
    nearer = (top > elsewhere.similarity) | ((top == elsewhere.similarity) & (index < elsewhere.index))
    second = Nearest(jnp.where(nearer, index, elsewhere.index), jnp.maximum(top, elsewhere.similarity))
    return best, second


def first(hit: Array, axis: int) -> Array:
    """First index of True along `axis`; 0 where there is none."""
    size = hit.shape[axis]
    index = jax.lax.broadcasted_iota(jnp.int32, hit.shape, axis)
    found = jnp.min(jnp.where(hit, index, size), axis=axis, initial=size)
    return jnp.where(found == size, 0, found)


def even_size(size: int) -> int:
    """The smallest size, not below this one, that comes out even in blocks."""
    return size + -size % _length(size)


def _length(size: int) -> int:
    """Of the blocks."""
    return next((length for length in range(BLOCK, BLOCK // 4, -1) if size % length == 0), BLOCK)


def _blocks(similarity: Array, axis: int) -> Array:
    """The axis in two: blocks, and places in a block; filled up with -inf where they do not come out even."""
    size = similarity.shape[axis]
    length = _length(size)
    missing = even_size(size) - size if size else length
    if missing:
        widths = [(0, missing if place == axis else 0) for place in range(2)]
        similarity = jnp.pad(similarity, widths, constant_values=-jnp.inf)
    parts = (size + missing) // length, length
    return similarity.reshape(*similarity.shape[:axis], *parts, *similarity.shape[axis + 1 :])


def _look(blocks: Array, tops: Array, axis: int) -> Nearest:
    """The largest entry, in the first block that has it; `tops` are the blocks' largest, -inf for one to leave out."""
    largest = jnp.max(tops, axis=axis, keepdims=True)
    block = first(tops == largest, axis)
    place = first(_block(blocks, block, axis) == largest, axis)
    return Nearest(block * blocks.shape[axis + 1] + place, jnp.squeeze(largest, axis))


def _block(blocks: Array, index: Array, axis: int) -> Array:
    """One block of every row or column."""
    found = jnp.take_along_axis(blocks, jnp.expand_dims(index, (axis, axis + 1)), axis=axis)
    return jnp.squeeze(found, axis)


def _without(values: Array, place: Array) -> Array:
    """`values` `[N0, n]` with -inf at one `place` of every row."""
    columns = jnp.arange(values.shape[1], dtype=jnp.int32)
    return jnp.where(columns[None] == place[:, None], -jnp.inf, values)
