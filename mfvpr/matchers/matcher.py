"""Matchers of one pair of images as values, and compiled matching of many pairs."""

from dataclasses import field, replace
from functools import partial
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from mfvpr.core.matching import filter_matches, match_prepared, pairs_at_once, prepare_query, with_concrete_sizes
from mfvpr.core.nearest import CrossCheck, Product, Query, ready
from mfvpr.core.types import Array, Features, Matches, value
from mfvpr.utils.errors import InputError, require_word
from mfvpr.utils.fields import COUNT, check_fields, number, setting, word_of
from mfvpr.utils.numerics import as_array, compiled, is_concrete

CHUNK_SIZE = "pairs matched at once; null = 1 on a CPU, elsewhere what a small part of its memory holds"


class Matcher(Protocol):
    """Function of the features `[N0]` of a query and `[N1]` of a candidate that returns their Matches.

        def near(features0, features1):
            return mfvpr.filter_matches(mfvpr.match(features0, features1), max_distance=0.7)

        pipeline = mfvpr.Pipeline(extractor, retriever, matcher=near)

    It must work under `jit` and `vmap`: slots depend on shapes alone, and the content of padding has no effect, NaN
    included. A matcher is a value (`mfvpr.value`); its arrays, such as the weights of a network, are fields. A cache
    on disk needs a `recipe`, see `mfvpr.utils.recipe_of`. An optional field `chunk_size` is the number of pairs that
    are matched at the same time; without it, or if None, memory decides, assuming one similarity matrix per pair.

    An optional method `prepare(queries, candidates, chunk_size)` does once per query what would be done for each of its
    pairs. It takes Features `[B, N0]` and `[S, N1]`, and returns what the matcher then takes in place of a query's
    Features: arrays with the leading axis B. A matcher must take plain Features as well, with which other functions
    call it, as `NearestNeighborMatcher` does.
    """

    def __call__(self, features0: Features, features1: Features, /) -> Matches: ...


@value
class NearestNeighborMatcher:
    """Nearest neighbors with their ratio; settings as in `mfvpr.match` and `mfvpr.filter_matches`.

        matcher = mfvpr.NearestNeighborMatcher(cross_check="mutual", max_distance=0.7, max_matches=500)

    `chunk_size` and `product` are those of `match_candidates`; they change only time, memory, and
    which of two neighbors is taken whose products differ by less than the rounding of float32.
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
        """The queries `[B, N0]` in the form that matching needs."""
        options = candidates, self.cross_check, chunk_size, self.product
        return jax.vmap(lambda query: prepare_query(query, *options))(queries)

    def __call__(self, features0: Features | Query, features1: Features) -> Matches:
        """Matches of one pair, with the slots `[K]` of `match`."""
        query = features0 if isinstance(features0, Query) else Query(ready(features0))
        matches = match_prepared(query, features1, cross_check=self.cross_check, with_ratio=True)
        return filter_matches(matches, max_distance=self.max_distance, max_matches=self.max_matches)


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
    pairs = as_array(pairs)
    _require_rows(pairs, queries, candidates)
    chunk_size = pairs_at_once(getattr(matcher, "chunk_size", None), queries, candidates)
    matches = _match_pairs(queries, candidates, pairs, count, matcher, chunk_size=min(chunk_size, len(pairs)))
    if is_concrete(matches.image_size0) or not is_concrete((pairs, queries.image_size, candidates.image_size)):
        return matches
    sizes = (np.asarray(side.image_size)[pairs[:, place]] for place, side in enumerate((queries, candidates)))
    return with_concrete_sizes(matches, *sizes)


def _require_rows(pairs: Int[Array, "pairs 2"], queries: Features, candidates: Features) -> None:
    """Raise an InputError unless the rows of pairs exist; JAX would take the nearest row."""
    images = len(queries.mask), len(candidates.mask)
    if np.ndim(pairs) != 2 or not len(pairs) or np.shape(pairs)[1] != 2:
        raise InputError(f"pairs: expected rows of queries and candidates [P, 2], got shape {np.shape(pairs)}")
    if is_concrete(pairs) and ((np.asarray(pairs) < 0) | (np.asarray(pairs) >= images)).any():
        raise InputError(
            f"pairs: expected rows of {images[0]} queries and {images[1]} candidates, got rows from "
            f"{np.min(pairs)} to {np.max(pairs)}"
        )


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
