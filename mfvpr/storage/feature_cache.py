"""A cache of the features and global descriptors of images, on disk or in memory.

    cache = FeatureCache(Path("~/.cache/mfvpr/features").expanduser())
    [features] = cache.local(folder, Sift())
    vectors = cache.vectors(folder, MixVprDescriptor(model))

The content of an image and the recipe of the extractor name its features, not the folder or the data set: an image that
several data sets or maps share is extracted once.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, MutableMapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice
from operator import itemgetter
from pathlib import Path, PurePath
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float, Int

from mfvpr.core.types import Features
from mfvpr.datasets.contents import Contents, contents, files_of, state_of
from mfvpr.datasets.datasets import ImageFolder
from mfvpr.features.extractor import Aggregated, Description, Extractor, Source, describe_folder
from mfvpr.features.feature_set import FeatureSet, FeatureSource
from mfvpr.features.vlad import Vlad
from mfvpr.storage.cache_files import THREADS, CacheFiles
from mfvpr.storage.packing import pack_features, unpack_features
from mfvpr.utils.errors import InputError
from mfvpr.utils.fingerprints import fingerprint, recipe_of, versions
from mfvpr.utils.runtime import DEFAULT_RUNTIME, Runtime, Stopwatch, ordered_map

DECODERS = ("opencv-python-headless", "pillow")  # their versions decide which pixels an image file becomes
# Version of mfvpr that last changed the pixels of decoded or resized images. If `mfvpr.datasets.image_reading` gives
# other pixels, set it to the next version: stored features are then extracted again.
DECODING = "0.3.0"
AGGREGATED = 16  # images at a time

Value = TypeVar("Value")
Items = CacheFiles[Any] | MutableMapping[str, Any]  # one part of descriptions by key


@dataclass
class Memo:
    """Results by their name, their images, and the recipe of the extractor or retrieval that computes them."""

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


def states(folder: ImageFolder, rows: Iterable[int] | None = None) -> list[str]:
    """A text for each image, which changes with the file, or with the conversion of its pixels."""
    how = folder.orient, folder.bits
    names = folder.names if rows is None else [folder.names[row] for row in rows]
    paths = (f"{folder.root}/{image}" for image in names)
    return [f"{path} {state_of(path)} {how}" for path in paths]


@dataclass
class Recipes:
    """Recipes of a cache in the folder `root`; None = hashes of files are not kept on disk."""

    root: Path | None
    _memo: Memo = field(default_factory=Memo, repr=False)

    def contents(self, folder: ImageFolder) -> Contents:
        """Hashes of the files of a folder; with a root, later runs read them from there."""
        records = None if self.root is None else self.root / "contents"
        return self._memo.once("contents", lambda: contents(folder, records), folder, None)

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


@dataclass(frozen=True)
class Vectors:
    """Global descriptors of all images of a folder.

    Attributes:
        values: float32; NaN for bad images, which no shortlist contains.
        bad: row -> reason, for images without a usable descriptor.
    """

    values: Float[np.ndarray, "_ dimensions"]
    bad: Mapping[int, str]


@dataclass
class Descriptions:
    """Descriptions of a folder's images by one extractor, each part in files or in memory; workers of a cluster get it.

    Attributes:
        parts: the global descriptor, if the extractor gives one, and each scale of its local features.
        scales: numbers of the parts that are local features.
        keys: of the images.
        states: of the files before they were hashed, see `states`.
        counts: `[parts, M]` keypoints of each image, 1 for a global descriptor; -1 = not looked at yet, or not there.
        bad: row -> reason, for images without a usable description.
    """

    folder: ImageFolder
    parts: list[Items]
    scales: range
    keys: Sequence[str]
    states: Sequence[str]
    counts: np.ndarray
    bad: dict[int, str] = field(default_factory=dict)

    def missing(self, parts: Iterable[int], rows: Iterable[int]) -> tuple[list[int], list[Path]]:
        """Rows of which a part is not here, without bad ones, and files that are damaged."""
        missing, damaged = set[int](), list[Path]()
        for part in parts:
            items = self.parts[part]
            unknown = [row for row in rows if self.counts[part, row] < 0 and row not in self.bad]
            read = ordered_map(lambda row, items=items: items.get(self.keys[row]), unknown, workers=THREADS)
            for row, item in zip(unknown, read, strict=True):
                if item is not None:
                    self.counts[part, row] = _count(item)
                    continue
                missing.add(row)
                if isinstance(items, CacheFiles) and self.keys[row] in items:
                    damaged.append(items.path(self.keys[row]))
        return sorted(missing), damaged

    def write(self, batch: Mapping[int, Description | str]) -> None:
        """Write the descriptions of a batch; with files, they are on disk when this returns."""
        described = {row: each for row, each in batch.items() if isinstance(each, Description)}
        self.bad |= {row: each for row, each in batch.items() if isinstance(each, str)}
        if changed := [row for row in described if states(self.folder, [row]) != [self.states[row]]]:
            path = self.folder.paths[changed[0]]
            raise InputError(f"{path}: changed while it was described; run again when it is complete")
        for part, items in enumerate(self.parts):
            scale = part - self.scales.start
            of_part = {row: each.vector if scale < 0 else each.local[scale] for row, each in described.items()}
            items.update({self.keys[row]: item for row, item in of_part.items()})
            self.counts[part, list(of_part)] = [_count(item) for item in of_part.values()]

    def read(self, part: int, rows: Iterable[int]) -> Iterator[tuple[int, Any]]:
        """(row, item) of rows that are here, in their order; threads read ahead."""
        rows, items = list(rows), self.parts[part]
        keys = [self.keys[row] for row in rows]
        for row, item in zip(rows, ordered_map(items.get, keys, workers=THREADS), strict=True):
            if item is None:
                name = self.folder.paths[row]
                raise InputError(f"{name}: its features in the cache were removed or damaged meanwhile; run again")
            yield row, item


@dataclass(frozen=True)
class _LocalFeatures:
    """One scale of descriptions as a source of features."""

    descriptions: Descriptions
    part: int

    @property
    def counts(self) -> np.ndarray:
        return self.descriptions.counts[self.part]

    def read(self, rows: Iterable[int] | None = None) -> Iterator[tuple[int, Features]]:
        rows = np.flatnonzero(self.counts >= 0).tolist() if rows is None else rows
        return self.descriptions.read(self.part, rows)


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
    """

    root: Path | None = None
    skip_bad: bool = False
    runtime: Runtime = DEFAULT_RUNTIME
    watch: Stopwatch | None = None
    _memo: Memo = field(default_factory=Memo, repr=False)
    _warned: set[str] = field(default_factory=set, repr=False)

    def __post_init__(self) -> None:
        self.root = None if self.root is None else Path(self.root)
        if self.root is None and self.runtime.cluster is not None:
            raise InputError("cluster: expected a cache with a root, a folder that all workers share")

    @property
    def recipes(self) -> Recipes:
        """Recipes of everything in the cache."""
        return Recipes(self.root, self._memo)

    def once(self, name: str, compute: Callable[[], Value], folder: ImageFolder, by: Any) -> Value:
        """See `Memo.once`."""
        return self._memo.once(name, compute, folder, by)

    def log(self, line: str) -> None:
        """Log a line; see `Runtime`."""
        self.runtime.log(line)

    def warn(self, line: str) -> None:
        """Log a warning, once: several sequences may share a database."""
        if line not in self._warned:
            self._warned.add(line)
            self.log(f"warning: {line}")

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

        `label` names the images in messages.

        Raises:
            InputError: an image cannot be read (unless `skip_bad`), or none can; or the disk cannot be used.
        """
        if isinstance(extractor, Source):

            def open_source() -> FeatureSource:
                opened = extractor.open(folder, partial=self.skip_bad)
                counts = np.asarray(opened.counts)[np.asarray(opened.counts) >= 0]
                about = f"about {np.mean(counts) if len(counts) else 0:.0f} features each"
                self.log(f"{label} features: {len(counts)} of {len(folder)} images imported, {about}")
                return opened

            source = self.once("opened", open_source, folder, extractor)
            missing = np.flatnonzero(np.asarray(source.counts) < 0).tolist()
            return (FeatureSet(source, {row: f"{folder.paths[row]}: no features were imported" for row in missing}),)
        state = self._open(folder, extractor)
        self._describe(state, extractor, state.scales, rows, f"{label} features")
        _require_images(state)
        return tuple(FeatureSet(_LocalFeatures(state, part), dict(state.bad)) for part in state.scales)

    def counts(self, folder: ImageFolder, extractor: Extractor) -> Int[np.ndarray, "scales images"]:
        """Keypoints of the images whose local features are here, by scale; -1 = not here. Nothing is extracted."""
        state = self._open(folder, extractor)
        state.missing(state.scales, range(len(folder)))
        return state.counts[state.scales]

    def vectors(
        self,
        folder: ImageFolder,
        describer: Extractor | Aggregated,
        database: ImageFolder,
        rows: Iterable[int] | None = None,
        *,
        label: str = "image",
    ) -> Vectors:
        """Global descriptors of all images, or of those in `rows`; an aggregation is fitted on the `database`.

        `label` and errors are those of `local`.
        """
        if isinstance(describer, Aggregated):
            compute = partial(self._aggregate, folder, describer, database, label)
        elif describer.vector_size:
            compute = partial(self._vectors, folder, describer, rows, label)
        else:
            expected = "expected one that does, or Aggregated(extractor, VladFitting())"
            raise InputError(f"{type(describer).__name__}: gives no global descriptor; {expected}")
        is_kept = folder == database and rows is None
        return self.once("vectors", compute, folder, describer) if is_kept else compute()

    def describe(
        self, folder: ImageFolder, extractor: Extractor, rows: Iterable[int] | None = None, *, label: str = "image"
    ) -> Descriptions:
        """Run the extractor on all images, or on those in `rows`, that are missing; `label` stands in messages."""
        state = self._open(folder, extractor)
        self._describe(state, extractor, range(len(state.parts)), rows, label)
        return state

    def _describe(
        self, state: Descriptions, extractor: Extractor, parts: Iterable[int], rows: Iterable[int] | None, label: str
    ) -> None:
        folder = state.folder
        with self.watch("features") if self.watch is not None and extractor.scales else nullcontext():
            missing, damaged = state.missing(parts, range(len(folder)) if rows is None else [*rows])
            for path in damaged:
                self.warn(f"{path}: is damaged; made again")
            if missing:
                where = [f" in {items.folder}" for items in state.parts if isinstance(items, CacheFiles)][:1]
                self.log(f"{label}: {len(missing)} of {len(folder)} images to do{''.join(where)}")
                if self.runtime.cluster is not None and hasattr(extractor, "__dataclass_fields__"):
                    extractor = replace(extractor)  # pyright: ignore[reportArgumentType]  # without compiled programs
                shared = folder, extractor, self.skip_bad
                results = self.runtime.map(_describe_rows, shared, missing, label, extractor.batch_size)
                while batch := dict(islice(results, extractor.batch_size)):
                    state.write(batch)

    def _open(self, folder: ImageFolder, extractor: Extractor) -> Descriptions:
        return self.once("descriptions", lambda: self._open_parts(folder, extractor), folder, extractor)

    def _open_parts(self, folder: ImageFolder, extractor: Extractor) -> Descriptions:
        keys = before = states(folder)
        names = ["vector"] if extractor.vector_size else []
        names += [f"scale {number}" for number in range(len(extractor.scales))]
        recipe = self.recipe(lambda: self.recipes.of_features(extractor))
        if recipe is None or self.root is None:
            parts: list[Items] = self._memo.once("memory", lambda: [{} for _ in names], None, extractor)
        else:
            keys = self.recipes.contents(folder).keys
            of_vectors = lambda vector: {"vector": np.asarray(vector, np.float32)}, itemgetter("vector")
            of_scales, root, name = (pack_features, unpack_features), self.root, type(extractor).__name__
            parts = [
                CacheFiles(root, name, recipe | {"part": part}, *(of_vectors if part == "vector" else of_scales))
                for part in names
            ]
        scales = range(len(names) - len(extractor.scales), len(names))
        return Descriptions(folder, parts, scales, keys, before, np.full((len(names), len(folder)), -1))

    def _vectors(self, folder: ImageFolder, describer: Extractor, rows: Iterable[int] | None, label: str) -> Vectors:
        state = self._open(folder, describer)
        self._describe(state, describer, [0], rows, f"{label} descriptors")
        _require_images(state)
        values = np.full((len(folder), describer.vector_size), np.nan, np.float32)
        for row, vector in state.read(0, np.flatnonzero(state.counts[0] > 0).tolist()):
            values[row] = np.reshape(vector, -1)
        return Vectors(values, dict(state.bad))

    def _aggregate(self, folder: ImageFolder, describer: Aggregated, database: ImageFolder, label: str) -> Vectors:
        [features] = self.local(folder, describer.extractor, label=label)

        def fit() -> Vlad:
            return describer.fitting.fit(*self.local(database, describer.extractor, label="database"))

        aggregation = self.once("aggregation", fit, database, describer)
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


def _require_images(state: Descriptions) -> None:
    if len(state.bad) == len(state.folder):
        reason = state.bad[min(state.bad)]
        raise InputError(f"{state.folder.root}: none of {len(state.folder)} images can be used; the first: {reason}")


def _count(item: Any) -> int:
    return len(item.mask) if isinstance(item, Features) else 1
