"""What other programs computed, in place of extractors and filters: local features, global descriptors, shortlists.

What was made from files is found again by their content, see `Archive.recipe_of`, wherever they are and whatever they
are called.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mfvpr.datasets.datasets import ImageFolder, QuerySequence
from mfvpr.datasets.images import Interpolation
from mfvpr.features.extractor import Scale
from mfvpr.io.checks import Lengths
from mfvpr.io.descriptors import read_with_entries as read_descriptors
from mfvpr.io.features import ImportedFeatures, open_features
from mfvpr.io.names import ImageOfEntry, require_one_image
from mfvpr.io.shortlists import read_with_entries as read_shortlist
from mfvpr.retrieval.retriever import Filtered
from mfvpr.retrieval.search import EXACT, Search
from mfvpr.storage.feature_cache import Archive
from mfvpr.types import Shortlist
from mfvpr.utils.errors import InputError

TYPICAL = 1000  # keypoints of an image, where nobody knows before the file is read


@dataclass(frozen=True)
class File:
    """A file of another program, and what stands before the images' names in it, such as `database/`."""

    path: Path
    prefix: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "path", Path(self.path))  # recipes know files by type, and tell them by their content

    def names(self, folder: ImageFolder) -> list[str]:
        """What a folder's images are called in it."""
        return [self.prefix + name for name in folder.names]


@dataclass(frozen=True)
class FeatureFiles:
    """Local features of another program, see `mfvpr.io.open_features`.

    Attributes:
        files: by the root of the folder whose images they are of.
        lengths: of descriptors, see there.
        image_size: (width, height) px, where the files do not tell.
    """

    files: Mapping[Path, File]
    lengths: Lengths = "unit"
    image_size: tuple[int, int] | None = None
    interpolation: Interpolation = field(default="pil_bilinear", metadata={"recipe": False})
    scales: tuple[Scale, ...] = field(default=(Scale(0, TYPICAL),), metadata={"recipe": False})
    _images: ImageOfEntry = field(
        default_factory=dict, init=False, repr=False, compare=False, metadata={"recipe": False}
    )

    def opened(self, folder: ImageFolder, *, partial: bool) -> ImportedFeatures:
        """The features of a folder's images; `partial`: some may be missing.

        Raises:
            InputError: there is no file of the folder, an entry stands for an image of another folder as well, or see
                `open_features`.
        """
        file = _file_of(self.files, folder)
        features = open_features(
            file.path, file.names(folder), image_size=self.image_size, lengths=self.lengths, partial=partial
        )
        require_one_image(file.path, folder.paths, features.entries, self._images)
        return features


@dataclass(frozen=True)
class DescriptorFiles:
    """Candidates by global descriptors of another program, see `mfvpr.io.read_global_descriptors`.

    Attributes:
        files: by the root of the folder whose images they are of.
        lengths: see there.
        search: among the descriptors.
    """

    files: Mapping[Path, File]
    lengths: Lengths = "unit"
    search: Search = EXACT
    _images: ImageOfEntry = field(
        default_factory=dict, init=False, repr=False, compare=False, metadata={"recipe": False}
    )

    def shortlist(
        self, sequence: QuerySequence, database: ImageFolder, num_candidates: int, archive: Archive
    ) -> Filtered:
        """See `mfvpr.retrieval.retriever.Filter`."""
        database_vectors = archive.once("vectors", lambda: self._read(database), database, self)
        search = archive.once("search", lambda: self.search.fit(database_vectors), database, self)
        query_vectors = self._read(sequence.images)
        shortlist = search.shortlist(query_vectors, database_vectors, num_candidates, excluded=sequence.excluded)
        return Filtered(shortlist, {}, {})

    def _read(self, folder: ImageFolder) -> np.ndarray:
        file = _file_of(self.files, folder)
        vectors, entries = read_descriptors(file.path, file.names(folder), lengths=self.lengths)
        require_one_image(file.path, folder.paths, entries, self._images)
        return vectors


@dataclass(frozen=True)
class ShortlistFiles:
    """Candidates of another program, see `mfvpr.io.read_shortlist`.

    Attributes:
        files: by the root of the folder of queries that they are for, with the prefix of these.
        database_prefix: of the database images.
    """

    files: Mapping[Path, File]
    database_prefix: str = ""

    def shortlist(
        self, sequence: QuerySequence, database: ImageFolder, num_candidates: int, archive: Archive
    ) -> Filtered:
        """See `mfvpr.retrieval.retriever.Filter`; what the sequence excludes is left out, and the others move up."""
        file = _file_of(self.files, sequence.images)
        names = [self.database_prefix + name for name in database.names]
        shortlist, query_entries, database_entries = read_shortlist(file.path, file.names(sequence.images), names)
        known: ImageOfEntry = {}
        require_one_image(file.path, database.paths, database_entries, known)
        require_one_image(file.path, sequence.images.paths, query_entries, known)
        if sequence.excluded is not None:
            shortlist = _without(shortlist, sequence.excluded.contains(shortlist.indices))
        return Filtered(_cut(shortlist, num_candidates), {}, {})


def _file_of(files: Mapping[Path, File], folder: ImageFolder) -> File:
    """The file of a folder's images."""
    files = {Path(root): file for root, file in files.items()}
    if folder.root not in files:
        known = ", ".join(map(str, files)) or "none"
        raise InputError(f"{folder.root}: expected a folder that a file was given of, one of: {known}; give one of "
                         "this folder as well")  # fmt: skip
    return files[folder.root]


def _without(shortlist: Shortlist, excluded: np.ndarray) -> Shortlist:
    """A shortlist `[Q, C]` without some of its candidates; padding at the end."""
    kept = shortlist.mask & ~excluded
    order = np.argsort(~kept, axis=1, kind="stable")
    kept, indices, scores = (
        np.take_along_axis(values, order, axis=1) for values in (kept, shortlist.indices, shortlist.scores)
    )
    return Shortlist(np.where(kept, indices, -1), np.where(kept, scores, 0), kept)


def _cut(shortlist: Shortlist, num_candidates: int) -> Shortlist:
    """To `[Q, num_candidates]`, with padding where there are fewer."""
    missing = max(0, num_candidates - shortlist.mask.shape[1])

    def cut(values: np.ndarray, fill: float) -> np.ndarray:
        return np.pad(values[:, :num_candidates], ((0, 0), (0, missing)), constant_values=fill)

    return Shortlist(cut(shortlist.indices, -1), cut(shortlist.scores, 0), cut(shortlist.mask, False))
