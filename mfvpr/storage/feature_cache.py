"""A cache of the features and global descriptors of images, on disk or in memory.

    cache = FeatureCache(Path("~/.cache/mfvpr/features").expanduser())
    [features] = cache.local(folder, Sift())
    vectors = cache.vectors(folder, MixVprDescriptor(model))

The content of the images and the recipe of the extractor name a store, not the data set, so that a database which
several data sets share is extracted once.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path, PurePath
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float

from mfvpr.datasets.contents import Contents, contents, files_of, state_of
from mfvpr.datasets.datasets import ImageFolder
from mfvpr.features.extraction import describe_folder
from mfvpr.features.extractor import Aggregated, Aggregation, Extractor, Source
from mfvpr.features.feature_set import FeatureSet, FeatureSource, InMemory
from mfvpr.storage import matches as match_stores
from mfvpr.storage.feature_writers import ExtractionState, open_sinks, size_lines
from mfvpr.storage.manifest import MATCHES, store_path
from mfvpr.storage.rows import require_space
from mfvpr.storage.shards import Shard
from mfvpr.utils.errors import InputError
from mfvpr.utils.fingerprints import fingerprint, recipe_of
from mfvpr.utils.progress import Stopwatch
from mfvpr.utils.runtime import DEFAULT_RUNTIME, Runtime
from mfvpr.utils.versions import versions

DECODERS = ("opencv-python-headless", "pillow")  # their versions decide which pixels an image file becomes
# Version of mfvpr that last changed the pixels of decoded or resized images. If `mfvpr.datasets.images` gives other
# pixels, set it to the next version: stored features are then extracted again.
DECODING = "0.2.0"
AGGREGATED = 16  # images at a time
_MB = 1e6

Value = TypeVar("Value")


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
class FeatureCache:
    """Features, global descriptors and matches in stores below a folder, or in the memory of this process.

    Attributes:
        root: folder of all stores; None = in memory.
        skip_bad: list images that cannot be read as bad, and go on, instead of raising.
        wait: wait for another process that writes the same store, instead of raising.
        shard: extracts its own images alone, and reads the rest from the stores of other shards; see
            `mfvpr.storage.shards`. It needs a root.
        runtime: progress and messages; `mfvpr.evaluate(runtime=)` replaces it.
        watch: counts the extraction of local features as the stage `features`.
    """

    root: Path | None = None
    skip_bad: bool = False
    wait: bool = False
    shard: Shard | None = None
    runtime: Runtime = DEFAULT_RUNTIME
    watch: Stopwatch | None = None
    _computed: dict[tuple, tuple[Any, Any]] = field(default_factory=dict, repr=False)
    _warned: set[str] = field(default_factory=set, repr=False)

    def __post_init__(self) -> None:
        self.root = None if self.root is None else Path(self.root)
        if self.shard is not None and self.root is None:
            raise InputError(f"shard={self.shard}: expected a root as well, the folder of the stores of all shards")

    def contents(self, folder: ImageFolder) -> Contents:
        """Hashes of the files of a folder; with a root, later runs read them from there."""
        records = None if self.root is None else self.root / "contents"
        return self.once("contents", lambda: contents(folder, records), folder, None)

    def once(self, name: str, compute: Callable[[], Value], folder: ImageFolder, by: Any) -> Value:
        """The result of `compute`, called once in this process while the images and the recipe of `by` stay the same.

        Without a recipe, the `id` of `by` counts: the extractor or retrieval that computes the result called `name`.
        """
        try:
            recipe = fingerprint(recipe_of(by, lambda path: [str(path), *map(state_of, files_of(path).paths)]))
        except TypeError:
            recipe = id(by)
        key = name, folder, hash(tuple(str(state_of(f"{folder.root}/{image}")) for image in folder.names)), recipe
        if key not in self._computed:
            self._computed[key] = compute(), by  # kept alive, so that no other object gets its id
        return self._computed[key][0]

    def recipe_of(self, value: Any) -> Any:
        """See `fingerprints.recipe_of`, with the content of files and folders of files in place of their paths."""
        return recipe_of(value, self._content_of)

    def log(self, line: str) -> None:
        """Log a line; see `Runtime`."""
        self.runtime.log(line)

    def warn(self, line: str) -> None:
        """Log a warning, once: several sequences may share a database."""
        if line not in self._warned:
            self._warned.add(line)
            self.log(f"warning: {line}")

    def recipe(self, folder: ImageFolder, extractor: Extractor | Aggregated | Source) -> dict[str, Any]:
        """Everything that changes the features of a folder's images: extractor, images, versions of decoders."""
        decoders = {"mfvpr": DECODING} | {name: versions()[name] for name in DECODERS}
        return {
            "extractor": self.recipe_of(extractor),
            "images": self.contents(folder).fingerprint,
            "versions": decoders,
        }

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
            InputError: an image cannot be read (unless `skip_bad`), or none can; or a store cannot be used.
            NotYet: other shards have not extracted their images.
        """
        if isinstance(extractor, Source):
            source = self.once("opened", lambda: self._open_source(folder, extractor, label), folder, extractor)
            missing = np.flatnonzero(np.asarray(source.counts) < 0).tolist()
            return (FeatureSet(source, {row: f"{folder.paths[row]}: no features were imported" for row in missing}),)
        state = self._extract(folder, extractor, range(len(folder)) if rows is None else [*rows], f"{label} features")
        return tuple(
            FeatureSet(sink.store or InMemory(sink.items, len(folder)), dict(state.bad)) for sink in state.of_scales
        )

    def vectors(self, folder: ImageFolder, describer: Extractor | Aggregated, database: ImageFolder, *,
                label: str = "image") -> Vectors:  # fmt: skip
        """Global descriptors of all images; an aggregation is fitted on the `database`.

        `label` and errors are those of `local`.
        """
        if not isinstance(describer, Aggregated) and not describer.vector_size:
            raise InputError(f"{type(describer).__name__}: gives no global descriptor; expected one that does, or "
                             "Aggregated(extractor, VladFitting())")  # fmt: skip
        compute = partial(self._vectors, folder, describer, database, label)
        return self.once("vectors", compute, folder, describer) if folder == database else compute()

    @contextmanager
    def matches(
        self, recipe: Mapping[str, Any], names: Sequence[str], num_candidates: int, *, typical: int, label: str
    ) -> Iterator[match_stores.MatchStore]:
        """The store of the matches of queries by name, locked while queries are missing; needs a root.

        `typical` is the number of matches of a pair, about; `label` names the matches in messages.
        """
        if self.root is None:
            raise ValueError("nothing is kept on disk: this cache has no root")
        path = store_path(self.root, "matches", recipe, MATCHES)
        sizes = {"num_queries": len(names), "num_candidates": num_candidates}
        rows = range(len(names)) if self.shard is None else self.shard.rows(names)
        with match_stores.open_match_store(path, recipe, **sizes, **self.store_options) as store:
            if missing := sum(not store.done[row] for row in rows):
                needed = match_stores.forecast_bytes(missing, num_candidates, typical)
                require_space(store.folder, needed)
                self.log(f"{label}: {missing} of {len(names)} queries to match with {num_candidates} candidates: "
                          f"about {needed / _MB:.1f} MB in {store.folder}")  # fmt: skip
            else:
                amount = "all" if store.done.all() else "its part of"
                self.log(f"{label}: {amount} {len(names)} queries from {store.folder}")
            yield store

    @property
    def store_options(self) -> dict[str, Any]:
        """The arguments `waiting` and `shard` of `storage.rows.RowStore`."""
        return {"waiting": self.log if self.wait else None, "shard": self.shard}

    def _content_of(self, path: PurePath) -> Any:
        path = Path(path)
        if not path.exists():
            return str(path)
        content = self.contents(files_of(path))
        return content.fingerprint if path.is_dir() else content.sha256

    def _open_source(self, folder: ImageFolder, source: Source, label: str) -> FeatureSource:
        opened = source.open(folder, partial=self.skip_bad)
        counts = np.asarray(opened.counts)
        number, typical = int((counts >= 0).sum()), np.mean(counts[counts >= 0]) if (counts >= 0).any() else 0
        self.log(f"{label} features: {number} of {len(folder)} images imported, about {typical:.0f} features each")
        return opened

    def _extract(self, folder: ImageFolder, extractor: Extractor, rows: Sequence[int], label: str) -> ExtractionState:
        """Run the extractor on the rows that are missing."""
        state = self.once("state", lambda: self._open_state(folder, extractor), folder, extractor)
        with ExitStack() as stack:
            if self.watch is not None and extractor.scales:
                stack.enter_context(self.watch("features"))
            if any(sink.missing(rows) for sink in state.sinks):
                for sink in state.sinks:
                    if sink.store is not None:
                        stack.enter_context(sink.store)
            if self.skip_bad:
                state.read_bad()
            missing = state.missing(rows if self.shard is None else self.shard.rows(folder.names, rows))
            self._announce(extractor, state, missing, len(rows), len(folder), label)
            options = {"skip_bad": self.skip_bad, "track": self.runtime.progress(label)}
            for batch in describe_folder(folder, extractor, missing, state.bad, **options):
                for sink in state.sinks:
                    sink.write(batch)
            if missing:
                state.write_bad()
                for line in size_lines(state.of_scales, extractor.scales):
                    self.log(f"{label}: {line}")
        if self.shard is not None:
            self.shard.require_rows(state.look(rows), folder.names, label)
        if len(state.bad) == len(folder):
            raise InputError(f"{folder.root}: none of {len(folder)} images can be used; the first: "
                             f"{state.bad[min(state.bad)]}")  # fmt: skip
        return state

    def _open_state(self, folder: ImageFolder, extractor: Extractor) -> ExtractionState:
        recipe = self.recipe(folder, extractor) if self.root is not None else {}
        sinks = open_sinks(self.root, extractor, recipe, num_images=len(folder), **self.store_options)
        return ExtractionState(sinks, sinks[bool(extractor.vector_size) :])

    def _announce(
        self, extractor: Extractor, state: ExtractionState, missing: Sequence[int], count: int, total: int, label: str
    ) -> None:
        """Tell how many of `count` images are missing; if none, only once."""
        stores = [sink.store for sink in state.sinks if sink.store is not None]
        if not stores or not count or (state.is_announced and not missing):
            return
        where, state.is_announced = ", ".join(str(store.folder) for store in stores), True
        if not missing:
            number = f"all {total}" if count == total else f"the {count} of {total}"
            self.log(f"{label}: {number} images from {where}")
            return
        needed = sum(sink.forecast(len(missing)) for sink in state.sinks)
        require_space(stores[0].folder, needed)
        scales = [f"about {scale.typical_count} features of {scale.dimension} dimensions each"
                  for scale in extractor.scales]  # fmt: skip
        each = ", ".join(scales) or f"descriptors of {extractor.vector_size} numbers"
        self.log(f"{label}: {len(missing)} of {total} images to do, {each}: about {needed / _MB:.1f} MB in {where}")

    def _vectors(
        self, folder: ImageFolder, describer: Extractor | Aggregated, database: ImageFolder, label: str
    ) -> Vectors:
        if isinstance(describer, Aggregated):
            return self._aggregate(folder, describer, database, label)
        state = self._extract(folder, describer, range(len(folder)), f"{label} descriptors")
        values = np.full((len(folder), describer.vector_size), np.nan, np.float32)
        for row, vector in state.sinks[0].read():
            values[row] = vector
        return Vectors(values, dict(state.bad))

    def _aggregate(self, folder: ImageFolder, describer: Aggregated, database: ImageFolder, label: str) -> Vectors:
        [features] = self.local(folder, describer.extractor, label=label)

        def fit() -> Aggregation:
            return describer.fitting.fit(*self.local(database, describer.extractor, label="database"))

        aggregation = self.once("aggregation", fit, database, describer)
        values = np.zeros((len(folder), aggregation.vector_size), np.float32)
        starts = range(0, len(folder), AGGREGATED)
        for start in self.runtime.progress(f"{label} descriptors")(starts, len(starts)):
            if images := dict(features.read(range(len(folder))[start : start + AGGREGATED])):
                values[list(images)] = aggregation(list(images.values()))
        values[list(features.bad)] = np.nan
        return Vectors(values, features.bad)
