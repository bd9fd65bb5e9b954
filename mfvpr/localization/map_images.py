"""The images of a map: how they are described and added, their global descriptors in memory, features on demand."""

import itertools
import json
import os
import shutil
import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial, wraps
from pathlib import Path
from typing import Any, TypeGuard, TypeVar

import jax
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy.typing import ArrayLike

from mfvpr.core.types import Features
from mfvpr.datasets.datasets import ImageFolder
from mfvpr.datasets.image_reading import read_image, resize
from mfvpr.evaluation.evidence import strength
from mfvpr.evaluation.system import System
from mfvpr.features.extractor import Description, Extractor, describe_images
from mfvpr.features.feature_set import SHARE, check_features
from mfvpr.features.vlad import Vlad, VladFitting
from mfvpr.localization.map_settings import check_settings, kept_settings
from mfvpr.storage.feature_cache import FeatureCache
from mfvpr.storage.maps import Entry, MapFile, check_entry
from mfvpr.storage.packing import pack_arrays, round_as_stored, unpack_arrays
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import canonical_name
from mfvpr.utils.fingerprints import recipe_of
from mfvpr.utils.numerics import as_array, available_cpus, free_host_bytes
from mfvpr.utils.runtime import Runtime, Track, no_progress, ordered_map

_LEARNING = ".learning"  # the folder of features that a vocabulary is being learned from
_AT_ONCE = 16  # images that are described without a cache
_SAMPLE = 32  # images whose strength is measured; a sample has up to twice as many
_FIRST_ROWS = 1024  # of global descriptors; twice as many whenever they are full

Image = Path | str | ArrayLike
Described = tuple[Features, np.ndarray]
Pixels = UInt8[np.ndarray, "_ _ 3"]
Method = TypeVar("Method", bound=Callable[..., Any])


def exclusive(method: Method) -> Method:
    """Let one thread at a time run a method of a map."""

    @wraps(method)
    def run(self: "MapImages", *arguments: Any, **options: Any) -> Any:
        with self._lock:
            return method(self, *arguments, **options)

    return run  # pyright: ignore[reportReturnType]  # of the same arguments


@dataclass(frozen=True)
class Describing:
    """Extractors of a map; the features of queries are rounded as a store rounds the features of the map."""

    extractor: Extractor  # of local features of one scale
    describer: Extractor | Vlad  # of global descriptors; may be the same extractor

    def image(self, image: Image) -> Described:
        """Describe one image: a file, or `[H, W, 3]` uint8 RGB in any form that `np.asarray` converts."""
        return self.pixels(load(image), str(image) if is_file(image) else "image")[0]

    def pixels(self, pixels: Pixels, name: str) -> tuple[Described, Pixels]:
        """Describe one image; also return it at the size of the extractor. `name` stands in errors."""
        image, description = _extract(self.extractor, pixels, name)
        features = round_as_stored(description.features)
        if not isinstance(self.describer, Extractor):
            [vector] = self.describer([features])
            return (features, vector), image
        if self.describer is not self.extractor:
            _, description = _extract(self.describer, pixels, name)
        if description.vector is None:
            raise InputError("describer: gives no global descriptor; expected one that does, or VladFitting()")
        return (features, np.asarray(description.vector, np.float32).reshape(-1)), image

    def folder(self, images: ImageFolder, cache: FeatureCache) -> Iterator[dict[int, Described]]:
        """Describe the images of a folder that a cache lacks: batches by row. The cache may skip bad images."""
        [features] = cache.local(images, self.extractor)
        vectors = cache.vectors(images, self.describer, images) if isinstance(self.describer, Extractor) else None
        aggregate: Any = self.describer
        bad, size = {**features.bad, **(vectors.bad if vectors else {})}, self.extractor.batch_size
        if bad and not cache.skip_bad:
            raise InputError(bad[min(bad)])
        for reason in bad.values():
            cache.warn(reason)
        used = [row for row in range(len(images)) if row not in bad]
        for start in range(0, len(used), size):
            batch = dict(features.source.read(used[start : start + size]))  # also those without keypoints
            if cache.root is None:
                batch = {row: round_as_stored(local) for row, local in batch.items()}
            values = vectors.values[[*batch]] if vectors else aggregate([*batch.values()])
            yield dict(zip(batch, zip(batch.values(), values, strict=True), strict=True))


def is_file(image: Image) -> TypeGuard[Path | str]:
    """Whether an image is a path."""
    return isinstance(image, str | os.PathLike)


def load(image: Image) -> Pixels:
    """Read an image file, or convert an array; an InputError if it is no image."""
    if is_file(image):
        return read_image(image)
    expected = "image: expected a file or [H, W, 3] uint8 RGB, got"
    try:
        pixels = np.asarray(as_array(image))
    except Exception as error:  # other libraries raise any error, torch for tensors with gradients
        got = f"{type(image).__name__} ({' '.join(str(error).split())})"
        raise InputError(f"{expected} {got}. Convert it to a NumPy array.") from None
    if pixels.ndim != 3 or pixels.shape[2] != 3 or not pixels.size or pixels.dtype != np.uint8:
        got = f"{list(pixels.shape)} {pixels.dtype}" if pixels.shape else type(image).__name__
        raise InputError(f"{expected} {got}. Check that the camera gave an image.")
    return pixels


def _extract(extractor: Extractor, pixels: Pixels, name: str) -> tuple[Pixels, Description]:
    """An image at the size of an extractor, and its description."""
    image = resize(pixels, extractor.image_size, extractor.interpolation)
    [description] = describe_images(image[None], extractor)
    if description is None:
        raise InputError(f"{name}: features are not finite (NaN or infinite)")
    return image, description


class Vectors:
    """Global descriptors by row."""

    def __init__(self) -> None:
        self._values, self._is_candidate = np.zeros((0, 0), np.float32), np.zeros(0, bool)
        self._total = 0  # rows that are used

    @property
    def length(self) -> int | None:
        """D; None = there is no descriptor yet."""
        return self._values.shape[1] or None

    def __getitem__(self, row: int) -> Float[np.ndarray, " dimensions"]:
        """The descriptor of a row."""
        return self._values[row]

    def append(self, vector: Float[np.ndarray, " dimensions"]) -> None:
        """Store the descriptor of the next row."""
        if self._total == len(self._values):
            more = np.zeros((max(_FIRST_ROWS, self._total), len(vector)), np.float32)
            self._values = np.concatenate([self._values.reshape(-1, len(vector)), more])
            self._is_candidate = np.concatenate([self._is_candidate, np.zeros(len(more), bool)])
        self._values[self._total] = vector
        # An image without features has a zero descriptor and is never a candidate, as in `mfvpr.retrieval.Retrieval`.
        self._is_candidate[self._total] = bool(np.isfinite(vector).all() and vector.any())
        self._total += 1

    def nearest(
        self, query: Float[np.ndarray, " dimensions"], number: int, *, before: int | None = None
    ) -> tuple[Int[np.ndarray, " candidates"], Float[np.ndarray, " candidates"]]:
        """At most `number` rows `before` a row, and their products with the query, most similar first, then by row."""
        total = self._total if before is None else max(0, min(self._total, before))
        rows = np.flatnonzero(self._is_candidate[:total])
        if not len(rows) or not query.any():
            return rows[:0], np.zeros(0, np.float32)
        # Own threads: those of BLAS spin while they wait, which costs a third of the time.
        workers = available_cpus()
        parts = np.array_split(self._values[:total], workers)
        products = np.concatenate([*ordered_map(partial(np.vecdot, query), parts, workers=workers)])
        if len(rows) > number:
            least = np.partition(products[rows], -number)[-number]
            rows = rows[products[rows] >= least]
        best = rows[np.argsort(-products[rows], kind="stable")][:number]
        return best, products[best]


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
        """Open a map; see `mfvpr.localization.Map`. `memory` of features is in GB, None = a third of what is free."""
        self.folder = Path(folder).absolute()  # the working directory may change
        self.system, self.extractor, self.candidates = system, extractor, int(system.pipeline.candidates)
        self._file, self._lock = MapFile(self.folder), threading.RLock()
        check_settings(self._file, system)
        try:
            self._recipe = {"extractor": recipe_of(extractor), "describer": recipe_of(describer)}
        except TypeError as error:
            raise InputError(
                f"{error}, by which a map knows what made its features; see mfvpr.utils.recipe_of"
            ) from None
        self._is_checked = False  # whether the file is known to have this recipe
        self._fitting = describer if isinstance(describer, VladFitting) else None
        self._describing = None if isinstance(describer, VladFitting) else Describing(extractor, describer)
        self._names, self._places, self._row_of_name = list[str](), list[Any](), dict[str, int]()
        self._vectors, self._strengths = Vectors(), dict[int, float]()
        self._features = OrderedDict[int, Features]()  # of the recently used rows
        self._free_bytes = SHARE * free_host_bytes() if memory is None else 1e9 * memory
        self.refresh()

    def __len__(self) -> int:
        """Number of images."""
        return len(self._names)

    @property
    def describing(self) -> Describing:
        """The extractor and the describer of the images; raises `InputError` if the map has no vocabulary yet."""
        if self._describing is None:
            raise InputError(f"{self.folder}: this map has no vocabulary yet; `learn` it from some images first")
        return self._describing

    @property
    @exclusive
    def names(self) -> list[str]:
        """Names of the images, in the order of their rows."""
        return [*self._names]

    @property
    def there(self) -> Bool[np.ndarray, " rows"]:
        """Which rows have an image: all."""
        return np.ones(len(self), bool)

    def row(self, name: str) -> int | None:
        """Row of an image; None = the map has no image of this name."""
        return self._row_of_name.get(name)

    def place(self, row: int) -> Any:
        """Place of the image in a row."""
        return self._places[row]

    @exclusive
    def refresh(self) -> int:
        """Read the images that other processes added since; return their number.

        Raises:
            InputError: the map was made with other settings, is damaged, or was replaced since it was opened.
        """
        before = len(self)
        if not self._is_checked and (content := self._file.part("recipe")) is not None:
            stored, recipe = json.loads(content), json.loads(json.dumps(self._recipe))
            if differing := " and ".join(name for name in recipe if stored.get(name) != recipe[name]):
                fix = "Use the settings that it was made with, or name another folder"
                raise InputError(f"{self.folder}: this map was made with another {differing}. {fix}.")
            self._is_checked = True
        if self._describing is None and (content := self._file.part("vocabulary")) is not None:
            arrays = unpack_arrays(content)
            self._describing = Describing(self.extractor, Vlad(arrays["centers"], float(arrays["power"])))
        for row, entry in self._file.entries(before):
            self._vectors.append(entry.vector)
            self._names.append(entry.name)
            self._places.append(entry.place)
            self._row_of_name[entry.name] = row
        return len(self) - before

    @exclusive
    def learn(self, images: ImageFolder, *, cache: FeatureCache | None = None, track: Track = no_progress) -> None:
        """Learn the vocabulary from some images, unless the map has one; arguments and errors are those of `build`."""
        if self._describing is None:
            with self._file.lock(), self._learning(images, cache, track):
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
        with self._file.lock(), self._learning(images, cache, track) as cache:
            place_of, before = dict(zip(images.names, places, strict=True)), len(self)
            missing = [name for name in images.names if name not in self._row_of_name]
            ticks = iter(track(missing, len(missing)) if cache is None else missing)  # a cache shows its own progress
            step = _AT_ONCE if cache is None else max(1, len(missing))
            for start in range(0, len(missing), step):
                part = tuple(missing[start : start + step])
                folder = replace(images, names=part)
                for batch in self.describing.folder(folder, FeatureCache() if cache is None else cache):
                    rows = ((part[row], vector) for row, (_, vector) in batch.items())
                    entries = [Entry(name, place_of[name], vector) for name, vector in rows]
                    self._add(entries, [features for features, _ in batch.values()])
                    deque(itertools.islice(ticks, len(batch)), maxlen=0)
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
        check_entry(name, place)
        features, vector = self.describing.image(image)
        self.add_described([Entry(name, place, vector)], [features])

    @exclusive
    def add_described(self, entries: Sequence[Entry], features: Sequence[Features]) -> None:
        """Add images with features and global descriptors that `describing` has computed; errors are those of `add`."""
        if len(entries) != len(features):
            raise InputError(f"expected features of each of {len(entries)} images, got {len(features)}")
        for name, place, _ in entries:
            check_entry(name, place)
        self.describing  # noqa: B018  # raises without a vocabulary
        with self._file.lock():
            self.refresh()
            self._add(entries, features)

    def _add(self, entries: Sequence[Entry], features: Sequence[Features]) -> None:
        """Check and add images within the lock."""
        new_names, dimension, length = set[str](), self.extractor.scales[0].dimension, self._vectors.length
        for (name, _, vector), local in zip(entries, features, strict=True):
            values = np.asarray(vector)
            length = values.size if length is None else length
            if values.shape != (length,) or values.dtype.kind not in "fiu":
                raise InputError(f"{name}: expected a descriptor [{length}], got {list(values.shape)} {values.dtype}")
            if not np.isfinite(values).all():
                raise InputError(f"{name}: expected a descriptor of finite numbers, got NaN or infinity")
            check_features(local, f"{name}: features", unit_length=False)
            if (got := np.shape(local.descriptors)[-1]) != dimension:
                raise InputError(f"{name}: expected features of {dimension} dimensions, got {got}")
            if name in self._row_of_name or name in new_names:
                raise InputError(f"{name}: the map has an image of this name; choose another")
            new_names.add(name)
        self._file.write(self._parts(), [*zip(features, entries, strict=True)])
        self.refresh()

    def _parts(self) -> dict[str, bytes]:
        """Recipe and settings, the first content of a new file; nothing if they are there."""
        check_settings(self._file, self.system)  # another process may have written it first
        parts = {"recipe": self._recipe}
        if self.system.settings is not None:
            parts["system"] = kept_settings(self.system.settings)
        return {} if self._is_checked else {name: json.dumps(part).encode() for name, part in parts.items()}

    @contextmanager
    def _learning(self, images: ImageFolder, cache: FeatureCache | None, track: Track) -> Iterator[FeatureCache | None]:
        """Learn the vocabulary if it is missing, within the lock; yield the cache with its features, if any."""
        self.refresh()
        if self._describing is not None or self._fitting is None:
            yield cache
            return
        temporary = self.folder / _LEARNING
        shutil.rmtree(temporary, ignore_errors=True)  # left by a process that was killed
        try:
            cache = cache or FeatureCache(temporary, runtime=Runtime(progress=lambda label: track))
            vocabulary = self._fitting.fit(cache.local(images, self.extractor)[0])
            arrays = {"centers": vocabulary.centers, "power": np.array(vocabulary.power)}
            self._file.write(self._parts() | {"vocabulary": pack_arrays(arrays)})
            self.refresh()
            yield cache
        finally:
            shutil.rmtree(temporary, ignore_errors=True)

    def _read_features(self, rows: Sequence[int]) -> list[Features]:
        """Features `[n, ...]` of distinct rows, in their order, NumPy; the least recently used ones make room."""
        for row, features in self._file.features([row for row in rows if row not in self._features]):
            self._features[row] = features
            self._free_bytes -= _bytes(features)
        for row in rows:
            self._features.move_to_end(row)
        read = [self._features[row] for row in rows]
        while self._free_bytes < 0:
            self._free_bytes += _bytes(self._features.popitem(last=False)[1])
        return read

    def _mean_strength(self, end: int) -> float:
        """Mean strength of rows that are spread evenly over those before `end`, which depends on `end` alone."""
        step = 1 << max(0, (end // _SAMPLE).bit_length() - 1)
        sample = range(0, end, step)
        unread = [row for row in sample if row not in self._strengths]
        self._strengths |= {row: strength(features) for row, features in self._file.features(unread)}
        return float(np.mean([self._strengths[row] for row in sample])) if end else 0.0

    def _counts(self) -> np.ndarray:
        """`[M]` numbers of keypoints."""
        return self._file.counts()[: len(self)]


def _bytes(features: Features) -> int:
    return sum(leaf.nbytes for leaf in jax.tree.leaves(features))
