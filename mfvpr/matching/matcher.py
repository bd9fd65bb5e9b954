"""What matches one pair of images, as a value; and pairs of many images, whatever matches them."""

from collections.abc import Callable
from dataclasses import field, replace
from functools import partial

import jax
import jax.numpy as jnp

from mfvpr.matching.nearest_neighbors import CrossCheck, filter_matches, match, pairs_at_once
from mfvpr.types import Array, Features, Matches, value
from mfvpr.utils.numerics import compiled

Matcher = Callable[[Features, Features], Matches]
"""Features of a query and of a candidate -> their Matches, pure, so that it may be compiled and batched.

Slots depend on shapes alone, and what padding holds must not matter, NaN included. A matcher is a value (`mfvpr.value`)
whose arrays, such as the weights of a network, are fields; with a store its recipe is needed, see
`mfvpr.utils.fingerprints.recipe_of`. A field `chunk_size` says how many pairs are matched at the same time; without
one, or None, memory decides as if a pair took one matrix of similarities.
"""


@value
class Matching:
    """Nearest neighbors with their ratio, see `mfvpr.match` and `mfvpr.filter_matches`.

    Attributes:
        cross_check: as in `match`.
        max_distance: as in `filter_matches`.
        max_matches: as there.
        chunk_size: as in `match_candidates`; it changes memory and the last bits alone.
    """

    cross_check: CrossCheck = field(default="mutual", metadata={"static": True})
    max_distance: float | None = None
    max_matches: int | None = field(default=None, metadata={"static": True})
    chunk_size: int | None = field(default=None, metadata={"static": True})

    def __call__(self, features0: Features, features1: Features) -> Matches:
        """Of one pair; slots as of `match`."""
        matches = match(features0, features1, cross_check=self.cross_check, with_ratio=True)
        return filter_matches(matches, max_distance=self.max_distance, max_matches=self.max_matches)


NEIGHBORS = Matching()


def match_pairs(
    queries: Features, candidates: Features, pairs: Array, count: int | Array, matcher: Matcher = NEIGHBORS
) -> Matches:
    """Matches of pairs, whatever query they belong to; how many is no shape, so it costs neither time nor a program.

    Args:
        queries: keypoints `[B, N0, 2]`.
        candidates: keypoints `[S, N1, 2]`.
        pairs: `[P, 2]` int32 rows of both.
        count: the first so many of the pairs are matched.
        matcher: of one pair.

    Returns:
        Matches with leading axis P and slots as of the matcher; pairs beyond `count` have none.
    """
    chunk_size = pairs_at_once(getattr(matcher, "chunk_size", None), queries, candidates)
    return _match_pairs(queries, candidates, pairs, count, matcher, chunk_size=min(chunk_size, len(pairs)))


@partial(compiled, static_argnames="chunk_size")
def _match_pairs(
    queries: Features, candidates: Features, pairs: Array, count: Array, matcher: Matcher, *, chunk_size: int
) -> Matches:
    def one(pair: Array) -> Matches:
        query, candidate = (
            jax.tree.map(lambda field: jnp.asarray(field)[row], features)  # noqa: B023
            for features, row in ((queries, pair[0]), (candidates, pair[1]))
        )
        return matcher(query, candidate)

    def chunk(number: Array, matches: Matches) -> Matches:
        start = jnp.minimum(number * chunk_size, len(pairs) - chunk_size)  # the last may do some again
        part = jax.lax.dynamic_slice_in_dim(jnp.asarray(pairs), start, chunk_size)
        new = jax.vmap(one)(part) if chunk_size > 1 else jax.tree.map(lambda leaf: leaf[None], one(part[0]))
        return jax.tree.map(partial(jax.lax.dynamic_update_slice_in_dim, start_index=start, axis=0), matches, new)

    shapes = jax.eval_shape(jax.vmap(one), pairs)
    nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    matches = jax.lax.fori_loop(0, -(-count // chunk_size), chunk, nothing)
    return replace(matches, mask=matches.mask & (jnp.arange(len(pairs)) < count)[:, None])
