"""What was taken from images, kept by their content: asked for again, by anybody, it is there.

    archive = Archive(Path("~/.cache/mfvpr/features").expanduser())
    [features] = archive.local(folder, Sift())
    vectors = archive.vectors(folder, MixVprDescriptor(model))

Stores are found by what they hold (the images' content and the extractor's recipe), never by a data set's name, so that
a database which several data sets share is extracted once.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Any, TypeVar

import numpy as np

from mfvpr.datasets.contents import Contents, contents, files_of, state_of
from mfvpr.datasets.datasets import ImageFolder
from mfvpr.features.extraction import described
from mfvpr.features.extractor import Aggregated, Aggregation, Extractor, Source
from mfvpr.features.feature_set import FeatureSet, FeatureSource, InMemory
from mfvpr.storage import matches as match_stores
from mfvpr.storage.feature_writers import Sink, Taken, account, open_sinks
from mfvpr.storage.manifest import MATCHES, store_path
from mfvpr.storage.rows import require_space
from mfvpr.storage.shards import Shard
from mfvpr.utils.errors import InputError
from mfvpr.utils.fingerprints import fingerprint, recipe_of
from mfvpr.utils.progress import Stopwatch, Track, untracked
from mfvpr.utils.versions import versions

DECODERS = ("mfvpr", "opencv-python-headless", "pillow")  # whose versions decide what an image becomes
AGGREGATED = 16  # images at a time
_MB = 1e6

Value = TypeVar("Value")


@dataclass(frozen=True)
class Vectors:
    """Global descriptors of all images of a folder.

    Attributes:
        values: `[M, D]` float32; NaN for bad images, which no shortlist contains.
        bad: reason by row, for images that gave no usable descriptor.
    """

    values: np.ndarray
    bad: Mapping[int, str]


@dataclass
class Archive:
    """What was taken from images, in stores below a folder, or for the time of this process.

    Attributes:
        root: folder of all stores; None = nothing is kept on disk.
        skip_bad: list images that cannot be read as bad, and go on, instead of raising.
        track: label -> progress of what follows.
        tell: is told, in one line, what is to be done and how much space that takes, and what is wrong with images.
        wait: for other processes that are making the same, instead of refusing.
        shard: takes from its own images alone, and the others' of their stores, for which it waits `patience` seconds
            before it says `mfvpr.storage.shards.NotYet`; it needs a root.
        watch: counts the extraction of local features as the stage `features`, whoever asks for them.
    """

    root: Path | None = None
    skip_bad: bool = False
    track: Callable[[str], Track] = lambda label: untracked
    tell: Callable[[str], None] = lambda line: None
    wait: bool = False
    shard: Shard | None = None
    patience: float = 0.0
    watch: Stopwatch | None = None
    _computed: dict[tuple, tuple[Any, Any]] = field(default_factory=dict, repr=False)
    _warned: set[str] = field(default_factory=set, repr=False)

    def __post_init__(self) -> None:
        self.root = None if self.root is None else Path(self.root)
        if self.shard is not None and self.root is None:
            raise InputError(f"shard={self.shard}: expected a root as well, the folder of the stores of all shards")

    def contents(self, folder: ImageFolder) -> Contents:
        """What the files of a folder hold; remembered below the root from run to run."""
        cache = None if self.root is None else self.root / "contents"
        return self.once("contents", lambda: contents(folder, cache), folder, None)

    def once(self, name: str, compute: Callable[[], Value], folder: ImageFolder, by: Any) -> Value:
        """What is computed of a folder by an extractor or a filter: once in this process, while both are what they are.

        Args:
            name: of the result.
            compute: gives it.
            folder: of images.
            by: what computes it; where that has no recipe, the object counts.
        """
        try:
            recipe = fingerprint(recipe_of(by, lambda path: [str(path), *map(state_of, files_of(path).paths)]))
        except TypeError:
            recipe = id(by)
        key = name, folder, hash(tuple(str(state_of(f"{folder.root}/{image}")) for image in folder.names)), recipe
        if key not in self._computed:
            self._computed[key] = compute(), by  # which lives as long, so that its id is no other's
        return self._computed[key][0]

    def recipe_of(self, value: Any) -> Any:
        """See `fingerprints.recipe_of`, with the content of files and folders of files in place of their paths."""
        return recipe_of(value, self._told_by_content)

    def warn(self, line: str) -> None:
        """Tell what is wrong; once, whoever finds it again (the next sequence that asks the same database)."""
        if line not in self._warned:
            self._warned.add(line)
            self.tell(f"warning: {line}")

    def recipe(self, folder: ImageFolder, extractor: Extractor | Aggregated | Source) -> dict[str, Any]:
        """All that changes what an extractor takes from a folder's images."""
        decoders = {name: versions()[name] for name in DECODERS}
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
        """Local features by scale, to be read on demand.

        Args:
            folder: the images.
            extractor: what takes them.
            rows: images whose features will be asked for; those that are not there are extracted. None = all.
            label: whose they are, for people.

        Raises:
            InputError: an image cannot be read (unless `skip_bad`), or none can; or a store cannot be used.
            NotYet: other shards have not taken theirs.
        """
        if isinstance(extractor, Source):
            opened = self.once("opened", lambda: self._opened(folder, extractor, label), folder, extractor)
            missing = np.flatnonzero(np.asarray(opened.counts) < 0).tolist()
            return (FeatureSet(opened, {row: f"{folder.paths[row]}: no features were imported" for row in missing}),)
        rows = range(len(folder)) if rows is None else [*rows]
        taken = self._extract(folder, extractor, rows, f"{label} features")
        return tuple(
            FeatureSet(InMemory(sink.items, len(folder)) if sink.store is None else sink.store, dict(taken.bad))
            for sink in taken.sinks[bool(extractor.vector_size) :]
        )

    def vectors(self, folder: ImageFolder, describer: Extractor | Aggregated, database: ImageFolder, *,
                label: str = "image") -> Vectors:  # fmt: skip
        """Global descriptors of all images.

        Args:
            folder: the images.
            describer: what describes them.
            database: images that an aggregation is fitted on.
            label: whose they are, for people.

        Raises:
            InputError: as `local`.
        """
        if not isinstance(describer, Aggregated) and not describer.vector_size:
            raise InputError(f"{type(describer).__name__}: gives no global descriptor; expected one that does, or "
                             "Aggregated(extractor, VladFitting())")  # fmt: skip
        if folder != database:
            return self._vectors(folder, describer, database, label)
        return self.once("vectors", lambda: self._vectors(folder, describer, database, label), folder, describer)

    @contextmanager
    def matches(
        self, recipe: Mapping[str, Any], names: Sequence[str], num_candidates: int, *, typical: int, label: str
    ) -> Iterator[match_stores.MatchStore]:
        """The store of matches that are made so, where there is a root, held while it lacks some.

        Args:
            recipe: of the matches.
            names: of Q queries.
            num_candidates: C.
            typical: matches of a pair, about.
            label: for people.
        """
        if self.root is None:
            raise ValueError("nothing is kept on disk: this archive has no root")
        path = store_path(self.root, "matches", recipe, MATCHES)
        sizes = {"num_queries": len(names), "num_candidates": num_candidates}
        own = range(len(names)) if self.shard is None else self.shard.rows(names)
        with match_stores.open_match_store(path, recipe, **sizes, **self.store_options) as store:
            if missing := sum(not store.done[row] for row in own):
                needed = match_stores.forecast_bytes(missing, num_candidates, typical)
                require_space(store.folder, needed)
                self.tell(f"{label}: {missing} of {len(names)} queries to match with {num_candidates} candidates: "
                          f"about {needed / _MB:.1f} MB in {store.folder}")  # fmt: skip
            else:
                self.tell(
                    f"{label}: {'all' if store.done.all() else 'its part of'} {len(names)} queries from {store.folder}"
                )
            yield store

    @property
    def store_options(self) -> dict[str, Any]:
        """Of `stores.rows.open_rows`."""
        return {"waiting": self.tell if self.wait else None, "shard": self.shard}

    def _told_by_content(self, path: PurePath) -> Any:
        path = Path(path)
        if not path.exists():
            return str(path)
        found = self.contents(files_of(path))
        return found.fingerprint if path.is_dir() else found.sha256

    def _opened(self, folder: ImageFolder, source: Source, label: str) -> FeatureSource:
        opened = source.opened(folder, partial=self.skip_bad)
        counts = np.asarray(opened.counts)
        number, typical = int((counts >= 0).sum()), np.mean(counts[counts >= 0]) if (counts >= 0).any() else 0
        self.tell(f"{label} features: {number} of {len(folder)} images imported, about {typical:.0f} features each")
        return opened

    def _extract(self, folder: ImageFolder, extractor: Extractor, rows: Sequence[int], label: str) -> Taken:
        """Run the extractor on those of the rows that lack something."""
        taken = self.once("taken", lambda: Taken(self._sinks(folder, extractor)), folder, extractor)
        with ExitStack() as held:
            if self.watch is not None and extractor.scales:
                held.enter_context(self.watch("features"))
            if any(sink.lacks(rows) for sink in taken.sinks):
                for sink in taken.sinks:
                    if sink.store is not None:
                        held.enter_context(sink.store)
            taken.know_bad()
            own = rows if self.shard is None else self.shard.rows(folder.names, rows)
            missing = taken.lacks(own)
            self._announce(extractor, taken, missing, len(rows), len(folder), label)
            batches = described(folder, extractor, missing, taken.bad, skip_bad=self.skip_bad, track=self.track(label))
            for batch in batches:
                for sink in taken.sinks:
                    sink.keep({row: sink.pick(description) for row, description in batch.items()})
            if missing:
                taken.leave_bad()
                for line in account(taken.sinks[bool(extractor.vector_size) :], extractor.scales):
                    self.tell(f"{label}: {line}")
        if self.shard is not None:
            self.shard.wait(lambda: taken.look(rows), folder.names, label, patience=self.patience)
        if len(taken.bad) == len(folder):
            raise InputError(f"{folder.root}: none of {len(folder)} images can be used; the first: "
                             f"{taken.bad[min(taken.bad)]}")  # fmt: skip
        return taken

    def _sinks(self, folder: ImageFolder, extractor: Extractor) -> list[Sink]:
        recipe = self.recipe(folder, extractor) if self.root is not None else {}
        return open_sinks(self.root, extractor, recipe, num_images=len(folder), **self.store_options)

    def _announce(
        self, extractor: Extractor, taken: Taken, missing: Sequence[int], asked: int, total: int, label: str
    ) -> None:
        """What is to be done; that nothing is, only once."""
        stores = [sink.store for sink in taken.sinks if sink.store is not None]
        if not stores or not asked or (taken.announced and not missing):
            return
        where, taken.announced = ", ".join(str(store.folder) for store in stores), True
        if not missing:
            some = f"all {total}" if asked == total else f"the {asked} of {total}"
            self.tell(f"{label}: {some} images from {where}")
            return
        needed = sum(sink.forecast(len(missing)) for sink in taken.sinks)
        require_space(stores[0].folder, needed)
        each = ", ".join(f"about {scale.typical_count} features of {scale.dimension} dimensions each"
                         for scale in extractor.scales)  # fmt: skip
        each = each or f"descriptors of {extractor.vector_size} numbers"
        self.tell(f"{label}: {len(missing)} of {total} images to do, {each}: about {needed / _MB:.1f} MB in {where}")

    def _vectors(
        self, folder: ImageFolder, describer: Extractor | Aggregated, database: ImageFolder, label: str
    ) -> Vectors:
        if isinstance(describer, Aggregated):
            return self._aggregated(folder, describer, database, label)
        taken = self._extract(folder, describer, range(len(folder)), f"{label} descriptors")
        values, sink = np.full((len(folder), describer.vector_size), np.nan, np.float32), taken.sinks[0]
        for row, vector in sink.items.items() if sink.store is None else sink.store.read():
            values[row] = vector
        return Vectors(values, dict(taken.bad))

    def _aggregated(self, folder: ImageFolder, describer: Aggregated, database: ImageFolder, label: str) -> Vectors:
        [features] = self.local(folder, describer.extractor, label=label)
        aggregation = self.once("fitted", lambda: self._fitted(describer, database), database, describer)
        values = np.zeros((len(folder), aggregation.vector_size), np.float32)
        rows = range(len(folder))
        for start in self.track(f"{label} descriptors")(range(0, len(rows), AGGREGATED), -(-len(rows) // AGGREGATED)):
            images = dict(features.read(rows[start : start + AGGREGATED]))
            if images:
                values[list(images)] = aggregation(list(images.values()))
        values[list(features.bad)] = np.nan
        return Vectors(values, features.bad)

    def _fitted(self, describer: Aggregated, database: ImageFolder) -> Aggregation:
        [features] = self.local(database, describer.extractor, label="database")
        return describer.fitting.fit(features)
