"""The filter: global descriptors -> Shortlist, by exact search in chunks, and what is fitted on the database before."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np

from mfvpr.datasets.positives import Positives
from mfvpr.types import Array, Shortlist
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import at_least_single, compiled, device_of, free_bytes, masked
from mfvpr.utils.ragged import filled
from mfvpr.utils.whitening import Whitening, fit_whitening

SHARE = 1 / 16  # of the free memory, for the similarities that exist at the same time
ROWS = 2**16  # of the database at a time, whatever the memory and the queries: their sums depend on it in the last bits


class Search(Protocol):
    """How candidates are found by global descriptors."""

    def fit(self, database: np.ndarray) -> "Search":
        """The same, knowing what it must of the database's descriptors `[N, D]`."""
        ...

    def shortlist(
        self, queries: np.ndarray, database: np.ndarray, num_candidates: int, *, excluded: Positives | None = None
    ) -> Shortlist:
        """Candidates `[Q, C]`, NumPy, of queries `[Q, D]` among the database `[N, D]`, without those `excluded`."""
        ...


@dataclass(frozen=True)
class ExactSearch:
    """The largest dot products, as `retrieve` finds them, whatever the chunks.

    Attributes:
        memory: GB of similarities that may exist at the same time, those of two queries with 65,536 rows at least; None
            = a sixteenth of what is free. No bit depends on it.
        spread: finds the same in another way, as `mfvpr.evaluation.distributed.retrieve_everywhere`; None = on one
            device.
    """

    memory: float | None = None
    spread: Callable[..., Shortlist] | None = field(default=None, metadata={"recipe": False})

    def fit(self, database: np.ndarray) -> "ExactSearch":
        """Itself: it need not know the database."""
        return self

    def shortlist(
        self, queries: np.ndarray, database: np.ndarray, num_candidates: int, *, excluded: Positives | None = None
    ) -> Shortlist:
        """See `Search`; descriptors are of unit length, or their dot products mean what they mean."""
        if queries.shape[1] != database.shape[1]:
            raise InputError(f"global descriptors: expected as many numbers on both sides, got {queries.shape[1]} for "
                             f"queries and {database.shape[1]} for the database")  # fmt: skip
        if not len(queries) or not len(database):
            raise InputError(f"global descriptors: expected at least one on both sides, got {len(queries)} of queries "
                             f"and {len(database)} of the database")  # fmt: skip
        if excluded is not None and (len(excluded), excluded.num_database) != (len(queries), len(database)):
            raise InputError(f"excluded: expected rows for {len(queries)} queries and {len(database)} database images, "
                             f"got {len(excluded)} and {excluded.num_database}")  # fmt: skip
        if self.spread is not None:
            return self.spread(queries, database, num_candidates=num_candidates, excluded=excluded)
        some = self._at_a_time(len(queries), min(len(database), ROWS))
        parts = []
        for part in _parts(len(queries), some):
            allowed = None if excluded is None else filled(~excluded.dense(part), some)
            found = _shortlist(filled(queries[part], some), database, num_candidates, allowed)
            parts.append(jax.tree.map(lambda field: field[: part.stop - part.start], found))  # noqa: B023
        return jax.tree.map(lambda *fields: np.concatenate(fields), *parts)

    def _at_a_time(self, num_queries: int, num_rows: int) -> int:
        """Queries whose similarities to so many rows fit, two at least; parts of as many queries are alike."""
        available = SHARE * free_bytes(device_of(())) if self.memory is None else 1e9 * self.memory
        fitting = max(2, int(available) // 8 // num_rows)  # a similarity, and what becomes of it
        return -(-num_queries // -(-num_queries // fitting))


EXACT = ExactSearch()


@dataclass(frozen=True)
class WhitenedSearch:
    """Search by the principal components of the database's descriptors, each of unit variance; then of unit length.

    (Jegou & Chum, ECCV 2012.) What the database lacks in variance, the queries lose.

    Attributes:
        dimension: D' components that are kept.
        max_samples: descriptors to learn from, at most: evenly spread over the database.
        search: among what comes out.
    """

    dimension: int
    max_samples: int = 4096
    search: Search = EXACT

    def __post_init__(self) -> None:
        """Refuse what keeps nothing."""
        if self.dimension < 1:
            raise InputError(f"whitening: dimension={self.dimension}: expected at least 1")

    def fit(self, database: np.ndarray) -> Search:
        """The components of a database `[N, D]`.

        Raises:
            InputError: there are fewer finite descriptors, or fewer numbers in each, than components.
        """
        usable = database[np.isfinite(database).all(axis=1)]
        rows = np.linspace(0, len(usable) - 1, min(len(usable), self.max_samples)).astype(int)
        sample = usable[rows].astype(np.float64)
        fitted = fit_whitening(sample, self.dimension)
        single = Whitening(fitted.mean.astype(np.float32), fitted.components.astype(np.float32))
        return Whitened(single, self.search)

    def shortlist(
        self, queries: np.ndarray, database: np.ndarray, num_candidates: int, *, excluded: Positives | None = None
    ) -> Shortlist:
        """See `Search`; fitted here."""
        return self.fit(database).shortlist(queries, database, num_candidates, excluded=excluded)


@dataclass(frozen=True)
class Whitened:
    """`WhitenedSearch` that knows its database."""

    whitening: Whitening
    search: Search

    def fit(self, database: np.ndarray) -> "Whitened":
        """Itself: fitted already."""
        return self

    def shortlist(
        self, queries: np.ndarray, database: np.ndarray, num_candidates: int, *, excluded: Positives | None = None
    ) -> Shortlist:
        """See `Search`."""
        queries, database = self._whitened(queries), self._whitened(database)
        return self.search.shortlist(queries, database, num_candidates, excluded=excluded)

    def _whitened(self, descriptors: np.ndarray) -> np.ndarray:
        mean, components = self.whitening.mean, self.whitening.components
        return np.concatenate([_whiten(descriptors[part], mean, components) for part in _parts(len(descriptors), ROWS)])


@compiled
def _whiten(descriptors: Array, mean: Array, components: Array) -> Array:
    """Principal components `[n, D']` of unit length. As in `retrieve`, those of a row do not depend on other rows."""
    rows = _at_least_two(at_least_single(descriptors))
    whitened = jnp.matmul(rows - mean[None], components.T, precision=jax.lax.Precision.HIGHEST)[: len(descriptors)]
    lengths = jnp.linalg.norm(whitened, axis=1, keepdims=True)
    return whitened / jnp.where(lengths > 0, lengths, 1)


def _shortlist(queries: np.ndarray, database: np.ndarray, num_candidates: int, allowed: np.ndarray | None) -> Shortlist:
    """Search for a part of the queries, `ROWS` of the database at a time; the first row wins a tie."""
    best: Shortlist | None = None
    for part in _parts(len(database), ROWS):
        mask = None if allowed is None else allowed[:, part]
        here = retrieve(queries, database[part], num_candidates=num_candidates, mask=mask)
        best = here if best is None else _best(best, here, part.start)
    return jax.tree.map(np.asarray, best)


@compiled
def _best(first: Shortlist, second: Shortlist, start: int) -> Shortlist:
    """The best of two shortlists `[Q, C]`, the second of the rows from `start` on; the first one's win ties."""
    second = replace(second, indices=jnp.where(second.mask, second.indices + start, -1))
    both = jax.tree.map(lambda *fields: jnp.concatenate(fields, axis=1), first, second)
    _, place = jax.lax.top_k(masked(both.scores, both.mask, -jnp.inf), first.mask.shape[1])
    return jax.tree.map(lambda field: jnp.take_along_axis(field, place, axis=1), both)


def _parts(total: int, size: int) -> Iterator[slice]:
    return (slice(start, min(start + size, total)) for start in range(0, total, size))


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
        descriptor is not finite never appears; a query whose own is not finite gets an empty shortlist. On a CPU the
        scores of a query do not depend on the other queries, in any bit.
    """
    queries, database = at_least_single(query_descriptors), at_least_single(database_descriptors)
    similarity = jnp.matmul(_at_least_two(queries), _at_least_two(database).T, precision=jax.lax.Precision.HIGHEST)
    similarity = similarity[: len(queries), : len(database)]
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


def _at_least_two(rows: Array) -> Array:
    """Rows `[n, D]`, a single one with zeros: its products would be summed in another order than those of several."""
    return jnp.pad(rows, ((0, max(0, 2 - len(rows))), (0, 0)))
