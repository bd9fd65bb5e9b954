"""Features of two images -> Matches: nearest neighbors (paper, section IV-A), and filters of the matches.

The similarity matrix dominates the cost. It is computed once per pair, and read twice while it is in the cache.
"""

from dataclasses import fields, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from mfvpr.core.checked import prepare_query  # without products of bfloat16: from mfvpr.core.nearest
from mfvpr.core.nearest import CrossCheck, Neighbors, Product, Query, ready
from mfvpr.core.types import Array, Features, Matches, per_keypoint, per_match
from mfvpr.utils.errors import require_word
from mfvpr.utils.numerics import compiled, device_bytes, is_concrete, masked, safe_sqrt

MEMORY_SHARE = 1 / 256  # of a device's memory, for the similarity matrices that exist at the same time


def match(
    features0: Features, features1: Features, *, cross_check: CrossCheck = "mutual", with_ratio: bool = False
) -> Matches:
    """Nearest neighbors of one pair of images (paper, section IV-A).

        matches = mfvpr.match(features0, features1, with_ratio=True)

    Slot k of the result belongs to keypoint k of image 0 (K = N0), or of image 1 (K = N1) where cross_check is
    `candidate`; the first index wins a tie. Nearest is the largest dot product: descriptors need unit length.

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
    return match_prepared(Query(ready(features0)), features1, cross_check=cross_check, with_ratio=with_ratio)


def match_prepared(query: Query, candidate: Features, *, cross_check: CrossCheck, with_ratio: bool) -> Matches:
    """`match` of a query that `prepare_query` prepared once for all of its candidates."""
    if cross_check == "candidate":
        exchanged = Query(ready(candidate))
        matches = match_prepared(exchanged, query.features, cross_check="none", with_ratio=with_ratio)
        sides = [f.name[:-1] for f in fields(matches) if f.name.endswith("0")]
        swapped = {f"{name}{1 - side}": getattr(matches, f"{name}{side}") for name in sides for side in (0, 1)}
        return replace(matches, **swapped)
    candidate = ready(at_least_one(candidate))
    neighbors = query.neighbors(candidate, cross_check, with_second=with_ratio)
    ratio = distance_ratio(query.features, candidate, neighbors) if with_ratio else None
    return make_matches(query.features, candidate, neighbors.match, neighbors.real, ratio=ratio)


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
    require_word("cross_check", cross_check, CrossCheck)
    chunk_size = pairs_at_once(chunk_size, query, candidates)
    if 0 in (np.shape(query.mask)[0], np.shape(candidates.mask)[1]):  # `lax.map` cannot make chunks of them
        chunk_size = 1
    if 1 < chunk_size < len(candidates.mask):  # as many chunks of equal size: a smaller one is compiled as well
        chunk_size = -(-len(candidates.mask) // -(-len(candidates.mask) // chunk_size))
    matches = _match_candidates(query, candidates, cross_check, with_ratio, chunk_size, product)
    return with_concrete_sizes(matches, query.image_size, candidates.image_size)


@partial(compiled, static_argnums=(2, 3, 4, 5))
def _match_candidates(
    query: Features,
    candidates: Features,
    cross_check: CrossCheck,
    with_ratio: bool,
    chunk_size: int,
    product: Product | None,
) -> Matches:
    prepared = prepare_query(query, candidates, cross_check, chunk_size, product)
    match_one = partial(match_prepared, prepared, cross_check=cross_check, with_ratio=with_ratio)
    return jax.lax.map(match_one, candidates, batch_size=None if chunk_size == 1 else chunk_size)


def with_concrete_sizes(matches: Matches, image_size0: Array, image_size1: Array) -> Matches:
    """Matches `[P, ...]` with image sizes on the host, where scorers need them, unless they are traced or None."""
    sizes = {"image_size0": image_size0, "image_size1": image_size1}
    if any(size is None or not is_concrete(size) for size in sizes.values()):
        return matches
    shape = len(matches.mask), 2
    for name, size in sizes.items():
        sizes[name] = np.broadcast_to(np.asarray(size, getattr(matches, name).dtype), shape)
    return replace(matches, **sizes)


def pairs_at_once(chunk_size: int | None, query: Features, candidates: Features) -> int:
    """`chunk_size`; by default 1 on a CPU, to stay in its cache, else what MEMORY_SHARE allows."""
    if chunk_size is None:
        available = device_bytes((query, candidates))
        matrix = 4 * query.mask.shape[-1] * candidates.mask.shape[-1] + 1
        return 1 if available is None else max(1, int(MEMORY_SHARE * available) // matrix)
    if chunk_size < 1:
        raise ValueError(f"chunk_size={chunk_size}: expected a whole number above 0")
    return chunk_size


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
    entries = {name: _one_row(jnp.asarray(values))[slots] for name, values in per_match(matches).items()}
    return replace(matches, mask=jnp.arange(capacity) < jnp.sum(matches.mask), **entries)


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
        index0=jnp.arange(features0.mask.shape[-1], dtype=jnp.int32),
        index1=index1,
        count0=jnp.sum(features0.mask, dtype=jnp.int32),
        count1=jnp.sum(features1.mask, dtype=jnp.int32),
        **optional,
    )


def at_least_one(features: Features) -> Features:
    """Add a slot of padding to an image without slots."""
    return replace(features, **{name: _one_row(values) for name, values in per_keypoint(features).items()})


def _one_row(values: Array) -> Array:
    return values if len(values) else jnp.zeros((1, *values.shape[1:]), values.dtype)


def _distance(
    features0: Features, features1: Features, index1: Int[Array, " keypoints0"], real: Bool[Array, " keypoints0"]
) -> Float[Array, " keypoints0"]:
    """Distances to the candidate's descriptors `index1`; 0 where not `real`."""
    # sqrt(2 - 2 cos) would turn a distance of 0 into up to 3.5e-4 in float32.
    difference = masked(features0.descriptors - features1.descriptors[index1], real)
    return safe_sqrt(jnp.sum(difference * difference, axis=-1))


def distance_ratio(
    features0: Features, features1: Features, neighbors: Neighbors | None = None
) -> Float[Array, " keypoints0"]:
    """Ratio as in `match`, for features that are `ready`; `neighbors` if they are known."""
    if neighbors is None:
        neighbors = Query(features0).neighbors(features1, "none", with_second=True)
    places, real = (neighbors.nearest, neighbors.second), neighbors.has_second
    closest, second = (_distance(features0, features1, index, real) for index in places)
    differ = real & (closest < second)  # False if both are 0, or if rounding swaps equal distances
    return jnp.where(differ, closest / jnp.where(differ, second, 1.0), 1.0)
