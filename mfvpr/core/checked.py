"""Mutual nearest neighbors by products of bfloat16, checked where rounding could matter.

Let x, y be descriptors of D dimensions, and x', y' what bfloat16 makes of them. With u = 2^-24, a float32 sum of D
products in any order is off by at most g |x'| |y'|, g = D u / (1 - D u) (Higham, Accuracy and Stability of Numerical
Algorithms, 2002, section 3.1), and by Cauchy and Schwarz

    |x'.y' - x.y| <= |x - x'| |y| + |x'| |y - y'|.

A checked product is a float32 product in a fixed order (`checked_product`), off by less than 32 u |x| |y|. The sum e of
these bounds, with the largest |y| and |y - y'| of the other image, holds for all products of x. Let m be the largest
rounded product of x, and c the largest checked one, of the neighbor y:

    x'.y' >= c - e >= (checked product of the keypoint with m) - e >= m - 2 e.

So the neighbor is among the keypoints with rounded products of at least m - 2 e. If there are several, the largest
checked product decides, and the first index wins a tie. These are the neighbors of float32, except where two products
differ by less than its rounding. If a keypoint has more than `MOST_CHECKS` of them, or all together have many, as in
images whose descriptors are nearly equal, float32 matches the pair.

The bounds themselves are computed in float32, off by a share of at most 4 g, which is added, as is what numbers below
2^-126 can change, which may be taken for 0. Descriptors whose products could overflow are left to float32.

All of this is for a CPU. Other processors may add products of bfloat16 with fewer bits than float32 has (Fasi et al.,
Numerical behavior of NVIDIA tensor cores, PeerJ Computer Science 2021), so that g is no bound there.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import BFloat16, Bool, Float, Int

from mfvpr.core.nearest import (
    CrossCheck,
    Largest,
    Lines,
    Neighbors,
    Product,
    Query,
    even_size,
    largest_of,
    lines_of,
    ready,
    without,
)
from mfvpr.core.types import Array, Features, value
from mfvpr.utils.errors import require_word
from mfvpr.utils.numerics import at_least_single, device_of, has_bfloat16, masked

LEAST_DIMENSIONS = 256  # with fewer, products of bfloat16 gain little
MOST_CHECKS = 16  # of a keypoint
GROUP = 64  # keypoints that are checked at the same time
WORTHWHILE_CHECKS = 2.5  # of a keypoint, on average; with more of them, float32 is faster
_PARTS = 8  # into which the dimensions of a checked product are split
_SMALL, _LARGE = 2.0**-126, 2.0**126


class Rounded(NamedTuple):
    """Descriptors of an image in bfloat16, padded to whole blocks of products."""

    exact: Float[Array, "keypoints _"]  # the float32 descriptors, without padding
    descriptors: BFloat16[Array, "*_"]  # `[N, D]`, or `[D, N]` of a query
    norm: Float[Array, "*_"]  # of the float32 descriptors; 0 for padding, NaN and infinity
    residual: Float[Array, "*_"]  # norm of what rounding takes away


@value
class RoundedQuery(Query):
    """A query with its descriptors in bfloat16."""

    rounded: Rounded

    def neighbors(self, candidate: Features, cross_check: CrossCheck, *, with_second: bool) -> Neighbors:
        """Mutual neighbors as of `Query`; both images have slots."""
        query, candidate = jax.lax.stop_gradient((self, candidate))
        rounded0, rounded1 = query.rounded, round_image(candidate)

        def in_single() -> Neighbors:
            return Query(query.features).neighbors(candidate, cross_check, with_second=with_second)

        def in_bfloat16() -> Neighbors:
            neighbors, settled = mutual_neighbors(rounded0, rounded1, with_second=with_second)
            return jax.lax.cond(settled, lambda: neighbors.without_padding(query.features), in_single)

        # Traced arrays do not say where they are: the program may be compiled for another device than the default.
        return jax.lax.platform_dependent(cpu=in_bfloat16, default=in_single)


def prepare_query(
    query: Features,
    candidates: Features,
    cross_check: CrossCheck = "mutual",
    chunk_size: int = 1,
    product: Product | None = None,
) -> Query:
    """A query for `match_prepared`: its descriptors in bfloat16 if `choose_product` says so."""
    query = ready(query)
    if choose_product(product, query, candidates, cross_check, chunk_size) == "float32":
        return Query(query)
    rounded = round_image(query)
    return RoundedQuery(query, rounded._replace(descriptors=rounded.descriptors.T))  # so the product is fast


def choose_product(
    product: Product | None, query: Features, candidates: Features, cross_check: CrossCheck, chunk_size: int
) -> Product:
    """`product` if the pairs can be matched in it, else a ValueError; None = bfloat16 where it is faster.

    On other devices than a CPU always float32: the bounds of this module do not hold there.
    """
    sides = query, candidates
    if product is not None:
        require_word("product", product, Product)
    if product == "float32" or device_of(sides).platform != "cpu":
        return "float32"
    lengths = {np.shape(side.descriptors)[-1] for side in sides}
    dtypes = {jax.eval_shape(at_least_single, side.descriptors).dtype for side in sides}
    can_be_compared = dtypes == {jnp.dtype(jnp.float32)} and len(lengths) == 1
    is_possible = can_be_compared and cross_check == "mutual" and chunk_size == 1
    is_possible &= all(side.mask.shape[-1] for side in sides)
    if product == "bfloat16" and not is_possible:
        raise ValueError(
            "product=bfloat16: expected cross_check=mutual, chunk_size=1, images with slots, and descriptors of one "
            "length in single or half precision; leave product out"
        )
    is_faster = min(lengths) >= LEAST_DIMENSIONS and has_bfloat16()
    return "bfloat16" if is_possible and (product is not None or is_faster) else "float32"


class _Direction(NamedTuple):
    """Products of every keypoint of an image with all of the other image."""

    descriptors: Float[Array, "own _"]
    other_descriptors: Float[Array, "_ _"]
    lines: Lines
    nearest: Largest
    window: Float[Array, " own"]  # 2 e

    @property
    def threshold(self) -> Float[Array, " own"]:
        return self.nearest.similarity - self.window

    @property
    def count(self) -> Int[Array, " own"]:
        """Number of keypoints that may be the nearest, at least if it is 0 or 1; others are settled by checks."""
        count = count_from(self.lines, self.nearest, self.threshold)
        return jnp.where(self.nearest.similarity > -jnp.inf, count, 0)


def round_image(features: Features) -> Rounded:
    rounded = features.descriptors.astype(jnp.bfloat16)
    # Converted back, `rounded` could be the descriptors again: XLA may leave out a pair of conversions.
    lost = features.descriptors - jax.lax.reduce_precision(features.descriptors, 8, 7)
    missing = even_size(len(rounded)) - len(rounded)
    norms = [_norm(rows) for rows in (features.descriptors, lost)]
    is_number = features.mask & ~jnp.isnan(norms[0]) & ~jnp.isnan(norms[1])  # rounding takes NaN away from infinity
    norm, residual = (jnp.pad(jnp.where(is_number, norm, 0.0), (0, missing)) for norm in norms)
    return Rounded(features.descriptors, jnp.pad(rounded, ((0, missing), (0, 0))), norm, residual)


def _norm(rows: Float[Array, "rows _"]) -> Float[Array, " rows"]:
    """Norms above 0, infinite beyond the range of float32."""
    return jnp.sqrt(jnp.sum(rows * rows, axis=1) + rows.shape[1] * _SMALL)


def mutual_neighbors(query: Rounded, candidate: Rounded, *, with_second: bool) -> tuple[Neighbors, Bool[Array, ""]]:
    """Mutual nearest neighbors, and whether all that could matter was checked."""
    products = _products(query, candidate)
    columns = jnp.arange(products.shape[1], dtype=jnp.int32)
    to1, to0 = _direction(products, 0, query, candidate), _direction(products, 1, candidate, query)
    # A keypoint without a product that is close to both largest ones has no match.
    close_to_both = products >= jnp.maximum(to1.threshold[None], to0.threshold[:, None])
    has_neighbor = to1.nearest.similarity > -jnp.inf
    excess = masked(to1.count.astype(jnp.float32) - WORTHWHILE_CHECKS, has_neighbor)
    is_worthwhile = jnp.sum(excess) <= 0
    index1, settled1 = _settle(to1, (to1.count > 1) & close_to_both.any(axis=0) & is_worthwhile)
    may_match = has_neighbor & (products[index1, columns] >= to0.threshold[index1])
    is_chosen = jnp.zeros(len(products), bool).at[index1].max(may_match)
    index0, settled0 = _settle(to0, (to0.count > 1) & is_chosen & is_worthwhile)
    longest0, longest1 = (jnp.max(side.norm + side.residual, initial=0) for side in (query, candidate))
    is_match, settled = has_neighbor & (index0[index1] == columns), settled1 & settled0 & is_worthwhile
    settled &= longest0 * longest1 < _LARGE  # False for NaN
    if not with_second:
        return Neighbors(index1, is_match, index1, index1, is_match), settled
    lines = without(to1.lines, index1)
    rest = to1._replace(lines=lines, nearest=largest_of(lines))
    second, settled2 = _settle(rest, (rest.count > 1) & is_match & is_worthwhile)
    neighbors = Neighbors(index1, is_match, index1, second, rest.nearest.similarity > -jnp.inf)
    return neighbors, settled & settled2


def _products(query: Rounded, candidate: Rounded) -> Float[Array, "keypoints1 keypoints0"]:
    """Rounded products, -inf for padding and for descriptors that are not finite."""
    products = jnp.matmul(candidate.descriptors, query.descriptors, preferred_element_type=jnp.float32)
    real = (candidate.norm > 0)[:, None] & (query.norm > 0)[None] & jnp.isfinite(products)
    return jnp.where(real, products, -jnp.inf)


def _direction(products: Array, axis: int, image: Rounded, other: Rounded) -> _Direction:
    lines, dimensions = lines_of(products, axis), image.exact.shape[1]
    rounding = (dimensions + 32) * 2.0**-24
    norm, residual = jnp.max(other.norm, initial=0), jnp.max(other.residual, initial=0)
    rounded = image.norm + image.residual
    bound = image.residual * norm + rounded * residual + rounding * rounded * (norm + residual)
    window = 2 * (1 + 4 * rounding) * bound + 4 * dimensions * _SMALL
    return _Direction(image.exact, other.exact, lines, largest_of(lines), window)


def _settle(direction: _Direction, wanted: Bool[Array, " own"]) -> tuple[Int[Array, " own"], Bool[Array, ""]]:
    """Nearest neighbors, by checked products where `wanted`, and whether none has too many of them."""
    count = len(wanted)
    size = min(GROUP, count)
    slots = jnp.nonzero(wanted, size=count + size, fill_value=count)[0].astype(jnp.int32)

    def settle_group(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        start, index, _ = state
        places = jax.lax.dynamic_slice_in_dim(slots, start, size)
        keypoints = jnp.minimum(places, count - 1)
        threshold = jnp.where(places < count, direction.threshold[keypoints], jnp.inf)
        next_after, end = entries_from(direction.lines, keypoints, threshold)
        descriptors = direction.descriptors[keypoints]

        def check(state: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
            number, largest, best, checks = state
            product = checked_product(descriptors, direction.other_descriptors[number])
            is_larger = (number < end) & (product > largest)
            best = jnp.where(is_larger, number, best)
            return next_after(number), jnp.where(is_larger, product, largest), best, checks + 1

        first, lowest = next_after(jnp.full(size, -1, jnp.int32)), jnp.full(size, -jnp.inf, jnp.float32)
        number, _, best, _ = jax.lax.while_loop(
            lambda state: (state[0] < end).any() & (state[3] < MOST_CHECKS),
            check,
            (first, lowest, index[keypoints], jnp.int32(0)),
        )
        return start + size, index.at[places].set(best, mode="drop"), (number == end).all()

    _, index, settled = jax.lax.while_loop(
        lambda state: (state[0] < jnp.sum(wanted)) & state[2],
        settle_group,
        (jnp.int32(0), direction.nearest.index, jnp.bool_(True)),
    )
    return index, settled


def count_from(lines: Lines, neighbors: Largest, threshold: Float[Array, " lines"]) -> Int[Array, " lines"]:
    """Number of entries of at least the threshold, which is not above the nearest neighbor.

    Of a block without the nearest neighbor, only the largest entry is counted: the number is right if it is 1.
    """
    threshold = jnp.expand_dims(threshold, lines.axis)
    entries = lines.take(neighbors.index // lines.length) >= threshold
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


def checked_product(rows0: Float[Array, "rows _"], rows1: Float[Array, "rows _"]) -> Float[Array, " rows"]:
    """Products of rows in float32, summed in an order that is the same everywhere.

    The products of the dimensions, padded with zeros to 8 * 2^n, are split into 8 equal parts. These are added one
    after the other, then the first half of the sums to the second until one is left.
    """
    length = _PARTS * (1 << max(0, -(-rows0.shape[1] // _PARTS) - 1).bit_length())
    products = jnp.pad(rows0 * rows1, ((0, 0), (0, length - rows0.shape[1])))
    # A compiler that knew that the second term is 0 could make one operation of a product and a sum, which rounds once.
    bits = jax.lax.bitcast_convert_type(products, jnp.int32) ^ (jnp.sum(rows0[:1]) * 0 == 1).astype(jnp.int32)
    parts = jax.lax.bitcast_convert_type(bits, jnp.float32).reshape(len(products), _PARTS, -1)
    sums = parts[:, 0]
    for part in range(1, _PARTS):
        sums = sums + parts[:, part]
    while sums.shape[1] > 1:
        half = sums.shape[1] // 2
        sums = sums[:, :half] + sums[:, half:]
    return sums[:, 0]
