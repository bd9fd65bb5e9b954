"""Matchers of one pair of images: nearest neighbors, LightGlue, soft matching; and compiled matching of many pairs."""

from dataclasses import field, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from mfvpr.core.matching import (
    at_least_one,
    distance_ratio,
    filter_matches,
    make_matches,
    match_prepared,
    pairs_at_once,
    prepare_query,
    with_concrete_sizes,
)
from mfvpr.core.nearest import CrossCheck, Product, Query, largest_of, lines_of, products, ready
from mfvpr.core.types import Array, Features, Matches, short_repr, value
from mfvpr.utils.errors import InputError, require_word
from mfvpr.utils.fields import COUNT, check_fields, number, setting, word_of
from mfvpr.utils.fingerprints import fingerprint, recipe_of
from mfvpr.utils.numerics import as_array, as_float, compiled, is_concrete, masked, positive, safe_sqrt

if TYPE_CHECKING:  # Flax takes half a second
    from mfvpr.networks.lightglue import LightGlue, Packed

CHUNK_SIZE = "pairs matched at once; null = 1 on a CPU, elsewhere what a small part of its memory holds"


class Matcher(Protocol):
    """Function of the features `[N0]` of a query and `[N1]` of a candidate that returns their Matches.

        def near(features0, features1):
            return mfvpr.filter_matches(mfvpr.match(features0, features1), max_distance=0.7)

        pipeline = mfvpr.Pipeline(extractor, retriever, matcher=near)

    It must work under `jit` and `vmap`: slots depend on shapes alone, and the content of padding has no effect, NaN
    included. A matcher is a value (`mfvpr.value`), its arrays are fields. A cache on disk needs a `recipe`, see
    `mfvpr.utils.recipe_of`. An optional field `chunk_size` is the number of pairs that are matched at the same time;
    without it, or if None, memory decides, assuming one similarity matrix per pair.

    An optional method `prepare(queries, candidates, chunk_size)` does the work per query once. It takes Features
    `[B, N0]` and `[S, N1]`, and returns arrays with the leading axis B. The matcher must take both these arrays and
    plain Features in place of a query's, as `NearestNeighborMatcher` does.
    """

    def __call__(self, features0: Features, features1: Features, /) -> Matches: ...


@value
class NearestNeighborMatcher:
    """Nearest neighbors with their ratio; settings as in `mfvpr.match` and `mfvpr.filter_matches`.

        matcher = mfvpr.NearestNeighborMatcher(cross_check="mutual", max_distance=0.7, max_matches=500)

    `chunk_size` and `product` are those of `match_candidates`: they change time, memory, and ties within rounding.
    """

    cross_check: CrossCheck = setting(
        "mutual", word_of(CrossCheck), "candidate: the nearest of every candidate keypoint, of SSM-VPR", static=True
    )
    max_distance: float | None = setting(None, number(1e-6, 2) | None, "keep matches at most this far apart, in (0, 2]")
    max_matches: int | None = setting(
        None, COUNT | None, "keep at most this number of matches, the closest ones; null = all", static=True
    )
    chunk_size: int | None = setting(None, COUNT | None, CHUNK_SIZE, static=True)
    product: Product | None = field(default=None, metadata={"static": True, "recipe": False})

    def __post_init__(self) -> None:
        check_fields(self)
        if self.product is not None:
            require_word("product", self.product, Product)

    def prepare(self, queries: Features, candidates: Features, chunk_size: int) -> Query:
        options = candidates, self.cross_check, chunk_size, self.product
        return jax.vmap(lambda query: prepare_query(query, *options))(queries)

    def __call__(self, features0: Features | Query, features1: Features) -> Matches:
        """Matches of one pair, with the slots `[K]` of `match`."""
        query = features0 if isinstance(features0, Query) else Query(ready(features0))
        matches = match_prepared(query, features1, cross_check=self.cross_check, with_ratio=True)
        return filter_matches(matches, max_distance=self.max_distance, max_matches=self.max_matches)


@value
class LightGlueMatcher:
    """Mutual maxima of LightGlue's assignment that are above a threshold.

        matcher = LightGlueMatcher.of(load_model("aliked_lightglue"), depth_confidence=0.95)

    The assignment is the `confidence` of a match; `distance` and `ratio` are those of the descriptors, as in
    `mfvpr.match`. The published weights are for ALIKED's features of 128 dimensions, and useless for other features.

    Attributes:
        network: recipe of the network that the weights belong to.
        filter_threshold: a match is kept if its assignment is larger.
        depth_confidence: skip the remaining layers of a pair once more than this share of its keypoints is confident,
            which loses a third of the matches on photographs; None = never. The public code uses 0.95 by default, and
            prunes keypoints: matches equal those of its `width_confidence=-1`.
        chunk_size: see `mfvpr.Matcher`; changes only memory, time and the last bits.
    """

    weights: "Packed"
    network: str = field(metadata={"static": True})
    filter_threshold: float = setting(
        0.1, number(0, 1), "matches are kept whose assignment, their confidence, is above it"
    )
    depth_confidence: float | None = setting(
        None, number(0, 1) | None, "leave layers out once more than this share of keypoints is sure; null = never"
    )
    chunk_size: int | None = setting(None, COUNT | None, CHUNK_SIZE, static=True)

    __repr__ = short_repr

    def __post_init__(self) -> None:
        check_fields(self)

    @classmethod
    def of(cls, model: "LightGlue", **options: Any) -> "LightGlueMatcher":
        """Matcher from a model (`mfvpr.checkpoints.load_model`) and further attributes."""
        return cls(jax.jit(type(model).pack)(model), fingerprint(recipe_of(model)), **options)

    @property
    def dimension(self) -> int:
        return self.weights.input.kernel.shape[0]

    @property
    def recipe(self) -> dict[str, Any]:
        """Everything that matches depend on; packed weights vary in the last bits between machines."""
        return {name: getattr(self, name) for name in ("network", "filter_threshold", "depth_confidence")}

    def __call__(self, features0: Features, features1: Features) -> Matches:
        """Matches of one pair: max(N0, 1) slots, slot k is keypoint k; an `InputError` for another `dimension`."""
        from mfvpr.networks.lightglue import assignment

        features0, features1 = (ready(at_least_one(features)) for features in (features0, features1))
        for features in (features0, features1):
            if (got := features.descriptors.shape[-1]) != self.dimension:
                got = f"{got}; take the features that its weights are for"
                raise InputError(f"LightGlue: expected descriptors of {self.dimension} dimensions, got {got}")
        assigned = assignment(self.weights, features0, features1, depth_confidence=self.depth_confidence)
        best1, best0 = largest_of(lines_of(assigned, axis=1)), largest_of(lines_of(assigned, axis=0))
        confidence = jnp.exp(best1.similarity)
        mutual = best0.index[best1.index] == jnp.arange(features0.mask.shape[-1], dtype=jnp.int32)
        real = mutual & (confidence > self.filter_threshold) & (best1.similarity > -jnp.inf)
        ratio = distance_ratio(features0, features1)
        return make_matches(features0, features1, best1.index, real, confidence=confidence, ratio=ratio)


def soft_match(features0: Features, features1: Features, *, temperature: float | Float[Array, ""]) -> Matches:
    """Smooth version of `match`: a dual softmax over the similarities s_ij.

        matches = mfvpr.soft_match(features0, features1, temperature=0.1)

    See Rocco et al., NeurIPS 2018. Let R and C be the softmax of s / T over the candidate's keypoints j and over the
    query's keypoints i. Slot i holds the means of points, scores and squared distances 2 - 2 s_ij under R, with
    confidence sum_j R_ij C_ij. For T -> 0 this is `match`, with confidence 1 if the neighbor is mutual, else 0.

    Args:
        features0: query, keypoints `[N0, 2]`; padding may hold anything.
        features1: candidate, keypoints `[N1, 2]`.
        temperature: T, in units of the similarity, which lies in [-1, 1]; not above 0 gives NaN.

    Returns:
        Matches with K = N0 slots; a slot is real if its keypoint has a finite descriptor, and the candidate has any.
    """
    features0, features1 = ready(features0), ready(at_least_one(features1))
    real0, real1 = (f.mask & jnp.all(jnp.isfinite(f.descriptors), axis=-1) for f in (features0, features1))
    similarity = products(masked(features0.descriptors, real0), masked(features1.descriptors, real1))
    logits = similarity / positive(temperature, similarity.dtype)
    real = real0[:, None] & real1[None]
    # With -inf, the softmax and its gradient would be NaN where no entry is real.
    lowest = jnp.where(real, logits, jnp.finfo(logits.dtype).min)
    rows, columns = (masked(jax.nn.softmax(lowest, axis=axis), real) for axis in (1, 0))
    return Matches(
        points0=features0.keypoints,
        points1=products(rows, masked(as_float(features1.keypoints), real1).T),
        distance=safe_sqrt(2 - 2 * jnp.sum(rows * similarity, axis=1)),
        scores0=features0.scores,
        scores1=jnp.sum(rows * masked(as_float(features1.scores), real1)[None], axis=1),
        mask=jnp.any(real, axis=1),
        image_size0=features0.image_size,
        image_size1=features1.image_size,
        confidence=jnp.minimum(jnp.sum(rows * columns, axis=1), 1.0),  # rounding may exceed 1
        index0=jnp.arange(features0.mask.shape[-1], dtype=jnp.int32),
        count0=jnp.sum(features0.mask, dtype=jnp.int32),
        count1=jnp.sum(features1.mask, dtype=jnp.int32),
    )


NEIGHBORS = NearestNeighborMatcher()


def match_pairs(
    queries: Features,
    candidates: Features,
    pairs: Int[Array, "pairs 2"],
    count: int | Int[Array, ""],
    matcher: Matcher = NEIGHBORS,
) -> Matches:
    """Match the first `count` pairs of images; another count needs no new program, and unused pairs cost no time.

        mfvpr.match_pairs(queries, candidates, np.array([[0, 2], [1, 0]], np.int32), count=2)  # [P, K]

    Args:
        queries: keypoints `[B, N0, 2]`.
        candidates: keypoints `[S, N1, 2]`.
        pairs: int32 rows of queries and candidates, `[P, 2]`; an `InputError` if there are no such images. Traced rows
            are not checked: JAX takes the nearest row.

    Returns:
        Matches with leading axis P and the slots of the matcher; pairs beyond `count` have no matches.
    """
    pairs, images = as_array(pairs), (len(queries.mask), len(candidates.mask))
    if np.ndim(pairs) != 2 or not len(pairs) or np.shape(pairs)[1] != 2:
        raise InputError(f"pairs: expected rows of queries and candidates [P, 2], got shape {np.shape(pairs)}")
    if is_concrete(pairs) and ((np.asarray(pairs) < 0) | (np.asarray(pairs) >= images)).any():
        got = f"rows from {np.min(pairs)} to {np.max(pairs)}"
        raise InputError(f"pairs: expected rows of {images[0]} queries and {images[1]} candidates, got {got}")
    chunk_size = pairs_at_once(getattr(matcher, "chunk_size", None), queries, candidates)
    matches = _match_pairs(queries, candidates, pairs, count, matcher, chunk_size=min(chunk_size, len(pairs)))
    if is_concrete(matches.image_size0) or not is_concrete((pairs, queries.image_size, candidates.image_size)):
        return matches
    sizes = (np.asarray(side.image_size)[pairs[:, place]] for place, side in enumerate((queries, candidates)))
    return with_concrete_sizes(matches, *sizes)


@partial(compiled, static_argnames="chunk_size")
def _match_pairs(
    queries: Features, candidates: Features, pairs: Array, count: Array, matcher: Matcher, *, chunk_size: int
) -> Matches:
    prepare = getattr(matcher, "prepare", None)
    sides = queries if prepare is None else prepare(queries, candidates, chunk_size), candidates

    def match_pair(pair: Array) -> Matches:
        query, candidate = (
            jax.tree.map(lambda field: jnp.asarray(field)[row], features)  # noqa: B023
            for features, row in zip(sides, pair, strict=True)
        )
        return matcher(query, candidate)

    def chunk(number: Array, matches: Matches) -> Matches:
        start = jnp.minimum(number * chunk_size, len(pairs) - chunk_size)  # the last chunk may repeat pairs
        part = jax.lax.dynamic_slice_in_dim(jnp.asarray(pairs), start, chunk_size)
        if chunk_size > 1:
            new = jax.vmap(match_pair)(part)
        else:
            new = jax.tree.map(lambda leaf: leaf[None], match_pair(part[0]))
        return jax.tree.map(partial(jax.lax.dynamic_update_slice_in_dim, start_index=start, axis=0), matches, new)

    shapes = jax.eval_shape(jax.vmap(match_pair), pairs)
    empty = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    matches = jax.lax.fori_loop(0, -(-count // chunk_size), chunk, empty)
    return replace(matches, mask=matches.mask & (jnp.arange(len(pairs)) < count)[:, None])
