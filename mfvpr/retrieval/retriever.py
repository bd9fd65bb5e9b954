"""The first step of place recognition: which database images are worth a second look, for each image of a sequence."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, Protocol

import numpy as np

from mfvpr.datasets.datasets import ImageFolder, QuerySequence
from mfvpr.features.extractor import Aggregated, Extractor
from mfvpr.retrieval.search import EXACT, Search
from mfvpr.storage.feature_cache import Archive
from mfvpr.storage.shards import together
from mfvpr.types import Shortlist


class Filtered(NamedTuple):
    """Candidates `[Q, C]` of a sequence's queries; images that the filter could not use, with reasons by row."""

    candidates: Shortlist
    bad_queries: Mapping[int, str]
    bad_database: Mapping[int, str]


class Filter(Protocol):
    """How candidates are found.

    With a store of matches its recipe is needed, see `mfvpr.utils.fingerprints.recipe_of`: a frozen dataclass has one.
    """

    def shortlist(
        self, sequence: QuerySequence, database: ImageFolder, num_candidates: int, archive: Archive
    ) -> Filtered:
        """The best candidates of each query, without those that the sequence excludes.

        Args:
            sequence: Q queries.
            database: N images.
            num_candidates: C.
            archive: where what is taken from the images is kept.
        """
        ...


@dataclass(frozen=True)
class Retrieval:
    """Candidates by global descriptors.

    Attributes:
        describer: what describes images, from their pixels or from their local features.
        search: among the descriptors.
    """

    describer: Extractor | Aggregated
    search: Search = EXACT

    def shortlist(
        self, sequence: QuerySequence, database: ImageFolder, num_candidates: int, archive: Archive
    ) -> Filtered:
        """See `Filter`."""
        database_vectors, query_vectors = together(
            partial(archive.vectors, database, self.describer, database, label="database"),
            partial(archive.vectors, sequence.images, self.describer, database, label=f"query {sequence.name}"),
        )
        nothing = ~query_vectors.values.any(axis=1, keepdims=True)  # of no features, which resembles all alike
        search = archive.once("search", lambda: self.search.fit(database_vectors.values), database, self)
        candidates = search.shortlist(
            np.where(nothing, np.nan, query_vectors.values),
            database_vectors.values,
            num_candidates,
            excluded=sequence.excluded,
        )
        return Filtered(candidates, query_vectors.bad, database_vectors.bad)
