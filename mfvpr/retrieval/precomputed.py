"""Files of other programs in place of extractors and retrievals; the cache knows them by content, not by path."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
from jaxtyping import Float

from mfvpr.core.types import Shortlist
from mfvpr.datasets.datasets import ImageFolder, QuerySequence
from mfvpr.datasets.image_reading import Interpolation, read_size
from mfvpr.features.extractor import Scale
from mfvpr.io.containers import ImageOfEntry, require_one_image
from mfvpr.io.features import ImportedFeatures, Lengths, open_features, read_global_descriptors
from mfvpr.io.matches import Images, ImportedMatches, open_matches
from mfvpr.io.pair_files import content_paths
from mfvpr.io.shortlists import Entries, read_shortlist
from mfvpr.retrieval.retriever import RetrievalResult
from mfvpr.retrieval.search import EXACT
from mfvpr.retrieval.standardization import Search
from mfvpr.storage.feature_cache import FeatureCache
from mfvpr.utils.errors import InputError

TYPICAL = 1000  # assumed keypoints of an image before the file is read


@dataclass(frozen=True)
class File:
    """A file of another program, and the prefix of the images' names in it, such as `database/`."""

    path: Path
    prefix: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "path", Path(self.path))  # recipes recognize files by this type

    def names(self, folder: ImageFolder) -> list[str]:
        return [self.prefix + name for name in folder.names]


@dataclass(frozen=True)
class _FolderFiles:
    """Files by the root of the folder of images, and the images of their entries: none is of two images."""

    files: Mapping[Path, File]
    _images: ImageOfEntry = field(
        default_factory=dict, init=False, repr=False, compare=False, metadata={"recipe": False}
    )


@dataclass(frozen=True)
class FeatureFiles(_FolderFiles):
    """Local features of another program, see `mfvpr.io.open_features`; a `Source`."""

    lengths: Lengths = "unit"  # of descriptors
    image_size: tuple[int, int] | None = None  # (width, height) px, if the files do not store it
    interpolation: Interpolation = field(default="pil_bilinear", metadata={"recipe": False})
    scales: tuple[Scale, ...] = field(default=(Scale(0, TYPICAL),), metadata={"recipe": False})

    def open(self, folder: ImageFolder, *, partial: bool) -> ImportedFeatures:
        """Open the features of a folder's images; `partial` allows missing images."""
        file = _file_of(self.files, folder)
        options = {"image_size": self.image_size, "lengths": self.lengths, "partial": partial}
        features = open_features(file.path, file.names(folder), **options)
        require_one_image(file.path, folder.paths, features.entries, self._images)
        return features


@dataclass(frozen=True)
class DescriptorFiles(_FolderFiles):
    """Candidates by global descriptors of another program, see `mfvpr.io.read_global_descriptors` for `lengths`."""

    lengths: Lengths = "unit"
    search: Search = EXACT

    def shortlist(
        self, sequence: QuerySequence, database: ImageFolder, num_candidates: int, cache: FeatureCache
    ) -> RetrievalResult:
        database_vectors = cache.recipes.once("vectors", lambda: self._read(database), database, self)
        search = cache.recipes.once("search", lambda: self.search.fit(database_vectors), database, self)
        query_vectors = self._read(sequence.images)
        shortlist = search.shortlist(query_vectors, database_vectors, num_candidates, excluded=sequence.excluded)
        return RetrievalResult(shortlist, {}, {})

    def _read(self, folder: ImageFolder) -> Float[np.ndarray, "images dimensions"]:
        file = _file_of(self.files, folder)
        check = partial(require_one_image, file.path, folder.paths, known=self._images)
        return read_global_descriptors(file.path, file.names(folder), lengths=self.lengths, check_entries=check)


@dataclass(frozen=True)
class ShortlistFiles:
    """Candidates of another program, see `mfvpr.io.read_shortlist`."""

    files: Mapping[Path, File]  # by the root of the folder of queries, with the prefix of the queries' names
    database_prefix: str = ""  # of the database images' names

    def shortlist(
        self, sequence: QuerySequence, database: ImageFolder, num_candidates: int, cache: FeatureCache
    ) -> RetrievalResult:
        """See `Retriever`; candidates that the sequence excludes are removed, and those beyond them move up."""
        file, queries, known = _file_of(self.files, sequence.images), sequence.images, ImageOfEntry()
        names = [self.database_prefix + name for name in database.names]
        here, elsewhere = (f"/{each.root.absolute().as_posix().strip('/')}/" for each in (database, queries))

        def check(query_entries: Entries, entries: Entries) -> None:
            for name, entry in zip(database.names, entries, strict=True):
                start = "/" if entry is None else "/" + entry.name.removesuffix(name).lstrip("/")
                if start != "/" and elsewhere.endswith(start) and not here.endswith(start):
                    got = f"those in {queries.root}; exchange dataset.database and dataset.queries, or its columns"
                    raise InputError(f"{file.path}: expected names of images in {database.root}, got {got}")
            require_one_image(file.path, database.paths, entries, known)
            require_one_image(file.path, queries.paths, query_entries, known)

        shortlist = read_shortlist(file.path, file.names(queries), names, check_entries=check)
        if sequence.excluded is not None:
            shortlist = replace(shortlist, mask=shortlist.mask & ~sequence.excluded.contains(shortlist.indices))
        return RetrievalResult(_cut(shortlist, num_candidates), {}, {})


def _cut(shortlist: Shortlist, num_candidates: int) -> Shortlist:
    """Shortlist of `num_candidates`, cut or padded; candidates beyond a masked one move up."""
    missing = max(0, num_candidates - shortlist.mask.shape[1])
    padded = jax.tree.map(lambda values: np.pad(values, ((0, 0), (0, missing))), shortlist)
    order = np.argsort(~padded.mask, axis=1, kind="stable")[:, :num_candidates]
    cut = jax.tree.map(lambda values: np.take_along_axis(values, order, axis=1), padded)
    return Shortlist(np.where(cut.mask, cut.indices, -1), np.where(cut.mask, cut.scores, 0), cut.mask)


@dataclass(frozen=True)
class MatchFiles:
    """Matches of another program in place of a matcher, see `mfvpr.io.open_matches` for `verified` and `confidences`.

    The extractor of the pipeline is used only for retrieval.
    """

    files: Mapping[Path, File]  # by the root of the folder of queries, with the prefix of the queries' names
    database_prefix: str = ""  # of the database images' names
    features: Mapping[Path, File] = field(default_factory=dict)  # hloc's, by the root of the folder of images
    image_size: tuple[int, int] | None = None  # (width, height) of the images with the points, if no file tells, px
    verified: bool = False
    confidences: bool = True
    lengths: Lengths = "unit"  # of the features' descriptors

    @property
    def recipe(self) -> dict[str, Any]:
        """Everything that matches depend on; a cache takes the content of files and folders for their paths."""
        files = {root: [*content_paths(file.path), file.prefix] for root, file in self.files.items()}
        return {part.name: getattr(self, part.name) for part in fields(self)} | {"files": files}

    @property
    def inputs(self) -> Literal["images"]:
        return "images"

    def open(self, queries: ImageFolder, database: ImageFolder) -> ImportedMatches:
        file = _file_of(self.files, queries)
        known: ImageOfEntry = {}  # images of the entries of both folders
        sides = self._images(queries, file.prefix, known), self._images(database, self.database_prefix, known)
        options = {"verified": self.verified, "confidences": self.confidences, "image_size": self.image_size}
        return open_matches(file.path, *sides, **options)

    def _images(self, folder: ImageFolder, prefix: str, known: ImageOfEntry) -> Images:
        """Names, full paths, sizes and features of a folder's images."""
        paths = [path.absolute().as_posix() for path in folder.paths]
        names, features = [prefix + name for name in folder.names], None
        if self.features:
            file = _file_of(self.features, folder)
            options = {"image_size": self.image_size, "lengths": self.lengths}
            features = open_features(file.path, names, paths=() if prefix else paths, **options)
            require_one_image(file.path, folder.paths, features.entries, known)
        size = lambda row: read_size(folder.paths[row], orient=False)  # noqa: E731  # as hloc and kapture read images
        return Images(names, paths, bool(prefix), size, features)


def _file_of(files: Mapping[Path, File], folder: ImageFolder) -> File:
    file = {Path(root): file for root, file in files.items()}.get(folder.root)
    if file is None:
        known = ", ".join(map(str, files)) or "none"
        raise InputError(f"{folder.root}: expected a folder that has a file, one of: {known}; give one for it as well")
    return file
