"""What a map holds: its settings, and images: how they are described and added, and read on demand."""

import json
import os
import shutil
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial, wraps
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy.typing import ArrayLike

from mfvpr.core.types import Features
from mfvpr.datasets.datasets import ImageFolder
from mfvpr.datasets.image_reading import read_image, resize
from mfvpr.evaluation.system import Note, System
from mfvpr.features.extractor import Description, Extractor, describe_images
from mfvpr.features.feature_set import SHARE, check_features
from mfvpr.features.vlad import Vlad, VladFitting
from mfvpr.matchers.host_matcher import PairSource
from mfvpr.retrieval.search import ExactSearch
from mfvpr.storage.cache_files import pack_arrays, round_as_stored, unpack_arrays
from mfvpr.storage.feature_cache import FeatureCache
from mfvpr.storage.maps import Entry, MapFile, check_entry
from mfvpr.systems import assembly
from mfvpr.systems.assembly import SystemSettings
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import from_values
from mfvpr.utils.files import canonical_name
from mfvpr.utils.fingerprints import recipe_of
from mfvpr.utils.numerics import as_array, available_cpus, free_host_bytes
from mfvpr.utils.runtime import Runtime, ordered_map

_KEPT = ("features", "retrieval", "matching", "scorer", "candidates", "fusion", "final", "ties")  # settings
_ABOUT = 1.5  # relative difference of numbers of pixels: sides are rounded
_FIRST_ROWS = 1024  # of global descriptors; twice as many whenever they are full

Image = Path | str | ArrayLike
Described = tuple[Features, np.ndarray]
Pixels = UInt8[np.ndarray, "_ _ 3"]
Method = TypeVar("Method", bound=Callable[..., Any])


def describers_of(system: System) -> tuple[Extractor, Extractor | VladFitting]:
    """The extractors of features and of global descriptors; an InputError for a system that a map cannot use."""
    pipeline, retriever = system.pipeline, system.pipeline.retriever
    extractor: Any = pipeline.extractor
    describer: Any = getattr(retriever, "describer", None)
    is_own = isinstance(describer, Extractor)
    if isinstance(getattr(describer, "fitting", None), VladFitting):
        is_own = describer.extractor is extractor or recipe_of(describer.extractor) == recipe_of(extractor)
    needs = {
        "an extractor of local features of one scale": isinstance(extractor, Extractor) and len(extractor.scales) == 1,
        "a matcher that JAX can compile": not isinstance(pipeline.matcher, PairSource),
        "a number of candidates": pipeline.candidates != "all",
        "single images; mfvpr.Route follows a drive": not (system.correlated or system.sequences),
        "retrieval by global descriptors without whitening": isinstance(
            getattr(retriever, "search", None), ExactSearch
        ),
        "descriptors of an extractor, or Aggregated(extractor, VladFitting()) of its own": is_own,
    }
    for need, is_met in needs.items():
        if not is_met:
            raise InputError(f"a map needs {need}")
    return extractor, getattr(describer, "fitting", describer)


def read_settings(folder: Path) -> dict[str, Any]:
    """The settings of the map in a folder; an InputError without one, or for a system that no settings describe."""
    if content := MapFile(folder).part("system"):
        return json.loads(content)
    fix = "Make one with `mfvpr map build` or `Map.create`"
    open_map = "open a map of a system of your own with `Map(folder, system)`"
    raise InputError(f"{folder}: expected a folder with a map, got none. {fix}, or {open_map}.")


def read_system(folder: Path) -> System:
    """The system that a map was made with; raises as `read_settings`, or if weights are missing."""
    settings = read_settings(folder)
    try:
        return assembly.system(from_values(SystemSettings, settings))
    except InputError as error:
        raise InputError(f"{folder}: {error}") from None


def fit_to_map(folder: Path, system: System, images: ImageFolder | None, note: Note) -> System:
    """The system at the image size of the map in a folder; in a new one, at that of the images, see `System`.

    Raises `InputError` if a new map has no images to take the shape from, or as `read_settings`.
    """
    if system.pipeline.pixels is None:
        return system
    if system.settings is not None and MapFile(folder).part("system") is not None:
        width, height = read_settings(folder)["features"]["image_size"]
        if not 1 / _ABOUT < width * height / system.pipeline.pixels < _ABOUT:
            got = f"{system.pipeline.pixels} pixels. Use features.image_size=[{width},{height}]"
            raise InputError(f"{folder}: this map was made with images of {width} x {height} px, got {got}.")
        return system.with_image_size((width, height))
    if images is None:
        fix = "Use `Map.create`, or a system with features.image_size=[WIDTH,HEIGHT]"
        raise InputError(f"image_size: expected the images of a new map, whose shape decides, got none. {fix}.")
    return system.fit_image_size([images], note)


def exclusive(method: Method) -> Method:
    """Let one thread at a time run a method of a map."""

    @wraps(method)
    def run(self: "MapImages", *arguments: Any, **options: Any) -> Any:
        with self._lock:
            return method(self, *arguments, **options)

    return run  # pyright: ignore[reportReturnType]  # of the same arguments


def load(image: Image) -> Pixels:
    """Read an image file, or convert an array; an InputError if it is no image."""
    if isinstance(image, str | os.PathLike):
        return read_image(image)
    pixels: Any = np.zeros(0)
    try:
        pixels = np.asarray(as_array(image))
        got = f"{list(pixels.shape)} {pixels.dtype}"
    except Exception as error:  # other libraries raise any error, torch for tensors with gradients
        got = f"{type(image).__name__} ({' '.join(str(error).split())})"
    if pixels.ndim != 3 or pixels.shape[2] != 3 or not pixels.size or pixels.dtype != np.uint8:
        raise InputError(f"image: expected a file or [H, W, 3] uint8 RGB, got {got}. Convert it to a NumPy array.")
    return pixels


@dataclass(frozen=True)
class Describing:
    """Extractors of a map; the features of queries are rounded as a store rounds the features of the map."""

    extractor: Extractor  # of local features of one scale
    describer: Extractor | Vlad  # of global descriptors; may be the same extractor

    def image(self, image: Image) -> Described:
        """Describe one image: a file, or `[H, W, 3]` uint8 RGB in any form that `np.asarray` converts."""
        return self.pixels(load(image))[0]

    def pixels(self, pixels: Pixels) -> tuple[Described, Pixels]:
        """Describe one image; also return it at the size of the extractor."""
        resized, description = self._extract(self.extractor, pixels)
        features = round_as_stored(description.features)
        if not isinstance(self.describer, Extractor):
            [vector] = self.describer([features])
            return (features, vector), resized
        if self.describer is not self.extractor:
            _, description = self._extract(self.describer, pixels)
        if description.vector is None:
            raise InputError("describer: gives no global descriptor; expected one that does, or VladFitting()")
        return (features, np.asarray(description.vector, np.float32).reshape(-1)), resized

    def _extract(self, extractor: Extractor, pixels: Pixels) -> tuple[Pixels, Description]:
        """An image at the size of an extractor, and its description."""
        resized = resize(pixels, extractor.image_size, extractor.interpolation)
        [description] = describe_images(resized[None], extractor)
        if description is None:
            raise InputError("image: features are not finite (NaN or infinite)")
        return resized, description

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


class Vectors:
    """Global descriptors by row; NaN of an image without features, which is never a candidate."""

    def __init__(self) -> None:
        self._values, self._total = np.zeros((0, 0), np.float32), 0  # rows that are used

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
        self._values[self._total] = vector if vector.any() else np.nan
        self._total += 1

    def nearest(
        self, query: Float[np.ndarray, " dimensions"], number: int, *, before: int
    ) -> tuple[Int[np.ndarray, " candidates"], Float[np.ndarray, " candidates"]]:
        """At most `number` rows `before` a row, and their products with the query, most similar first, then by row."""
        # Own threads: those of BLAS spin while they wait, which costs a third of the time.
        workers = available_cpus()
        parts = np.array_split(self._values[:before], workers)
        products = np.concatenate([*ordered_map(partial(np.vecdot, query), parts, workers=workers)])
        rows = np.flatnonzero(np.isfinite(products) & query.any())
        if len(rows) > number:
            least = np.partition(products[rows], -number)[-number]
            rows = rows[products[rows] >= least]
        best = rows[np.argsort(-products[rows], kind="stable")][:number]
        return best, products[best]


class MapImages:
    """The images of a map, which other processes may add as well: the base of `mfvpr.localization.Map`."""

    def __init__(self, folder: Path, system: System, runtime: Runtime) -> None:
        """Open a map; see `mfvpr.localization.Map`."""
        self.folder = folder.absolute()  # the working directory may change
        self.extractor, describer = describers_of(system)
        self.system, self.candidates = system, int(system.pipeline.candidates)
        self._runtime, self._file, self._lock = runtime, MapFile(self.folder), threading.RLock()
        try:
            parts = {"recipe": {"extractor": recipe_of(self.extractor), "describer": recipe_of(describer)}}
        except TypeError as error:
            fix = "by which a map knows what made its features; see mfvpr.utils.recipe_of"
            raise InputError(f"{error}, {fix}") from None
        if system.settings is not None:
            parts = {"system": {name: system.settings[name] for name in _KEPT}} | parts
        self._parts: dict[str, Any] = json.loads(json.dumps(parts))  # tuples become lists
        self._is_checked = False  # whether the file is known to have these parts
        self._fitting = describer if isinstance(describer, VladFitting) else None
        self._describing = None if isinstance(describer, VladFitting) else Describing(self.extractor, describer)
        self._names, self._places, self._row_of_name = list[str](), list[Any](), dict[str, int]()
        self._counts, self._strengths = list[int](), [0.0]  # of keypoints, and sums of strengths of the first rows
        self._vectors = Vectors()
        self._features = OrderedDict[int, Features]()  # of the recently used rows
        self._free_bytes = SHARE * free_host_bytes() if runtime.memory is None else 1e9 * runtime.memory
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

        An InputError if the map was made with other settings, or is damaged.
        """
        before = len(self)
        for part, now in () if self._is_checked else self._parts.items():
            stored = json.loads(self._file.part(part) or b"{}")
            if differing := " and ".join(name for name in stored if stored[name] != now.get(name)):
                fix = "Use what it was made with (`mfvpr map info`), or name another folder"
                raise InputError(f"{self.folder}: this map was made with other {differing}. {fix}.")
            self._is_checked = bool(stored)  # the last part is in every map
        if self._describing is None and (content := self._file.part("vocabulary")) is not None:
            arrays = unpack_arrays(content)
            self._describing = Describing(self.extractor, Vlad(arrays["centers"], float(arrays["power"])))
        for entry, count, strength in self._file.entries(before):
            self._vectors.append(entry.vector)
            self._row_of_name[entry.name] = len(self)
            self._names.append(entry.name)
            self._places.append(entry.place)
            self._counts.append(count)
            self._strengths.append(self._strengths[-1] + strength)
        return len(self) - before

    @exclusive
    def learn(self, images: ImageFolder, *, cache: FeatureCache | None = None) -> None:
        """Learn the vocabulary from some images, unless the map has one; arguments and errors are those of `build`."""
        if self._describing is None:
            with self._learned(images, cache):
                pass

    @exclusive
    def build(
        self, images: ImageFolder, places: Sequence[Any] | None = None, *, cache: FeatureCache | None = None
    ) -> int:
        """Add the images whose names the map does not have yet; return how many were added.

        Args:
            images: to add. If the map needs a vocabulary and has none, it is learned from them first.
            places: of each image, JSON values; None = the names.
            cache: keeps the features, so that images that it knows are not described again. Without one, the folder
                takes twice the space until all images are added.

        Raises:
            InputError: an image cannot be read, another process adds, or the disk is full: what was added stays.
        """
        places = images.names if places is None else places
        if len(places) != len(images):
            raise InputError(f"expected a place of each of {len(images)} images, got {len(places)}")
        place_of = dict(zip(images.names, places, strict=True))
        for name, place in place_of.items():
            check_entry(name, place)
        self.refresh()
        if {*images.names} <= {*self._row_of_name}:  # also in a map that can only be read
            return 0
        with self._learned(images, cache) as cache:
            before, names = len(self), tuple(name for name in images.names if name not in self._row_of_name)
            for batch in self.describing.folder(replace(images, names=names), cache):
                entries = [Entry(names[row], place_of[names[row]], vector) for row, (_, vector) in batch.items()]
                self._add(entries, [features for features, _ in batch.values()])
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
        if name is None and isinstance(image, str | os.PathLike):
            name = canonical_name(Path(image))
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
        self.describing  # noqa: B018  # raises without a vocabulary
        with self._file.lock():
            self.refresh()
            self._add(entries, features)

    def _add(self, entries: Sequence[Entry], features: Sequence[Features]) -> None:
        """Check and add images within the lock."""
        new_names, dimension = set[str](), self.extractor.scales[0].dimension
        length = self._vectors.length or np.size(entries[0].vector)
        for (name, _, vector), local in zip(entries, features, strict=True):
            values = np.asarray(vector)
            if values.shape != (length,) or values.dtype.kind not in "fiu" or not np.isfinite(values).all():
                got = f"{list(values.shape)} {values.dtype}"
                raise InputError(f"{name}: expected a descriptor [{length}] of finite numbers, got {got}")
            check_features(local, f"{name}: features", unit_length=False)
            if (got := np.shape(local.descriptors)[-1]) != dimension:
                raise InputError(f"{name}: expected features of {dimension} dimensions, got {got}")
            if name in self._row_of_name or name in new_names:
                raise InputError(f"{name}: the map has an image of this name; choose another")
            new_names.add(name)
        self._write({}, [*zip(features, entries, strict=True)])

    def _write(self, parts: dict[str, bytes], images: Sequence[tuple[Features, Entry]] = ()) -> None:
        """Write parts and images, and settings first if the map is new; the lock is held."""
        self.refresh()  # another process may have made the map meanwhile, with other settings
        new = {} if self._is_checked else {name: json.dumps(part).encode() for name, part in self._parts.items()}
        self._file.write(new | parts, images)
        self.refresh()

    @contextmanager
    def _learned(self, images: ImageFolder, cache: FeatureCache | None) -> Iterator[FeatureCache]:
        """Hold the lock, learn the vocabulary if it is missing, and yield a cache with its features."""
        temporary = self.folder / ".features"  # stays if the process is interrupted: the next one goes on with it
        with self._file.lock():
            self.refresh()
            cache = cache or FeatureCache(temporary, runtime=self._runtime)
            if self._describing is None and self._fitting is not None:
                vocabulary = self._fitting.fit(cache.local(images, self.extractor)[0])
                arrays = {"centers": vocabulary.centers, "power": np.array(vocabulary.power)}
                self._write({"vocabulary": pack_arrays(arrays)})
            yield cache
            shutil.rmtree(temporary, ignore_errors=True)

    def _read_features(self, rows: Sequence[int]) -> list[Features]:
        """Features `[n, ...]` of distinct rows, in their order, NumPy; the least recently used ones make room."""
        bytes_of = lambda features: sum(leaf.nbytes for leaf in jax.tree.leaves(features))  # noqa: E731
        for row, features in self._file.features([row for row in rows if row not in self._features]):
            self._features[row] = features
            self._free_bytes -= bytes_of(features)
        for row in rows:
            self._features.move_to_end(row)
        read = [self._features[row] for row in rows]
        while self._free_bytes < 0:
            self._free_bytes += bytes_of(self._features.popitem(last=False)[1])
        return read
