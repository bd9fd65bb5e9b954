"""Adding images to a map, one process at a time: from a folder, one by one, or with features that are there already."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from mfvpr.datasets.datasets import ImageFolder
from mfvpr.localization.describing import Described, Image, is_file
from mfvpr.localization.state import DescribedMap, MapState, exclusive
from mfvpr.storage.features import FeatureStore
from mfvpr.storage.map_entries import Entry, check_entry
from mfvpr.storage.maps import MapImage, lock_map, write_settings
from mfvpr.types import Features
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import canonical_name
from mfvpr.utils.progress import Track, no_progress


class GrowingMap(MapState):
    """A map that images are added to: the base of `mfvpr.localization.Map`."""

    @exclusive
    def learn(self, images: ImageFolder, *, track: Track = no_progress) -> None:
        """Learn the vocabulary from some images, unless the map has one.

        Raises:
            InputError: images cannot be read, or have too few features, or another process adds.
        """
        if self._described is None:
            with lock_map(self.folder), self._learning(images, track):
                pass

    @exclusive
    def build(self, images: ImageFolder, places: Sequence[Any] | None = None, *, track: Track = no_progress) -> int:
        """Add the images whose names the map does not have yet; return how many were added.

        Args:
            images: to add. If the map needs a vocabulary and has none, it is learned from them first; meanwhile the
                folder takes twice the space.
            places: of each image, JSON values; None = the names.
            track: progress.

        Raises:
            InputError: an image cannot be read, another process adds, or the disk is full: what was added stays.
        """
        places = images.names if places is None else places
        if len(places) != len(images):
            raise InputError(f"expected a place of each of {len(images)} images, got {len(places)}")
        for name, place in zip(images.names, places, strict=True):
            check_entry(name, place)
        with lock_map(self.folder), self._learning(images, track) as features, self._adding() as (described, add):
            missing = [row for row, name in enumerate(images.names) if name not in self._row_of_name]
            if features is None:
                batches = described.describing.folder(images, missing, track)
            else:
                batches = _aggregate(described.describing.describer, features, missing, self.extractor.batch_size)
            for batch in batches:
                add([
                    (features, Entry(images.names[row], places[row], vector))
                    for row, (features, vector) in batch.items()
                ])  # fmt: skip
        self.refresh()
        return len(missing)

    @exclusive
    def add(self, image: Image, place: Any, *, name: str | None = None) -> None:
        """Add one image.

        Args:
            image: as of `ask`.
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
        """Add images with features and global descriptors that `describing` has computed.

        Args:
            entries: names, places and descriptors.
            features: local ones, as a store gives them back.

        Raises:
            InputError: as `add`.
        """
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
                if name in self._row_of_name or name in new_names:
                    raise InputError(f"{name}: the map has an image of this name; choose another")
                new_names.add(name)
            add([*zip(features, entries, strict=True)])
        self.refresh()

    @contextmanager
    def _learning(self, images: ImageFolder, track: Track) -> Iterator[FeatureStore | None]:
        """Learn the vocabulary if it is missing, within `lock_map`; yield the features it was learned from, or None."""
        self.refresh()
        if self._described is not None or self._vocabulary is None:
            yield None
            return
        with self._vocabulary.learn(images, self._settings, track) as features:
            self._use(self._vocabulary.read())
            yield features

    @contextmanager
    def _adding(self) -> Iterator[tuple[DescribedMap, Callable[[Sequence[MapImage]], None]]]:
        """Lock the rows, and read those that other processes added; yield a function that adds images as well."""
        described = self._require_described()
        self.refresh()  # first: nothing of this map goes into one that replaced it
        write_settings(self.folder, self._settings)
        with described.rows.adding() as add:
            self.refresh()
            yield described, add


def _aggregate(
    aggregation: Any, features: FeatureStore, rows: Sequence[int], batch_size: int
) -> Iterator[dict[int, Described]]:
    """Features and aggregated descriptors by row, in batches."""
    for start in range(0, len(rows), batch_size):
        images = dict(features.read(rows[start : start + batch_size]))
        yield dict(zip(images, zip(images.values(), aggregation([*images.values()]), strict=True), strict=True))
