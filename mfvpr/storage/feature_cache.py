"""A cache of the features and global descriptors of images, on disk or in memory.

    cache = FeatureCache(Path("~/.cache/mfvpr/features").expanduser())
    [features] = cache.local(folder, Sift())
    vectors = cache.vectors(folder, MixVprDescriptor(model))

The content of an image and the recipe of the extractor name its features, not the folder or the data set: an image that
several data sets or maps share is extracted once.
"""

from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, MutableMapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice
from operator import itemgetter
from pathlib import Path, PurePath
from typing import Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float, Int

from mfvpr.core.types import Features
from mfvpr.datasets.contents import Contents, contents, files_of, state_of
from mfvpr.datasets.datasets import ImageFolder
from mfvpr.features.extractor import Aggregated, Description, Extractor, Source, describe_folder
from mfvpr.features.feature_set import FeatureSet
from mfvpr.features.vlad import Vlad
from mfvpr.storage.cache_files import THREADS, CacheFiles, pack_features, unpack_features
from mfvpr.utils.errors import InputError
from mfvpr.utils.fingerprints import fingerprint, recipe_of, versions
from mfvpr.utils.runtime import DEFAULT_RUNTIME, Runtime, Stopwatch, ordered_map

DECODERS = ("opencv-python-headless", "pillow")  # their versions decide which pixels an image file becomes
# Version of mfvpr that last changed the pixels of decoded or resized images. If `mfvpr.datasets.image_reading` gives
# other pixels, set it to the next version: stored features are then extracted again.
DECODING = "0.3.1"
AGGREGATED = 16  # images at a time

Value = TypeVar("Value")


def states(folder: ImageFolder, rows: Iterable[int] | None = None) -> list[str]:
    """A text for each image, which changes with the file, with its mask, or with the conversion of its pixels."""
    folders = [folder] if folder.mask_files is None else [folder, folder.mask_files]
    rows, way = range(len(folder)) if rows is None else rows, f"{folder.orient} {folder.bits}"
    images = ([f"{each.root}/{each.names[row]}" for each in folders] for row in rows)
    return [f"{paths} {[*map(state_of, paths)]} {way}" for paths in images]


@dataclass
class Recipes:
    """Recipes of a cache in the folder `root`, and results in memory; without a root, hashes of files as well."""

    root: Path | None
    _computed: dict[tuple, tuple[Any, Any]] = field(default_factory=dict, repr=False)

    def once(self, name: str, compute: Callable[[], Value], folder: ImageFolder | None, by: Any) -> Value:
        """Call `compute` once while the images (None = any) and the recipe of `by`, or else its `id`, stay the same."""
        try:
            recipe = fingerprint(recipe_of(by, lambda path: [str(path), *map(state_of, files_of(path).paths)]))
        except TypeError:
            recipe = id(by)
        key = name, recipe, None if folder is None else (folder, hash(tuple(states(folder))))
        if key not in self._computed:
            self._computed[key] = compute(), by  # kept alive, so that no other object gets its id
        return self._computed[key][0]

    def contents(self, folder: ImageFolder) -> Contents:
        """Hashes of the files of a folder; with a root, later runs read them from there."""
        records = None if self.root is None else self.root / "contents"
        return self.once("contents", lambda: contents(folder, records), folder, None)

    def of(self, value: Any) -> Any:
        """See `fingerprints.recipe_of`, with the content of files and folders of files in place of their paths."""

        def content_of(path: PurePath) -> Any:
            if not Path(path).exists():
                return str(path)
            content = self.contents(files_of(path))
            return content.fingerprint if Path(path).is_dir() else content.sha256

        return recipe_of(value, content_of)

    def of_features(self, extractor: Any) -> dict[str, Any]:
        """Everything but the image that changes its features: extractor, versions of decoders."""
        decoders = {"mfvpr": DECODING} | {name: versions()[name] for name in DECODERS}
        return {"extractor": self.of(extractor), "versions": decoders}

    def of_folder(self, folder: ImageFolder, extractor: Any) -> dict[str, Any]:
        """Everything that changes the features of a folder's images."""
        return self.of_features(extractor) | {"images": self.contents(folder).fingerprint}


class Vectors(NamedTuple):
    """Global descriptors of all images of a folder, float32."""

    values: Float[np.ndarray, "_ dimensions"]  # NaN for bad images, which no shortlist contains
    bad: Mapping[int, str]  # row -> reason, for images without a usable descriptor


@dataclass
class Part:
    """The global descriptors of a folder's images, or one scale of their local features; a source of features."""

    folder: ImageFolder
    items: CacheFiles[Any] | MutableMapping[str, Any]  # by key, in files or in memory
    keys: Sequence[str]  # of the images
    counts: np.ndarray  # of keypoints, 1 for a global descriptor; -1 = not looked at yet, or not there

    def missing(self, rows: Iterable[int], warn: Callable[[str], object]) -> Iterator[int]:
        """Rows that are not here; `warn` gets a line for each damaged file."""
        unknown = [row for row in rows if self.counts[row] < 0]
        for row, item in zip(unknown, self._get(unknown), strict=True):
            if item is not None:
                self.counts[row] = _count(item)
                continue
            if isinstance(self.items, CacheFiles) and self.keys[row] in self.items:
                warn(f"{self.items.path(self.keys[row])}: is damaged; made again")
            yield row

    def write(self, rows: Mapping[int, Any]) -> None:
        """Write items by row; with files, they are on disk when this returns."""
        self.items.update({self.keys[row]: item for row, item in rows.items()})
        self.counts[list(rows)] = [_count(item) for item in rows.values()]

    def read(self, rows: Iterable[int] | None = None) -> Iterator[tuple[int, Any]]:
        """(row, item) of rows that are here, by default all, in their order; threads read ahead."""
        rows = np.flatnonzero(self.counts >= 0).tolist() if rows is None else [*rows]
        for row, item in zip(rows, self._get(rows), strict=True):
            if item is None:
                name = self.folder.paths[row]
                raise InputError(f"{name}: its features in the cache were removed or damaged meanwhile; run again")
            yield row, item

    def _get(self, rows: Iterable[int]) -> Iterator[Any]:
        return ordered_map(self.items.get, (self.keys[row] for row in rows), workers=THREADS)


class Descriptions(NamedTuple):
    """Descriptions of a folder's images by one extractor."""

    folder: ImageFolder
    vectors: Part | None  # global descriptors; None if the extractor gives none
    local: list[Part]  # scales of the local features
    states: Sequence[str]  # of the files before they were hashed, see `states`
    bad: dict[int, str]  # row -> reason, for images without a usable description

    def write(self, batch: Mapping[int, Description | str]) -> None:
        """Write the descriptions of a batch, or why images have none."""
        described = {row: each for row, each in batch.items() if isinstance(each, Description)}
        self.bad.update({row: each for row, each in batch.items() if isinstance(each, str)})
        if changed := [row for row in described if states(self.folder, [row]) != [self.states[row]]]:
            path = self.folder.paths[changed[0]]
            raise InputError(f"{path}: changed while it was described; run again when it is complete")
        if self.vectors is not None:
            self.vectors.write({row: each.vector for row, each in described.items()})
        for scale, part in enumerate(self.local):
            part.write({row: each.local[scale] for row, each in described.items()})


@dataclass
class FeatureCache:
    """Features, global descriptors and matches in files below a folder, or in the memory of this process.

    What an extractor, retriever or matcher of your own makes stays in memory, unless it names its `recipe`, see
    `mfvpr.utils.recipe_of`.

    Attributes:
        root: folder of all files; None = in memory.
        skip_bad: list images that cannot be read as bad, and go on, instead of raising.
        runtime: progress and messages; `mfvpr.evaluate(runtime=)` replaces it.
        watch: counts the extraction of local features as the stage `features`.
        recipes: of everything in the cache.
    """

    root: Path | None = None
    skip_bad: bool = False
    runtime: Runtime = DEFAULT_RUNTIME
    watch: Stopwatch | None = None
    recipes: Recipes = field(default_factory=lambda: Recipes(None), repr=False)
    _warned: set[str] = field(default_factory=set, repr=False)

    def __post_init__(self) -> None:
        self.recipes.root = self.root = None if self.root is None else Path(self.root)
        if self.root is None and self.runtime.cluster is not None:
            raise InputError("cluster: expected a cache with a root, a folder that all workers share")

    def warn(self, line: str) -> None:
        """Log a warning, once: several sequences may share a database."""
        if line not in self._warned:
            self._warned.add(line)
            self.runtime.log(f"warning: {line}")

    def recipe(self, compute: Callable[[], dict[str, Any]]) -> dict[str, Any] | None:
        """The recipe that `compute` gives; None, with a warning, if nothing may be kept on disk."""
        if self.root is None:
            return None
        try:
            return compute()
        except TypeError as error:
            self.warn(f"{error}: what it makes is not kept on disk")
            return None

    def local(
        self,
        folder: ImageFolder,
        extractor: Extractor | Source,
        rows: Iterable[int] | None = None,
        *,
        label: str = "image",
    ) -> tuple[FeatureSet, ...]:
        """Local features by scale, to be read on demand, of all images or of those in `rows`.

        `label` names the images in messages. An InputError if an image cannot be read (unless `skip_bad`), or none can,
        or if the disk cannot be used.
        """
        if isinstance(extractor, Source):
            source = self.recipes.once(
                "opened", lambda: extractor.open(folder, partial=self.skip_bad), folder, extractor
            )
            missing = np.flatnonzero(np.asarray(source.counts) < 0).tolist()
            return (FeatureSet(source, {row: f"{folder.paths[row]}: no features were imported" for row in missing}),)
        state = self._open(folder, extractor)
        self._describe(state, extractor, state.local, rows, f"{label} features")
        return tuple(FeatureSet(part, dict(state.bad)) for part in state.local)

    def counts(self, folder: ImageFolder, extractor: Extractor) -> Int[np.ndarray, "scales images"]:
        """Keypoints of the images whose local features are here, by scale; -1 = not here. Nothing is extracted."""
        parts = self._open(folder, extractor).local
        for part in parts:
            deque(part.missing(range(len(folder)), self.warn), maxlen=0)
        return np.stack([part.counts for part in parts])

    def vectors(
        self, folder: ImageFolder, describer: Extractor | Aggregated, database: ImageFolder, *, label: str = "image"
    ) -> Vectors:
        """Global descriptors of all images; an aggregation is fitted on the `database`. Errors are those of `local`."""
        compute = partial(self._compute_vectors, folder, describer, database, label)
        return self.recipes.once("vectors", compute, folder, describer) if folder == database else compute()

    def _describe(
        self, state: Descriptions, extractor: Extractor, parts: Sequence[Part], rows: Iterable[int] | None, label: str
    ) -> None:
        """Run the extractor on all images, or on those in `rows`, of which one of these parts is missing."""
        folder = state.folder
        with self.watch("features") if self.watch is not None and extractor.scales else nullcontext():
            wanted = [row for row in (range(len(folder)) if rows is None else rows) if row not in state.bad]
            if missing := sorted({row for part in parts for row in part.missing(wanted, self.warn)}):
                where = [f" in {part.items.folder}" for part in parts if isinstance(part.items, CacheFiles)][:1]
                self.runtime.log(f"{label}: {len(missing)} of {len(folder)} images to do{''.join(where)}")
                if self.runtime.cluster is not None and hasattr(extractor, "__dataclass_fields__"):
                    extractor = replace(extractor)  # pyright: ignore[reportArgumentType]  # without compiled programs
                shared = folder, extractor, self.skip_bad
                results = self.runtime.map(_describe_rows, shared, missing, label, extractor.batch_size)
                while batch := dict(islice(results, extractor.batch_size)):
                    state.write(batch)
        if state.bad and len(state.bad) == len(folder):
            reason = state.bad[min(state.bad)]
            raise InputError(f"{folder.root}: none of {len(folder)} images can be used; the first: {reason}")

    def _open(self, folder: ImageFolder, extractor: Extractor) -> Descriptions:
        """The descriptions of a folder that are here, in files or in memory."""

        def open_parts() -> Descriptions:
            before, root = states(folder), self.root
            recipe = self.recipe(lambda: self.recipes.of_features(extractor))
            keys = before if recipe is None else self.recipes.contents(folder).keys
            memory = self.recipes.once("memory", lambda: defaultdict[str, dict](dict), None, extractor)

            def part(name: str, pack: Callable[[Any], Any], unpack: Callable[[Any], Any]) -> Part:
                items = memory[name]
                if recipe is not None and root is not None:
                    items = CacheFiles(root, type(extractor).__name__, recipe | {"part": name}, pack, unpack)
                return Part(folder, items, keys, np.full(len(folder), -1))

            vectors = part("vector", lambda vector: {"vector": _single_or_half(vector)}, itemgetter("vector"))
            scales = (part(f"scale {at}", pack_features, unpack_features) for at in range(len(extractor.scales)))
            return Descriptions(folder, vectors if extractor.vector_size else None, [*scales], before, {})

        return self.recipes.once("descriptions", open_parts, folder, extractor)

    def _compute_vectors(
        self, folder: ImageFolder, describer: Extractor | Aggregated, database: ImageFolder, label: str
    ) -> Vectors:
        if not isinstance(describer, Aggregated):
            state = self._open(folder, describer)
            if state.vectors is None:
                expected = "expected one that does, or Aggregated(extractor, VladFitting())"
                raise InputError(f"{type(describer).__name__}: gives no global descriptor; {expected}")
            self._describe(state, describer, [state.vectors], None, f"{label} descriptors")
            values = np.full((len(folder), describer.vector_size), np.nan, np.float32)
            for row, vector in state.vectors.read():
                values[row] = np.reshape(vector, -1)
            return Vectors(values, dict(state.bad))
        [features] = self.local(folder, describer.extractor, label=label)

        def fit() -> Vlad:
            return describer.fitting.fit(*self.local(database, describer.extractor, label="database"))

        aggregation = self.recipes.once("aggregation", fit, database, describer)
        values = np.zeros((len(folder), aggregation.vector_size), np.float32)
        starts = range(0, len(folder), AGGREGATED)
        for start in self.runtime.progress(f"{label} descriptors")(starts, len(starts)):
            if images := dict(features.read(range(len(folder))[start : start + AGGREGATED])):
                values[list(images)] = aggregation(list(images.values()))
        values[list(features.bad)] = np.nan
        return Vectors(values, features.bad)


def _describe_rows(
    folder: ImageFolder, extractor: Extractor, skip_bad: bool, rows: Sequence[int]
) -> Iterator[tuple[int, Description | str]]:
    """(row, description) of images, in batches, and at last (row, reason) of the images that are not used."""
    bad: dict[int, str] = {}
    for batch in describe_folder(folder, extractor, rows, bad, skip_bad=skip_bad):
        yield from batch.items()
    yield from bad.items()


def _single_or_half(vector: Any) -> np.ndarray:
    vector = np.asarray(vector)
    return vector if vector.dtype == np.float16 else np.asarray(vector, np.float32)


def _count(item: Any) -> int:
    return len(item.mask) if isinstance(item, Features) else 1
