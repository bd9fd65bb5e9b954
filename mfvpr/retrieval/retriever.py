"""Retrieval (the paper's filter): candidates among the database images for each query of a sequence."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from mfvpr.core.types import Shortlist
from mfvpr.datasets.datasets import ImageFolder, QuerySequence
from mfvpr.features.extractor import Aggregated, Extractor
from mfvpr.retrieval.search import EXACT, Search
from mfvpr.storage.feature_cache import FeatureCache


class RetrievalResult(NamedTuple):
    """Candidates `[Q, C]` of a sequence's queries, and images that could not be used: row -> reason."""

    candidates: Shortlist
    bad_queries: Mapping[int, str]
    bad_database: Mapping[int, str]


class Retriever(Protocol):
    """Interface of a retrieval; one of your own needs a `recipe` for a cache on disk, see `mfvpr.utils.recipe_of`."""

    def shortlist(
        self, sequence: QuerySequence, database: ImageFolder, num_candidates: int, cache: FeatureCache
    ) -> RetrievalResult:
        """Best candidates of each query, without database images that the sequence excludes."""
        ...


@dataclass(frozen=True)
class Retrieval:
    """Candidates by search among global descriptors, which are computed from pixels or from local features."""

    describer: Extractor | Aggregated
    search: Search = EXACT

    def shortlist(
        self, sequence: QuerySequence, database: ImageFolder, num_candidates: int, cache: FeatureCache
    ) -> RetrievalResult:
        """See `Retriever`."""
        database_vectors = cache.vectors(database, self.describer, database, label="database")
        query_vectors = cache.vectors(sequence.images, self.describer, database, label=f"query {sequence.name}")
        # An image without features has the descriptor 0, which is equally similar to all.
        is_zero = ~query_vectors.values.any(axis=1, keepdims=True)
        search = cache.once("search", lambda: self.search.fit(database_vectors.values), database, self)
        candidates = search.shortlist(
            np.where(is_zero, np.nan, query_vectors.values),
            database_vectors.values,
            num_candidates,
            excluded=sequence.excluded,
        )
        return RetrievalResult(candidates, query_vectors.bad, database_vectors.bad)
