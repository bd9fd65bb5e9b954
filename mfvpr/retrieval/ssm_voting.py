"""Retrieval of SSM-VPR (Camara & Preucil, RAS 2020): query windows vote for the images of their nearest windows."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mfvpr.core.types import Shortlist
from mfvpr.datasets.datasets import ImageFolder, QuerySequence
from mfvpr.datasets.positives import Positives
from mfvpr.features.ssm_features import SsmWindows
from mfvpr.retrieval.fitting import fit_to_database
from mfvpr.retrieval.retriever import RetrievalResult
from mfvpr.retrieval.search import EXACT, ExactSearch
from mfvpr.storage.feature_cache import FeatureCache

QUERIES = 64  # searched at a time


@dataclass(frozen=True)
class SsmVoting:
    """Candidates by votes: each query window votes for the images of its C nearest database windows.

    Among images with equal votes the lowest row comes first; the public code's unstable sort leaves their order open.
    Images without votes fill the rest of the shortlist.
    """

    describer: SsmWindows
    search: ExactSearch = EXACT  # for the nearest windows

    def shortlist(
        self, sequence: QuerySequence, database: ImageFolder, num_candidates: int, cache: FeatureCache
    ) -> RetrievalResult:
        """See `mfvpr.retrieval.retriever.Retriever`; scores are votes."""
        describer = fit_to_database(self.describer, database, cache)
        database_vectors = cache.vectors(database, describer, database, label="database")
        query_vectors = cache.vectors(sequence.images, describer, database, label=f"query {sequence.name}")
        shape = (-1, describer.windows.count, describer.whitening.dimension)
        queries, windows = query_vectors.values.reshape(shape), database_vectors.values.reshape(shape)
        candidates = vote(queries, windows, num_candidates, excluded=sequence.excluded, search=self.search)
        return RetrievalResult(candidates, query_vectors.bad, database_vectors.bad)


def vote(
    queries: Float[np.ndarray, "queries windows dimensions"],
    database: Float[np.ndarray, "database windows dimensions"],
    num_candidates: int,
    *,
    excluded: Positives | None = None,
    search: ExactSearch = EXACT,
) -> Shortlist:
    """Candidates by votes, NumPy: most votes first, then the lowest row.

    Each query window votes for `num_candidates` windows. A query with a window that is not finite has no candidates; a
    database image with such a window is no candidate. Windows of `excluded` images get no votes.
    """
    usable0, usable1 = (np.asarray(np.isfinite(side).all(axis=(1, 2))) for side in (queries, database))
    windows = np.where(usable1[:, None, None], database, np.nan).reshape(-1, database.shape[2])
    squares = np.einsum("nd,nd->n", windows, windows, dtype=np.float64)
    windows = np.concatenate([windows, -squares[:, None] / 2], axis=1).astype(np.float32)
    indices = np.full((len(queries), num_candidates), -1, np.int32)
    scores = np.zeros(indices.shape, np.float32)
    for start in range(0, len(queries), QUERIES):
        part = slice(start, start + QUERIES)
        unusable = ~(usable0[part, None] & usable1[None])
        excluded_windows = None
        if excluded is not None:
            unusable |= excluded.dense(part)
            excluded_windows = _windows_of(excluded.take(part), database.shape[1])
        # The window b nearest to a maximizes (a, 1) . (b, -|b|^2 / 2).
        query_windows = np.pad(queries[part], ((0, 0), (0, 0), (0, 1)), constant_values=1)
        query_windows = query_windows.reshape(-1, windows.shape[1])
        nearest = search.shortlist(query_windows, windows, num_candidates, excluded=excluded_windows)
        images = np.where(nearest.mask, nearest.indices // database.shape[1], len(database))
        votes = [np.bincount(row, minlength=len(database) + 1) for row in images.reshape(len(unusable), -1)]
        votes = np.where(unusable, -1, np.array(votes)[:, :-1])
        order = np.argsort(-votes, axis=1, kind="stable")[:, :num_candidates]
        counts = np.take_along_axis(votes, order, axis=1)
        indices[part, : order.shape[1]] = np.where(counts < 0, -1, order)
        scores[part, : order.shape[1]] = np.maximum(counts, 0)
    return Shortlist(indices, scores, indices >= 0)


def _windows_of(excluded: Positives, per_image: int) -> Positives:
    """Rows of all windows of the images excluded for a query, for every window of the query."""
    window = np.arange(per_image)
    rows = [(images[:, None] * per_image + window).reshape(-1) for images in map(excluded.of, range(len(excluded)))]
    return Positives.from_rows((of_query for of_query in rows for _ in window), excluded.num_database * per_image)
