"""Search by global descriptors -> Shortlist: exact, in chunks, optionally after whitening."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from mfvpr.core.types import Array, Shortlist
from mfvpr.datasets.positives import Positives
from mfvpr.features.whitening import Whitening, fit_whitening
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import as_array, at_least_single, compiled, device_of, free_bytes, masked, repeat_last

SHARE = 1 / 16  # of the free memory, for the similarities that exist at the same time
ROWS = 2**16  # database rows at a time on a CPU; fixed, because the last bits of the similarities depend on it
ROWS_SHARE = 1 / 4  # of an accelerator's free memory, for the database rows there
BLOCK = 128  # database rows, of which an accelerator first looks at the largest similarity
MAX_SAMPLES = 4096  # descriptors, evenly spread over the database, that a whitening is learned from

Queries = Float[np.ndarray, "queries dimensions"]
Database = Float[np.ndarray, "database dimensions"]


@dataclass(frozen=True)
class ExactSearch:
    """Search for the largest dot products in chunks that fit into memory, with the result of `retrieve`.

    Of equal descriptors in different blocks of 65,536 database rows, any may come first: last bits depend on the block.
    """

    def fit(self, database: Database) -> "ExactSearch":  # there is nothing to learn
        return self

    def shortlist(
        self, queries: Queries, database: Database, num_candidates: int, *, excluded: Positives | None = None
    ) -> Shortlist:
        """Candidates of queries in the database, NumPy; images in `excluded` are no candidates of their queries."""
        if excluded is not None and (len(excluded), excluded.num_database) != (len(queries), len(database)):
            expected, got = f"{len(queries)} queries and {len(database)} images", len(excluded)
            raise InputError(f"excluded: expected rows of {expected}, got {got} and {excluded.num_database}")
        device = device_of(())
        num_rows = ROWS
        if device.platform != "cpu":  # as many as fit, since every part costs a wait
            num_rows = max(ROWS, int(ROWS_SHARE * free_bytes(device)) // (4 * database.shape[1]))
        num_rows = min(len(database), num_rows)
        # Queries at a time, at least 2, with similarities that fit: 8 bytes for one and its masked copy.
        fitting = max(2, int(SHARE * free_bytes(device)) // 8 // num_rows)
        chunk_size = -(-len(queries) // -(-len(queries) // fitting))
        shortlists: dict[int, Shortlist] = {}  # by the first query of a chunk
        for rows in _parts(len(database), num_rows):
            on_device = jax.device_put(as_array(database[rows]))  # once for all chunks
            for part in _parts(len(queries), chunk_size):
                mask = None if excluded is None else repeat_last(~excluded.dense(part)[:, rows], chunk_size)
                chunk = repeat_last(queries[part], chunk_size)
                shortlist = retrieve(chunk, on_device, num_candidates=num_candidates, mask=mask)
                best = shortlists.get(part.start)
                shortlist = shortlist if best is None else _best(best, shortlist, rows.start)
                shortlists[part.start] = jax.device_get(shortlist)  # waits: one chunk at a time
        joined = jax.tree.map(lambda *fields: np.concatenate(fields), *shortlists.values())
        return jax.tree.map(lambda field: field[: len(queries)], joined)


EXACT = ExactSearch()


@dataclass(frozen=True)
class WhitenedSearch:
    """Search by whitened descriptors: principal components of the database (Jegou & Chum, ECCV 2012).

    Components have unit variance; together they are scaled to unit length.
    """

    dimension: int  # D', number of components
    whitening: Whitening | None = None  # the learned components; None = `shortlist` learns them from the database

    def fit(self, database: Database) -> "WhitenedSearch":
        """Search with the principal components of a database; itself if they were learned."""
        if self.whitening is not None:
            return self
        usable = database[np.isfinite(database).all(axis=1)]
        rows = np.linspace(0, len(usable) - 1, min(len(usable), MAX_SAMPLES)).astype(int)
        fitted = fit_whitening(usable[rows].astype(np.float64), self.dimension)
        single = Whitening(fitted.mean.astype(np.float32), fitted.components.astype(np.float32))
        return replace(self, whitening=single)

    def shortlist(
        self, queries: Queries, database: Database, num_candidates: int, *, excluded: Positives | None = None
    ) -> Shortlist:
        learned = self.whitening or self.fit(database).whitening
        assert learned is not None
        whiten = partial(_project, mean=learned.mean, components=learned.components)
        queries, database = (
            np.concatenate([whiten(side[part]) for part in _parts(len(side), ROWS)]) for side in (queries, database)
        )
        return EXACT.shortlist(queries, database, num_candidates, excluded=excluded)


@compiled
def _project(
    descriptors: Float[Array, "images _"], mean: Float[Array, " _"], components: Float[Array, "dimensions _"]
) -> Float[Array, "images dimensions"]:
    """Principal components of unit length; a row does not depend on the other rows."""
    rows = _at_least_two(at_least_single(descriptors))
    whitened = jnp.matmul(rows - mean[None], components.T, precision=jax.lax.Precision.HIGHEST)[: len(descriptors)]
    lengths = jnp.linalg.norm(whitened, axis=1, keepdims=True)
    return whitened / jnp.where(lengths > 0, lengths, 1)


@compiled
def _best(first: Shortlist, second: Shortlist, start: int) -> Shortlist:
    """Merge shortlists; rows of the second count from `start`; the first wins ties, so it also fills missing places."""
    second = replace(second, indices=second.indices + start)
    both = jax.tree.map(lambda *fields: jnp.concatenate(fields, axis=1), first, second)
    _, place = jax.lax.top_k(masked(both.scores, both.mask, -jnp.inf), first.mask.shape[1])
    return jax.tree.map(lambda field: jnp.take_along_axis(field, place, axis=1), both)


def _parts(total: int, size: int) -> Iterator[slice]:
    return (slice(start, min(start + size, total)) for start in range(0, total, size))


@partial(compiled, static_argnames="num_candidates")
def retrieve(
    query_descriptors: Float[Array, "queries dimensions"],
    database_descriptors: Float[Array, "database dimensions"],
    *,
    num_candidates: int,
    mask: Bool[Array, " database"] | Bool[Array, "queries database"] | None = None,
) -> Shortlist:
    """Find the database images that are most similar to each query.

        shortlist = mfvpr.retrieve(query_descriptors, database_descriptors, num_candidates=50)

    Args:
        query_descriptors, database_descriptors: unit length. For several calls, put the database on the device once
            (`jax.device_put`): NumPy's arrays are copied at every call.
        num_candidates: if there are fewer database images, the shortlist ends in -1.
        mask: False for database images that must not appear (for that query); another shape raises an `InputError`.

    Returns:
        Shortlist by descending cosine similarity; the first row wins a tie. A database image with a descriptor
        that is not finite never appears; a query with one has an empty shortlist. On a CPU the scores of a query do
        not depend on the other queries, in any bit.
    """
    shapes = [(len(database_descriptors),), (len(query_descriptors), len(database_descriptors))]
    if mask is not None and mask.shape not in shapes:
        raise InputError(f"mask: expected shape {shapes[0]} or {shapes[1]}, got {mask.shape}")
    queries, database = at_least_single(query_descriptors), at_least_single(database_descriptors)
    if queries.ndim != 2 or database.ndim != 2 or queries.shape[1] != database.shape[1]:
        got = f"{queries.shape} and {database.shape}"
        raise InputError(f"descriptors: expected [Q, D] and [M, D] of the database, got {got}")
    similarity = jnp.matmul(_at_least_two(queries), _at_least_two(database).T, precision=jax.lax.Precision.HIGHEST)
    similarity = similarity[: len(queries), : len(database)]
    usable = jnp.isfinite(similarity) if mask is None else jnp.isfinite(similarity) & jnp.atleast_2d(mask.astype(bool))
    depth = min(num_candidates, database_descriptors.shape[0])
    similarity, largest = masked(similarity, usable, -jnp.inf), partial(_largest, depth=depth)
    in_blocks = partial(_largest_in_blocks, depth=depth)
    scores, indices = jax.lax.platform_dependent(similarity, cpu=largest, default=in_blocks)
    padding = ((0, 0), (0, num_candidates - depth))
    scores = jnp.pad(scores, padding, constant_values=-jnp.inf)
    is_candidate = scores > -jnp.inf
    return Shortlist(
        indices=jnp.where(is_candidate, jnp.pad(indices.astype(jnp.int32), padding), -1),
        scores=masked(scores, is_candidate),
        mask=is_candidate,
    )


def _largest(values: Float[Array, "rows columns"], depth: int) -> tuple[Array, Array]:
    """The largest values of each row and their columns; the first column wins a tie."""
    largest, columns = jax.lax.top_k(values, depth)  # a list or a tuple, as JAX's version has it
    return largest, columns


def _largest_in_blocks(values: Float[Array, "rows columns"], depth: int) -> tuple[Array, Array]:
    """`_largest` by the largest values of blocks, since an accelerator would sort whole rows.

    The values are in the `depth` blocks with the largest maxima, the first of equal ones, or after the last block.
    """
    rows, columns = values.shape
    count = columns // BLOCK
    if count <= depth:
        return _largest(values, depth)
    maxima = jnp.max(values[:, : count * BLOCK].reshape(rows, count, BLOCK), axis=2)
    blocks = jnp.sort(_largest(maxima, depth)[1], axis=1)  # in their order, so that the first of equal values wins
    members = (blocks[:, :, None] * BLOCK + jnp.arange(BLOCK, dtype=jnp.int32)[None, None]).reshape(rows, -1)
    rest = jnp.tile(jnp.arange(count * BLOCK, columns, dtype=jnp.int32), (rows, 1))
    members = jnp.concatenate([members, rest], axis=1)
    largest, places = _largest(jnp.take_along_axis(values, members, axis=1), depth)
    return largest, jnp.take_along_axis(members, places, axis=1)


def _at_least_two(rows: Float[Array, "_ dimensions"]) -> Float[Array, "_ dimensions"]:
    """Rows, a single row padded with zeros: its products would be summed in another order."""
    return jnp.pad(rows, ((0, max(0, 2 - len(rows))), (0, 0)))
