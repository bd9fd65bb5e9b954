"""The filter: global descriptors -> Shortlist, by exact search."""

from functools import partial

import jax
import jax.numpy as jnp

from mfvpr.numerics import at_least_single, compiled, masked
from mfvpr.types import Array, Shortlist


@partial(compiled, static_argnames="num_candidates")
def retrieve(
    query_descriptors: Array, database_descriptors: Array, *, num_candidates: int, mask: Array | None = None
) -> Shortlist:
    """The database images most similar to each query.

    Args:
        query_descriptors: `[Q, D]`, unit length.
        database_descriptors: `[N, D]`, unit length.
        num_candidates: C; beyond N the shortlist ends in -1.
        mask: `[N]` or `[Q, N]` bool, False for database images that must not appear (for that query).

    Returns:
        Shortlist `[Q, C]` by descending cosine similarity; the first row wins a tie. A database image whose
        descriptor is not finite never appears; a query whose own is not finite gets an empty shortlist.
    """
    queries, database = at_least_single(query_descriptors), at_least_single(database_descriptors)
    similarity = jnp.matmul(queries, database.T, precision=jax.lax.Precision.HIGHEST)
    usable = jnp.isfinite(similarity) if mask is None else jnp.isfinite(similarity) & jnp.atleast_2d(mask)
    depth = min(num_candidates, database_descriptors.shape[0])
    scores, indices = jax.lax.top_k(masked(similarity, usable, -jnp.inf), depth)
    padding = ((0, 0), (0, num_candidates - depth))
    scores = jnp.pad(scores, padding, constant_values=-jnp.inf)
    found = scores > -jnp.inf
    return Shortlist(
        indices=jnp.where(found, jnp.pad(indices.astype(jnp.int32), padding), -1),
        scores=masked(scores, found),
        mask=found,
    )
