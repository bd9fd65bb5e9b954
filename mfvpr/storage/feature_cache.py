"""A cache of the features and global descriptors of images, on disk or in memory.

    cache = FeatureCache(Path("~/.cache/mfvpr/features").expanduser())
    [features] = cache.local(folder, Sift())
    vectors = cache.vectors(folder, MixVprDescriptor(model))

The content of an image and the recipe of the extractor name its features, not the folder or the data set: an image that
several data sets or maps share is extracted once.
"""

from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from mfvpr.datasets.datasets import ImageFolder
from mfvpr.features.extractor import Aggregated, Aggregation, Extractor, Source
from mfvpr.features.feature_set import FeatureSet, FeatureSource
from mfvpr.storage.disk import lock_store
from mfvpr.storage.extraction import Extraction, describe_rows, open_sinks
from mfvpr.storage.manifest import LOCKS
from mfvpr.storage.recipes import Memo, Recipes, Value, states
from mfvpr.utils.errors import InputError
from mfvpr.utils.progress import Stopwatch
from mfvpr.utils.runtime import DEFAULT_RUNTIME, Runtime

AGGREGATED = 16  # images at a time


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
        wait: wait for another process that does the same work, instead of raising.
        runtime: progress and messages; `mfvpr.evaluate(runtime=)` replaces it.
        watch: counts the extraction of local features as the stage `features`.
    """

    root: Path | None = None
    skip_bad: bool = False
    wait: bool = False
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
        """
        if isinstance(extractor, Source):
            source = self.once("opened", lambda: self._open_source(folder, extractor, label), folder, extractor)
            missing = np.flatnonzero(np.asarray(source.counts) < 0).tolist()
            return (FeatureSet(source, {row: f"{folder.paths[row]}: no features were imported" for row in missing}),)
        state = self.describe(folder, extractor, rows, label=f"{label} features")
        _require_images(folder, state.bad)
        return tuple(FeatureSet(sink.source, dict(state.bad)) for sink in state.of_scales)

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

    def describe(
        self, folder: ImageFolder, extractor: Extractor, rows: Iterable[int] | None = None, *, label: str = "image"
    ) -> Extraction:
        """Run the extractor on all images, or on those in `rows`, that are missing; `label` stands in messages."""
        requested = range(len(folder)) if rows is None else [*rows]
        state = self.once("extraction", lambda: self._open(folder, extractor), folder, extractor)
        with ExitStack() as stack:
            if self.watch is not None and extractor.scales:
                stack.enter_context(self.watch("features"))
            if state.missing(requested):
                for store in state.stores:
                    stack.enter_context(store)  # finds the rows that were written meanwhile
            missing = state.missing(requested)
            for line in state.announcement(missing, len(requested)):
                self.log(f"{label}: {line}")
            shared = folder, state if self.runtime.cluster is None else state.without_programs(), self.skip_bad
            blocks = self.runtime.map(describe_rows, shared, missing, label, extractor.batch_size) if missing else ()
            for block, counts, bad in blocks:
                state.bad |= bad
                for store, numbers in zip(state.stores, counts, strict=True):
                    store.counts[block] = numbers
            for line in state.size_lines() if missing else ():
                self.log(f"{label}: {line}")
        return state

    def lock(self, part: str | None, folder: Path, content: str) -> AbstractContextManager[None]:
        """The lock of a part of a store, or of all of it; it waits for another process, or refuses."""
        folder = folder if part is None else folder / LOCKS / part
        folder.mkdir(parents=True, exist_ok=True)
        return lock_store(folder, content, self.log if self.wait else None)

    def _open_source(self, folder: ImageFolder, source: Source, label: str) -> FeatureSource:
        opened = source.open(folder, partial=self.skip_bad)
        counts = np.asarray(opened.counts)
        number, typical = int((counts >= 0).sum()), np.mean(counts[counts >= 0]) if (counts >= 0).any() else 0
        self.log(f"{label} features: {number} of {len(folder)} images imported, about {typical:.0f} features each")
        return opened

    def _open(self, folder: ImageFolder, extractor: Extractor) -> Extraction:
        before = states(folder)
        if self.root is not None:
            contents, recipe = self.recipes.contents(folder), self.recipes.of_features(extractor)
            lock = partial(self.lock, contents.fingerprint)
            return Extraction(extractor, open_sinks(self.root, extractor, recipe, contents.keys, lock=lock), before)
        sinks = open_sinks(None, extractor, {}, before)
        memory = self._memo.once("memory", lambda: [sink.items for sink in sinks], None, extractor)
        for sink, items in zip(sinks, memory, strict=True):
            sink.items = items
        return Extraction(extractor, sinks, before)

    def _vectors(
        self, folder: ImageFolder, describer: Extractor | Aggregated, database: ImageFolder, label: str
    ) -> Vectors:
        if isinstance(describer, Aggregated):
            return self._aggregate(folder, describer, database, label)
        state = self.describe(folder, describer, label=f"{label} descriptors")
        _require_images(folder, state.bad)
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


def _require_images(folder: ImageFolder, bad: Mapping[int, str]) -> None:
    if len(bad) == len(folder):
        raise InputError(f"{folder.root}: none of {len(folder)} images can be used; the first: {bad[min(bad)]}")
