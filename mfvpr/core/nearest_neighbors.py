"""Features of two images -> Matches: nearest neighbors, and filters of the matches.

The similarity matrix dominates the cost. It is computed once per pair, and read twice while it is in the cache.
"""

from dataclasses import fields, replace
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from mfvpr.core.checked import (
    Neighbors,
    Rounded,
    mutual_neighbors,
    round_candidate,
    round_query,
    tells_apart,
)
from mfvpr.core.similarity import even_size, lines_of, nearest, without
from mfvpr.core.types import Array, Features, Matches, per_keypoint, per_match
from mfvpr.utils import ragged
from mfvpr.utils.errors import InputError, require_word
from mfvpr.utils.numerics import (
    at_least_single,
    compiled,
    device_bytes,
    device_of,
    has_bfloat16,
    is_concrete,
    masked,
    safe_sqrt,
)

CrossCheck = Literal["mutual", "opencv_legacy", "none", "candidate"]
Product = Literal["bfloat16", "float32"]
LEAST_DIMENSIONS = 256  # with fewer, products of bfloat16 gain little
MEMORY_SHARE = 1 / 256  # of a device's memory, for the similarity matrices that exist at the same time


def match(
    features0: Features, features1: Features, *, cross_check: CrossCheck = "mutual", with_ratio: bool = False
) -> Matches:
    """Nearest neighbors of one pair of images (paper, section IV-A).

        matches = mfvpr.match(features0, features1, with_ratio=True)

    Slot k of the result belongs to keypoint k of image 0 (K = N0), or of image 1 (K = N1) where cross_check is
    `candidate`; the first index wins a tie.

    Args:
        features0: query, keypoints `[N0, 2]`; padding may hold anything.
        features1: candidate, keypoints `[N1, 2]`.
        cross_check: `mutual` keeps i, j where each is the other's nearest. `opencv_legacy` is OpenCV's BFMatcher
            before 2019: every candidate keypoint picks its nearest query keypoint, which keeps the closest keypoint
            that picked it. `none` keeps the nearest neighbor of every query keypoint, `candidate` the nearest neighbor
            of every candidate keypoint, as SSM-VPR does. (The paper says cross-check, which is `mutual`.)
        with_ratio: also return the ratio of the distances to the nearest and the second nearest descriptor of the
            candidate, matched or not (Lowe, IJCV 2004): 1 if both are 0 or there is no second. With `candidate`,
            both descriptors are of the query.

    Returns:
        Matches with K = N0 slots (`candidate`: N1). A descriptor that is not finite matches nothing.
    """
    require_word("cross_check", cross_check, CrossCheck)
    if cross_check == "candidate":
        return _swap_images(match(features1, features0, cross_check="none", with_ratio=with_ratio))
    features0, features1 = ready(features0), ready(at_least_one(features1))
    neighbors = _neighbors(features0, features1, cross_check, with_second=with_ratio)
    return _matches_of(features0, features1, neighbors, with_ratio=with_ratio)


def prepare_query(query: Features) -> Rounded:
    """Prepare a query for `match_rounded`, once for all of its candidates."""
    return round_query(ready(query))


def match_rounded(query: Rounded, candidate: Features, *, with_ratio: bool) -> Matches:
    """`match` with products of bfloat16; `cross_check` is `mutual`, and both images have slots."""
    candidate = ready(candidate)
    fixed_query, fixed = jax.lax.stop_gradient((query, candidate))
    rounded = round_candidate(fixed)
    in_single = partial(_neighbors, fixed_query.features, fixed, "mutual", with_second=with_ratio)

    def in_bfloat16() -> Neighbors:
        neighbors, settled = mutual_neighbors(fixed_query, rounded, with_second=with_ratio)
        return jax.lax.cond(settled, lambda: neighbors, in_single)

    def on_cpu() -> Neighbors:
        return jax.lax.cond(tells_apart(fixed_query, rounded), in_bfloat16, in_single)

    # Traced arrays do not say where they are: the program may be compiled for another device than the default.
    neighbors = jax.lax.platform_dependent(cpu=on_cpu, default=in_single)
    return _matches_of(query.features, candidate, neighbors, with_ratio=with_ratio)


def _matches_of(features0: Features, features1: Features, neighbors: Neighbors, *, with_ratio: bool) -> Matches:
    """Matches of `ready` features."""
    ratio = _distance_ratio(features0, features1, neighbors) if with_ratio else None
    return make_matches(features0, features1, neighbors.match, neighbors.real, ratio=ratio)


def match_candidates(
    query: Features,
    candidates: Features,
    *,
    cross_check: CrossCheck = "mutual",
    with_ratio: bool = False,
    chunk_size: int | None = None,
    product: Product | None = None,
) -> Matches:
    """`match` of one query, keypoints `[N0, 2]`, with C candidates, keypoints `[C, N1, 2]`.

        candidate_matches = mfvpr.match_candidates(query, candidates)  # [C, K]

    `cross_check`, `with_ratio` and the slots are those of `match`; other shapes raise a ValueError. `chunk_size` is the
    number of candidates with similarity matrices in memory at the same time; by default one on a CPU, where the matrix
    stays in the cache, and as many as fit a small part of an accelerator's memory.

    `product` is what the descriptors are multiplied in; the matches are the same. `bfloat16`, for `mutual` alone, takes
    about two thirds of the time of `float32` where a CPU has instructions for it; other devices always take `float32`.
    None decides.
    """
    if np.ndim(query.mask) != 1 or np.ndim(candidates.mask) != 2:
        shapes = f"{np.shape(query.mask)} and {np.shape(candidates.mask)}"
        raise ValueError(f"expected one query [N0] and candidates [C, N1], got masks of shapes {shapes}; see match")
    chunk_size = pairs_at_once(chunk_size, query, candidates)
    if 0 in (np.shape(query.mask)[0], np.shape(candidates.mask)[1]):  # `lax.map` cannot make chunks of them
        chunk_size = 1
    if 1 < chunk_size < len(candidates.mask):  # as many chunks of equal size: a smaller one is compiled as well
        chunk_size = -(-len(candidates.mask) // -(-len(candidates.mask) // chunk_size))
    options = {"cross_check": cross_check, "with_ratio": with_ratio, "chunk_size": chunk_size}
    product = choose_product(product, query, candidates, cross_check, chunk_size)
    matches = _match_candidates(query, candidates, product=product, **options)
    return with_concrete_sizes(matches, query.image_size, candidates.image_size)


def with_concrete_sizes(matches: Matches, image_size0: Array, image_size1: Array) -> Matches:
    """Matches `[P, ...]` with image sizes on the host, where scorers need them, unless they are traced or None."""
    sizes = {"image_size0": image_size0, "image_size1": image_size1}
    if any(size is None or not is_concrete(size) for size in sizes.values()):
        return matches
    shape = len(matches.mask), 2
    return replace(matches, **{
        name: np.broadcast_to(np.asarray(size, getattr(matches, name).dtype), shape) for name, size in sizes.items()
    })  # fmt: skip


@partial(compiled, static_argnames=("cross_check", "with_ratio", "chunk_size", "product"))
def _match_candidates(
    query: Features, candidates: Features, *, chunk_size: int, product: Product, **options: Any
) -> Matches:
    if product == "bfloat16":
        rounded = prepare_query(query)
        return jax.lax.map(
            lambda candidate: match_rounded(rounded, candidate, with_ratio=options["with_ratio"]), candidates
        )
    batch_size = None if chunk_size == 1 else chunk_size
    return jax.lax.map(lambda candidate: match(query, candidate, **options), candidates, batch_size=batch_size)


def pairs_at_once(chunk_size: int | None, query: Features, candidates: Features) -> int:
    """`chunk_size`; by default 1 on a CPU, to stay in its cache, else what MEMORY_SHARE allows."""
    if chunk_size is None:
        available = device_bytes((query, candidates))
        matrix = 4 * query.mask.shape[-1] * candidates.mask.shape[-1] + 1
        return 1 if available is None else max(1, int(MEMORY_SHARE * available) // matrix)
    if chunk_size < 1:
        raise ValueError(f"chunk_size={chunk_size}: expected a whole number above 0")
    return chunk_size


def choose_product(
    product: Product | None, queries: Features, candidates: Features, cross_check: CrossCheck, chunk_size: int
) -> Product:
    """`product` if the pairs can be matched in it, else a ValueError; None = bfloat16 where it is faster.

    On other devices than a CPU always float32: the bounds of `checked` do not hold there.
    """
    sides = queries, candidates
    lengths = {np.shape(side.descriptors)[-1] for side in sides}
    if product is not None:
        require_word("product", product, Product)
    may_be_faster = product is not None or (min(lengths) >= LEAST_DIMENSIONS and has_bfloat16())
    if not may_be_faster or device_of(sides).platform != "cpu":
        return "float32"
    dtypes = {jax.eval_shape(at_least_single, side.descriptors).dtype for side in sides}
    conditions = {
        "cross_check=mutual": cross_check == "mutual",
        "chunk_size=1": chunk_size == 1,
        "descriptors in single or half precision": dtypes == {jnp.dtype(jnp.float32)},
        "images with slots": all(side.mask.shape[-1] for side in sides),
        "descriptors of one length": len(lengths) == 1,
    }
    missing = [condition for condition, holds in conditions.items() if not holds]
    if product == "bfloat16" and missing:
        raise ValueError(f"product=bfloat16: expected {' and '.join(missing)}; leave product out")
    return product or ("float32" if missing else "bfloat16")


def filter_matches(
    matches: Matches, *, max_distance: float | Float[Array, ""] | None = None, max_matches: int | None = None
) -> Matches:
    """Keep matches `[K]` of one pair up to `max_distance`, and of these the `max_matches` closest.

        mfvpr.filter_matches(matches, max_distance=0.8, max_matches=500)

    Only the mask changes; among equal distances the first slots are kept.
    """
    if max_distance is not None:
        matches = replace(matches, mask=matches.mask & (matches.distance <= max_distance))
    if max_matches is not None:
        by_distance = jnp.argsort(masked(matches.distance, matches.mask, jnp.inf), stable=True)
        place = jnp.zeros_like(by_distance).at[by_distance].set(jnp.arange(len(by_distance)))
        matches = replace(matches, mask=matches.mask & (place < max_matches))
    return matches


def compact(matches: Matches, capacity: int) -> Matches:
    """Move the real matches of one pair `[K]` to the front of `capacity` slots, in their order.

        mfvpr.compact(mfvpr.filter_matches(matches, max_matches=500), capacity=512)

    The cost of all later steps is proportional to K or K^2, so that few slots are faster. Matches beyond the capacity
    are dropped: compare `matches.mask.sum()` with it.
    """
    slots = jnp.nonzero(jnp.asarray(matches.mask), size=capacity, fill_value=0)[0]
    entries = {name: jnp.asarray(values)[slots] for name, values in ragged.at_least_one_row(per_match(matches)).items()}
    return replace(matches, mask=jnp.arange(capacity) < jnp.sum(matches.mask), **entries)


def ready(features: Features) -> Features:
    """Features on the device, in at least single precision: half precision decides near-ties in another way."""
    wide = {name: at_least_single(values) for name, values in per_keypoint(features).items() if name != "mask"}
    return replace(features, **wide, mask=jnp.asarray(features.mask), image_size=single_size(features.image_size))


def single_size(image_size: Array) -> Array:
    """An image size in at least single precision; a size that is concrete stays so under a caller's `jit`."""
    if image_size is None or not is_concrete(image_size):
        return None if image_size is None else at_least_single(image_size)
    with jax.ensure_compile_time_eval():  # scorers derive their capacities from it
        return at_least_single(image_size)


def make_matches(
    features0: Features,
    features1: Features,
    index1: Int[Array, " keypoints0"],
    real: Bool[Array, " keypoints0"],
    **optional: Float[Array, " keypoints0"] | None,
) -> Matches:
    """Matches with N0 slots, one for every keypoint of the query, of `ready` features; the candidate has slots."""
    return Matches(
        points0=features0.keypoints,
        points1=features1.keypoints[index1],
        distance=_distance(features0, features1, index1, real),
        scores0=features0.scores,
        scores1=features1.scores[index1],
        mask=real,
        image_size0=features0.image_size,
        image_size1=features1.image_size,
        index0=slot_numbers(features0),
        index1=index1,
        count0=keypoint_count(features0),
        count1=keypoint_count(features1),
        **optional,
    )


def _swap_images(matches: Matches) -> Matches:
    sides = [(f.name, f"{f.name[:-1]}1") for f in fields(matches) if f.name.endswith("0")]
    query = {name0: getattr(matches, name1) for name0, name1 in sides}
    candidate = {name1: getattr(matches, name0) for name0, name1 in sides}
    return replace(matches, **query, **candidate)


def slot_numbers(features: Features) -> Int[Array, " keypoints"]:
    return jnp.arange(features.mask.shape[-1], dtype=jnp.int32)


def keypoint_count(features: Features) -> Int[Array, ""]:
    return jnp.sum(features.mask, dtype=jnp.int32)


def at_least_one(features: Features) -> Features:
    """Add a slot of padding to an image without slots."""
    return replace(features, **ragged.at_least_one_row(per_keypoint(features)))


def _pad_to_blocks(features: Features) -> Features:
    """Pad the slots to whole blocks of `similarity`, which is much faster than to pad the matrix."""
    size = features.mask.shape[-1]
    missing = even_size(size) - size
    if not missing:
        return features
    padded = jax.tree.map(
        lambda values: jnp.pad(values, [(0, missing)] + [(0, 0)] * (np.ndim(values) - 1)), per_keypoint(features)
    )
    return replace(features, **padded)


def _similarity(features0: Features, features1: Features) -> Float[Array, "keypoints0 keypoints1"]:
    """Dot products, -inf for padding and for descriptors that are not finite."""
    similarity = products(features0.descriptors, features1.descriptors)
    real = features0.mask[:, None] & features1.mask[None] & jnp.isfinite(similarity)
    return jnp.where(real, similarity, -jnp.inf)


def products(rows0: Float[Array, "rows0 _"], rows1: Float[Array, "rows1 _"]) -> Float[Array, "rows0 rows1"]:
    """Dot products of all rows, in full precision on every device."""
    if rows0.shape[-1] != rows1.shape[-1]:
        raise InputError(f"descriptors: expected as many dimensions on both sides, got {rows0.shape[-1]} and "
                         f"{rows1.shape[-1]}; extract all images alike")  # fmt: skip
    return jnp.matmul(rows0, rows1.T, precision=jax.lax.Precision.HIGHEST)


def _distance(
    features0: Features, features1: Features, index1: Int[Array, " keypoints0"], real: Bool[Array, " keypoints0"]
) -> Float[Array, " keypoints0"]:
    """Distances to the candidate's descriptors `index1`; 0 where not `real`."""
    # sqrt(2 - 2 cos) would turn a distance of 0 into up to 3.5e-4 in float32.
    difference = masked(features0.descriptors - features1.descriptors[index1], real)
    return safe_sqrt(jnp.sum(difference * difference, axis=-1))


def distance_ratio(features0: Features, features1: Features) -> Float[Array, " keypoints0"]:
    """Ratio as in `match`, for features that are `ready`."""
    return _distance_ratio(features0, features1, _neighbors(features0, features1, "none", with_second=True))


def _distance_ratio(features0: Features, features1: Features, neighbors: Neighbors) -> Float[Array, " keypoints0"]:
    has_second = neighbors.has_second
    closest, second = (
        _distance(features0, features1, index, has_second) for index in (neighbors.nearest, neighbors.second)
    )
    differ = has_second & (closest < second)  # False if both are 0, and if rounding swaps two equal distances
    return jnp.where(differ, closest / jnp.where(differ, second, 1.0), 1.0)


def _neighbors(features0: Features, features1: Features, cross_check: CrossCheck, *, with_second: bool) -> Neighbors:
    """Neighbors by products of single precision."""
    similarity = _similarity(_pad_to_blocks(features0), _pad_to_blocks(features1))
    rows = jnp.arange(similarity.shape[0], dtype=jnp.int32)
    lines = lines_of(similarity, axis=1)
    nearest1 = nearest(lines)
    second1 = nearest(without(lines, nearest1.index)) if with_second else nearest1
    match, real = nearest1.index, nearest1.similarity > -jnp.inf
    if cross_check != "none":
        nearest0 = nearest(lines_of(similarity, axis=0))
    if cross_check == "mutual":
        real &= nearest0.index[match] == rows
    if cross_check == "opencv_legacy":
        picked = jnp.where(nearest0.index[None] == rows[:, None], similarity, -jnp.inf)
        match, largest = nearest(lines_of(picked, axis=1))
        real = jnp.isfinite(largest)
    neighbors = Neighbors(match, real, nearest1.index, second1.index, second1.similarity > -jnp.inf)
    return neighbors.of(features0)
