"""The first step of place recognition: which database images are worth a second look, for each image of a sequence."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from mfvpr.archive import Aggregated, Archive
from mfvpr.data.datasets import ImageFolder, QuerySequence
from mfvpr.exchange import read_global_descriptors, read_shortlist
from mfvpr.exchange.checks import Lengths
from mfvpr.features import Extractor
from mfvpr.retrieval import EXACT, Search
from mfvpr.types import Shortlist


class Filtered(NamedTuple):
    """Candidates `[Q, C]` of a sequence's queries; images that the filter could not use, with reasons by row."""

    candidates: Shortlist
    bad_queries: Mapping[int, str]
    bad_database: Mapping[int, str]


class Filter(Protocol):
    """How candidates are found.

    With a store of matches its recipe is needed, see `mfvpr.fingerprints.recipe_of`: a frozen dataclass has one.
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
        known = archive.vectors(database, self.describer, database, label="database descriptors")
        asked = archive.vectors(sequence.images, self.describer, database, label=f"{sequence.name} descriptors")
        found = self.search.fit(known.values).shortlist(
            asked.values, known.values, num_candidates, excluded=sequence.excluded
        )
        return Filtered(found, asked.bad, known.bad)


@dataclass(frozen=True)
class ImportedDescriptors:
    """Candidates by global descriptors of another program, see `mfvpr.exchange.read_global_descriptors`.

    Attributes:
        database: its file.
        queries: by name of the sequence, or one file for all of them.
        lengths: see there.
        search: among the descriptors.
    """

    database: Path
    queries: Mapping[str, Path] | Path
    lengths: Lengths = "unit"
    search: Search = EXACT

    def shortlist(
        self, sequence: QuerySequence, database: ImageFolder, num_candidates: int, archive: Archive
    ) -> Filtered:
        """See `Filter`."""
        path = self.queries[sequence.name] if isinstance(self.queries, Mapping) else self.queries
        known = read_global_descriptors(self.database, database.names, lengths=self.lengths)
        asked = read_global_descriptors(path, sequence.images.names, lengths=self.lengths)
        found = self.search.fit(known).shortlist(asked, known, num_candidates, excluded=sequence.excluded)
        return Filtered(found, {}, {})


@dataclass(frozen=True)
class ImportedShortlist:
    """Candidates of another program, see `mfvpr.exchange.read_shortlist`.

    Attributes:
        file: by name of the sequence, or one file for all of them.
    """

    file: Mapping[str, Path] | Path

    def shortlist(
        self, sequence: QuerySequence, database: ImageFolder, num_candidates: int, archive: Archive
    ) -> Filtered:
        """See `Filter`; what the sequence excludes is left out, the others move up."""
        path = self.file[sequence.name] if isinstance(self.file, Mapping) else self.file
        found = read_shortlist(path, sequence.images.names, database.names)
        if sequence.excluded is not None:
            found = _without(found, sequence.excluded.contains(found.indices))
        return Filtered(_cut(found, num_candidates), {}, {})


def _without(found: Shortlist, excluded: np.ndarray) -> Shortlist:
    """A shortlist `[Q, C]` without some of its candidates; padding at the end."""
    order = np.argsort(excluded | ~found.mask, axis=1, kind="stable")
    kept = np.take_along_axis(found.mask & ~excluded, order, axis=1)
    indices, scores = (np.take_along_axis(field, order, axis=1) for field in (found.indices, found.scores))
    return Shortlist(np.where(kept, indices, -1), np.where(kept, scores, 0), kept)


def _cut(found: Shortlist, num_candidates: int) -> Shortlist:
    """To `[Q, num_candidates]`, with padding where there are fewer."""
    missing = max(0, num_candidates - found.mask.shape[1])

    def cut(field: np.ndarray, fill: float) -> np.ndarray:
        return np.pad(field[:, :num_candidates], ((0, 0), (0, missing)), constant_values=fill)

    return Shortlist(cut(found.indices, -1), cut(found.scores, 0), cut(found.mask, False))
