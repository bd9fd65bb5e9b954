"""SSM-VPR's filter (Camara & Preucil, RAS 2020): windows of the query vote for the images of their nearest windows."""

from dataclasses import dataclass

import numpy as np

from mfvpr.datasets.datasets import ImageFolder, QuerySequence
from mfvpr.datasets.positives import Positives
from mfvpr.features.ssm import SsmWindows
from mfvpr.retrieval.fitting import fitted
from mfvpr.retrieval.retriever import Filtered
from mfvpr.retrieval.search import EXACT, ExactSearch
from mfvpr.storage.feature_cache import Archive
from mfvpr.types import Shortlist

QUERIES = 64  # at a time: their windows' nearest ones are listed together


@dataclass(frozen=True)
class SsmVoting:
    """Candidates by votes: each of the C nearest windows of the database, of each window of the query, is one.

    The public code's order among images of equal votes is that of an unstable sort; here the lowest row comes first.
    Images without votes fill the shortlist up.

    Attributes:
        describer: what gives the windows of an image.
        search: the memory of the search for the nearest.
    """

    describer: SsmWindows
    search: ExactSearch = EXACT

    def shortlist(
        self, sequence: QuerySequence, database: ImageFolder, num_candidates: int, archive: Archive
    ) -> Filtered:
        """See `mfvpr.retrieval.retriever.Filter`; scores are votes."""
        describer = fitted(self.describer, database, archive)
        database_vectors = archive.vectors(database, describer, database, label="database")
        query_vectors = archive.vectors(sequence.images, describer, database, label=f"query {sequence.name}")
        shape = (-1, describer.windows.count, describer.whitening.dimension)
        queries, windows = query_vectors.values.reshape(shape), database_vectors.values.reshape(shape)
        candidates = voted(queries, windows, num_candidates, excluded=sequence.excluded, search=self.search)
        return Filtered(candidates, query_vectors.bad, database_vectors.bad)


def voted(
    queries: np.ndarray,
    database: np.ndarray,
    num_candidates: int,
    *,
    excluded: Positives | None = None,
    search: ExactSearch = EXACT,
) -> Shortlist:
    """Candidates `[Q, C]` by votes, NumPy: most votes first, among equal ones the lowest row.

    Args:
        queries: `[Q, V, D]` windows; a query that has one that is not finite gets no candidates.
        database: `[N, V, D]`; an image that has one that is not finite is no candidate.
        num_candidates: C, and the neighbors of each window that vote.
        excluded: images that each query may not find: their windows do not vote.
        search: how many similarities may exist at the same time.
    """
    usable0, usable1 = (np.asarray(np.isfinite(side).all(axis=(1, 2))) for side in (queries, database))
    windows = np.where(usable1[:, None, None], database, np.nan).reshape(-1, database.shape[2])
    squares = np.einsum("nd,nd->n", windows, windows, dtype=np.float64)
    windows = np.concatenate([windows, -squares[:, None] / 2], axis=1).astype(np.float32)
    indices = np.full((len(queries), num_candidates), -1, np.int32)
    scores = np.zeros(indices.shape, np.float32)
    for start in range(0, len(queries), QUERIES):
        part = slice(start, start + QUERIES)
        refused = ~(usable0[part, None] & usable1[None])
        hidden = None
        if excluded is not None:
            refused |= excluded.dense(part)
            hidden = _windows_of(excluded.take(part), database.shape[1])
        votes = _votes(queries[part], windows, num_candidates, hidden, search)
        votes = np.where(refused, -1, votes)
        order = np.argsort(-votes, axis=1, kind="stable")[:, :num_candidates]
        counts = np.take_along_axis(votes, order, axis=1)
        indices[part, : order.shape[1]] = np.where(counts < 0, -1, order)
        scores[part, : order.shape[1]] = np.maximum(counts, 0)
    return Shortlist(indices, scores, indices >= 0)


def _votes(
    queries: np.ndarray, windows: np.ndarray, num_neighbors: int, excluded: Positives | None, search: ExactSearch
) -> np.ndarray:
    """`[q, N]` of some queries `[q, V, D]`; windows `[N * V, D + 1]` end in minus half their square.

    The nearest b to a is that of the largest a . b - |b|^2 / 2.
    """
    number, per_image, _ = queries.shape
    num_images = len(windows) // per_image
    asking = np.concatenate([queries, np.ones((number, per_image, 1), np.float32)], axis=2)
    nearest = search.shortlist(asking.reshape(number * per_image, -1), windows, num_neighbors, excluded=excluded)
    images = np.where(nearest.mask, nearest.indices // per_image, num_images).reshape(number, -1)
    places = images + (num_images + 1) * np.arange(number)[:, None]
    return np.bincount(places.reshape(-1), minlength=number * (num_images + 1)).reshape(number, -1)[:, :num_images]


def _windows_of(excluded: Positives, per_image: int) -> Positives:
    """For every window of every query, all windows of the images that the query may not find."""
    own = np.arange(per_image)
    rows = [(images[:, None] * per_image + own).reshape(-1) for images in map(excluded.of, range(len(excluded)))]
    return Positives.from_rows((some for some in rows for _ in own), excluded.num_database * per_image)
