"""Nearest neighbors of the rows and columns of a similarity matrix; the first wins a tie.

Each direction reads the matrix once, for the maximum of every block of about 30 entries, then the block with the
largest maximum again: several times faster than `argmax` on XLA's CPU backend. Elsewhere `argmax` reads it once.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float, Int

from mfvpr.core.types import Array
from mfvpr.utils.numerics import device_of

BLOCK = 32


class Nearest(NamedTuple):
    """Largest `similarity` of rows or columns, and its `index`, int32; 0 if all are -inf."""

    index: Int[Array, " lines"]
    similarity: Float[Array, " lines"]


class Lines(NamedTuple):
    """Rows (axis 1) or columns (axis 0) of a similarity matrix, in blocks."""

    blocks: Float[Array, "_ _ _"]  # `[rows, blocks, entries]`, or `[blocks, entries, columns]`
    maxima: Float[Array, "_ _"]  # of the blocks: `[rows, blocks]`, or `[blocks, columns]`
    axis: int
    removed: Int[Array, " lines"] | None = None  # an entry of every line that does not count

    @property
    def length(self) -> int:
        """Entries of a block."""
        return self.blocks.shape[self.axis + 1]


def lines_of(similarity: Float[Array, "rows columns"], axis: int) -> Lines:
    """Rows (axis 1) or columns (axis 0)."""
    blocks = _blocks(similarity, axis)
    return Lines(blocks, jnp.max(blocks, axis=axis + 1), axis)


def nearest(lines: Lines) -> Nearest:
    """Nearest neighbors of all lines; the device chooses the method, which does not change the result."""
    if device_of(()).platform != "cpu":
        return _nearest_by_argmax(lines)
    largest = jnp.max(lines.maxima, axis=lines.axis)
    block = _first_true(lines.maxima == jnp.expand_dims(largest, lines.axis), lines.axis)
    place = _first_true(_take_block(lines, block) == jnp.expand_dims(largest, lines.axis), lines.axis)
    return Nearest(block * lines.length + place, largest)


def _nearest_by_argmax(lines: Lines) -> Nearest:
    axis, shape = lines.axis, lines.blocks.shape
    entries = lines.blocks.reshape(*shape[:axis], -1, *shape[axis + 2 :])
    if lines.removed is not None:
        numbers = jax.lax.broadcasted_iota(jnp.int32, entries.shape, axis)
        entries = jnp.where(numbers == jnp.expand_dims(lines.removed, axis), -jnp.inf, entries)
    index = jax.lax.argmax(entries, axis, jnp.int32)
    largest = jnp.take_along_axis(entries, jnp.expand_dims(index, axis), axis=axis)
    return Nearest(index, jnp.squeeze(largest, axis))


def without(lines: Lines, index: Int[Array, " lines"]) -> Lines:
    """All entries but one of every line."""
    lines, block = lines._replace(removed=index), index // lines.length
    numbers = jnp.expand_dims(jnp.arange(lines.maxima.shape[lines.axis], dtype=jnp.int32), 1 - lines.axis)
    rest = jnp.max(_take_block(lines, block), axis=lines.axis, keepdims=True)
    return lines._replace(maxima=jnp.where(numbers == jnp.expand_dims(block, lines.axis), rest, lines.maxima))


def count_from(lines: Lines, neighbors: Nearest, threshold: Float[Array, " lines"]) -> Int[Array, " lines"]:
    """Number of entries of at least the threshold, which is not above the nearest neighbor.

    Of a block without the nearest neighbor, only the largest entry is counted: the number is right if it is 1.
    """
    threshold = jnp.expand_dims(threshold, lines.axis)
    entries = _take_block(lines, neighbors.index // lines.length) >= threshold
    return jnp.sum(lines.maxima >= threshold, axis=lines.axis) + jnp.sum(entries, axis=lines.axis) - 1


def entries_from(
    lines: Lines, places: Int[Array, " chosen"], threshold: Float[Array, " chosen"]
) -> tuple[Callable[[Array], Array], int]:
    """Function that finds the next entry of at least the threshold in chosen lines, and the number that means none.

    It takes the numbers `[chosen]` of the entries before; -1 finds the first.
    """
    maxima = lines.maxima[places] if lines.axis else lines.maxima[:, places].T  # [chosen, blocks]
    blocks, number_in_block = jnp.arange(maxima.shape[1], dtype=jnp.int32), jnp.arange(lines.length, dtype=jnp.int32)
    end = maxima.shape[1] * lines.length
    has_entry = maxima >= threshold[:, None]

    def first_in(block: Array, number: Array) -> Array:
        values = lines.blocks[places, block] if lines.axis else lines.blocks[block, :, places]  # [chosen, entries]
        numbers = block[:, None] * lines.length + number_in_block[None]
        is_next = (values >= threshold[:, None]) & (numbers > number[:, None])
        if lines.removed is not None:
            is_next &= numbers != lines.removed[places, None]
        return jnp.min(jnp.where(is_next, numbers, end), axis=1)

    def next_after(number: Array) -> Array:
        block = number // lines.length
        later = jnp.min(jnp.where(has_entry & (blocks[None] > block[:, None]), blocks[None], len(blocks)), axis=1)
        return jnp.minimum(first_in(block, number), first_in(later, number))

    return next_after, end


def _first_true(hits: Array, axis: int) -> Array:
    """First index of True along `axis`; 0 if there is none."""
    size = hits.shape[axis]
    index = jax.lax.broadcasted_iota(jnp.int32, hits.shape, axis)
    first = jnp.min(jnp.where(hits, index, size), axis=axis, initial=size)
    return jnp.where(first == size, 0, first)


def even_size(size: int) -> int:
    """Smallest multiple of the block length that is not below `size`."""
    return size + -size % _block_length(size)


def _block_length(size: int) -> int:
    return next((length for length in range(BLOCK, BLOCK // 4, -1) if size % length == 0), BLOCK)


def _blocks(similarity: Array, axis: int) -> Array:
    """Split an axis into blocks and places in a block; the last block is padded with -inf."""
    size = similarity.shape[axis]
    length = _block_length(size)
    missing = even_size(size) - size if size else length
    if missing:
        widths = [(0, missing if place == axis else 0) for place in range(2)]
        similarity = jnp.pad(similarity, widths, constant_values=-jnp.inf)
    parts = (size + missing) // length, length
    return similarity.reshape(*similarity.shape[:axis], *parts, *similarity.shape[axis + 1 :])


def _take_block(lines: Lines, block: Int[Array, " lines"]) -> Float[Array, "_ _"]:
    """One block of every line, -inf at the entry that was removed."""
    axis = lines.axis
    entries = jnp.squeeze(jnp.take_along_axis(lines.blocks, jnp.expand_dims(block, (axis, axis + 1)), axis=axis), axis)
    if lines.removed is None:
        return entries
    places = jnp.expand_dims(jnp.arange(lines.length, dtype=jnp.int32), 1 - axis)
    removed = jnp.expand_dims(lines.removed - block * lines.length, axis)
    return jnp.where(places == removed, -jnp.inf, entries)
