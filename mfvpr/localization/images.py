"""The images of a map: names, places and global descriptors in memory, features on demand; and how images are added."""

import shutil
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Bool

from mfvpr.core.types import Features
from mfvpr.datasets.datasets import ImageFolder
from mfvpr.evaluation.system import System
from mfvpr.features.extractor import Aggregation, Extractor
from mfvpr.features.vlad import VladFitting
from mfvpr.localization.declaration import LEARNING, write_declaration
from mfvpr.localization.describing import Describing, Image, is_file
from mfvpr.localization.resident import Resident
from mfvpr.localization.strength import MapStrength
from mfvpr.localization.vectors import Vectors
from mfvpr.localization.vocabulary import VocabularyFile
from mfvpr.storage.feature_cache import FeatureCache
from mfvpr.storage.map_entries import Entry, check_entry
from mfvpr.storage.maps import MapImage, MapRows, has_settings, lock_map, write_settings
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import canonical_name
from mfvpr.utils.fingerprints import recipe_of
from mfvpr.utils.progress import Track, no_progress
from mfvpr.utils.runtime import Runtime

Method = TypeVar("Method", bound=Callable[..., Any])


def exclusive(method: Method) -> Method:
    """Let one thread at a time run a method of a map."""

    @wraps(method)
    def run(self: "MapImages", *arguments: Any, **options: Any) -> Any:
        with self._lock:
            return method(self, *arguments, **options)

    return run  # pyright: ignore[reportReturnType]  # of the same arguments


class DescribedMap(NamedTuple):
    """The parts of a map that depend on its describer: descriptions, rows on disk and in memory, mean strength."""

    describing: Describing
    rows: MapRows
    resident: Resident
    strength: MapStrength


class MapImages:
    """The images of a map, which other processes may add as well: the base of `mfvpr.localization.Map`."""

    def __init__(
        self,
        folder: Path | str,
        system: System,
        extractor: Extractor,
        describer: Extractor | VladFitting,
        *,
        memory: float | None,
    ) -> None:
        """Open a map; see `mfvpr.localization.Map`."""
        self.folder = Path(folder).absolute()  # the working directory may change
        self.system, self.extractor, self.candidates = system, extractor, int(system.pipeline.candidates)
        self._vectors = Vectors()
        self._entries: dict[int, Entry] = {}  # without vectors
        self._row_of_name: dict[str, int] = {}
        self._memory = memory
        self._settings = {"extractor": recipe_of(extractor), "describer": recipe_of(describer)}
        self._has_settings = False  # whether these settings are known to be the folder's
        self._lock = threading.RLock()
        self._vocabulary: VocabularyFile | None = None
        self._described: DescribedMap | None = None  # until there is a vocabulary
        if isinstance(describer, VladFitting):
            self._vocabulary = VocabularyFile(self.folder, extractor, describer)
        else:
            self._use(describer)
        self.refresh()

    def __len__(self) -> int:
        """Number of images."""
        return len(self._entries)

    @property
    def describing(self) -> Describing:
        """The extractor and the describer of the images; raises `InputError` if the map has no vocabulary yet."""
        return self._open_parts().describing

    @property
    @exclusive
    def names(self) -> list[str]:
        """Names of the images, in the order of their rows."""
        return [self._entries[row].name for row in sorted(self._entries)]

    @property
    @exclusive
    def there(self) -> Bool[np.ndarray, " rows"]:
        """Which rows have an image: a process that was killed may have left some out."""
        has_image = np.zeros(self._vectors.total, bool)
        has_image[[*self._entries]] = True
        return has_image

    def row(self, name: str) -> int | None:
        """Row of an image; None = the map has no image of this name."""
        return self._row_of_name.get(name)

    def place(self, row: int) -> Any:
        """Place of the image in a row that has one."""
        return self._entries[row].place

    @exclusive
    def refresh(self) -> int:
        """Read the images that other processes added since; return their number.

        Raises:
            InputError: the map was made with other settings, is damaged, or was replaced since it was opened.
        """
        before = len(self)
        self._has_settings = self._has_settings or has_settings(self.folder, self._settings)
        if self._vocabulary is not None and self._described is not None:
            self._vocabulary.check_unchanged()
        elif self._vocabulary is not None and (vocabulary := self._vocabulary.find()) is not None:
            self._use(vocabulary)
        for row, entry in self._described.rows.new() if self._described else ():
            self._vectors.put(row, entry.vector)
            self._entries[row] = entry._replace(vector=None)
            self._row_of_name[entry.name] = row
        return len(self) - before

    @exclusive
    def learn(self, images: ImageFolder, *, cache: FeatureCache | None = None, track: Track = no_progress) -> None:
        """Learn the vocabulary from some images, unless the map has one; arguments and errors are those of `build`."""
        if self._described is None:
            with lock_map(self.folder), self._learning(images, cache, track):
                pass

    @exclusive
    def build(
        self,
        images: ImageFolder,
        places: Sequence[Any] | None = None,
        *,
        cache: FeatureCache | None = None,
        track: Track = no_progress,
    ) -> int:
        """Add the images whose names the map does not have yet; return how many were added.

        Args:
            images: to add. If the map needs a vocabulary and has none, it is learned from them first.
            places: of each image, JSON values; None = the names.
            cache: keeps the features, so that images that it knows are not described again. Without one, the folder
                takes twice the space while a vocabulary is learned.
            track: progress, without a cache, which has its own.

        Raises:
            InputError: an image cannot be read, another process adds, or the disk is full: what was added stays.
        """
        places = images.names if places is None else places
        if len(places) != len(images):
            raise InputError(f"expected a place of each of {len(images)} images, got {len(places)}")
        for name, place in zip(images.names, places, strict=True):
            check_entry(name, place)
        self.refresh()
        if {*images.names} <= {*self._row_of_name}:  # also in a map that can only be read
            return 0
        with lock_map(self.folder), self._learning(images, cache, track) as cache, self._adding() as (described, add):
            missing = [row for row, name in enumerate(images.names) if name not in self._row_of_name]
            before = len(self)
            if cache is None:
                batches = described.describing.folder(images, missing, track)
            else:
                batches = described.describing.cached(images, missing, cache)
            for batch in batches:
                add([
                    (features, Entry(images.names[row], places[row], vector))
                    for row, (features, vector) in batch.items()
                ])  # fmt: skip
        self.refresh()
        return len(self) - before

    @exclusive
    def add(self, image: Image, place: Any, *, name: str | None = None) -> None:
        """Add one image.

        Args:
            image: see `Map.localize_with_evidence`.
            place: where it was taken, any JSON value.
            name: text; None = the file's absolute path, see `canonical_name`; an array needs one.

        Raises:
            InputError: as `build`; a name that the map has; or a map without its vocabulary.
        """
        name = canonical_name(image) if name is None and is_file(image) else name
        if name is None:
            raise InputError("name: expected one for an image that is no file")
        features, vector = self.describing.image(image)
        self.add_described([Entry(name, place, vector)], [features])

    @exclusive
    def add_described(self, entries: Sequence[Entry], features: Sequence[Features]) -> None:
        """Add images with features and global descriptors that `describing` has computed; errors are those of `add`."""
        if len(entries) != len(features):
            raise InputError(f"expected features of each of {len(entries)} images, got {len(features)}")
        for name, place, _ in entries:
            check_entry(name, place)
        with lock_map(self.folder), self._adding() as (_, add):
            new_names, length = set[str](), self._vectors.length
            for name, _, vector in entries:
                length = np.size(vector) if length is None else length
                if np.shape(vector) != (length,):
                    raise InputError(f"{name}: expected a descriptor [{length}], got {list(np.shape(vector))}. Take it "
                                     "from `describing` of this map.")  # fmt: skip
                if np.asarray(vector).dtype.kind == "f" and not np.isfinite(vector).all():
                    raise InputError(f"{name}: expected a descriptor of finite numbers, got NaN or infinity")
                if name in self._row_of_name or name in new_names:
                    raise InputError(f"{name}: the map has an image of this name; choose another")
                new_names.add(name)
            add([*zip(features, entries, strict=True)])
        self.refresh()

    @contextmanager
    def _learning(self, images: ImageFolder, cache: FeatureCache | None, track: Track) -> Iterator[FeatureCache | None]:
        """Learn the vocabulary if it is missing, within `lock_map`; yield the cache with its features, if any."""
        self.refresh()
        if self._described is not None or self._vocabulary is None:
            yield cache
            return
        write_declaration(self.folder, self.system)
        temporary = self.folder / LEARNING
        shutil.rmtree(temporary, ignore_errors=True)  # left by a process that was killed
        try:
            cache = cache or FeatureCache(temporary, runtime=Runtime(progress=lambda label: track))
            self._vocabulary.learn(cache.local(images, self.extractor)[0], self._settings)
            self._use(self._vocabulary.read())
            yield cache
        finally:
            shutil.rmtree(temporary, ignore_errors=True)

    @contextmanager
    def _adding(self) -> Iterator[tuple[DescribedMap, Callable[[Sequence[MapImage]], None]]]:
        """Lock the rows, and read those that other processes added; yield a function that adds images as well."""
        described = self._open_parts()
        self.refresh()  # first: nothing of this map goes into one that replaced it
        write_settings(self.folder, self._settings)
        write_declaration(self.folder, self.system)
        with described.rows.adding() as add:
            self.refresh()
            yield described, add

    def _use(self, describer: Extractor | Aggregation) -> None:
        """Open the rows, which are described by `describer`."""
        describing = Describing(self.extractor, describer)
        rows = MapRows(self.folder, describing.recipe)
        self._described = DescribedMap(describing, rows, Resident(rows, self._memory), MapStrength(rows))

    def _open_parts(self) -> DescribedMap:
        if self._described is None:
            raise InputError(f"{self.folder}: this map has no vocabulary yet; learn it from some images first "
                             "(`learn`)")  # fmt: skip
        return self._described
