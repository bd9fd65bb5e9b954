"""The extraction of a folder's images: each part of a description goes to a store, or to memory."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from mfvpr.datasets.datasets import ImageFolder
from mfvpr.features.extractor import Description, Extractor
from mfvpr.features.feature_extraction import describe_folder
from mfvpr.features.feature_set import FeatureSource, InMemory
from mfvpr.storage import features
from mfvpr.storage.manifest import VECTORS, store_path
from mfvpr.storage.recipes import states
from mfvpr.storage.rows import RowStore, require_space
from mfvpr.utils.errors import InputError
from mfvpr.utils.progress import Track, no_progress

_MB = 1e6


@dataclass
class Sink:
    """One part of the descriptions of a folder's images, in a store or, by key, in `items` in memory."""

    pick: Callable[[Description], Any]
    store: RowStore[Any] | None
    keys: Sequence[str]
    forecast: Callable[[int], int]  # number of images -> bytes on disk
    items: dict[str, Any] = field(default_factory=dict)

    def missing(self, rows: Iterable[int]) -> list[int]:
        """The rows that are not here."""
        return [row for row in rows
                if (self.keys[row] not in self.items if self.store is None else not self.store.done[row])]  # fmt: skip

    def write(self, batch: Mapping[int, Description]) -> None:
        """Write the missing rows of a batch; with a store, they are on disk when this returns."""
        parts = {row: self.pick(batch[row]) for row in self.missing(batch)}
        if self.store is None:
            self.items |= {self.keys[row]: part for row, part in parts.items()}
        else:
            self.store.write(parts)

    def read(self) -> Iterable[tuple[int, Any]]:
        """(row, part) of all rows that are here."""
        return self._in_memory.items() if self.store is None else self.store.read()

    @property
    def source(self) -> FeatureSource:
        """Local features of all rows that are here, to be read on demand."""
        return self.store or InMemory(self._in_memory, len(self.keys))

    @property
    def _in_memory(self) -> dict[int, Any]:
        return {row: self.items[key] for row, key in enumerate(self.keys) if key in self.items}


@dataclass
class Extraction:
    """The state of one extractor on one folder of images."""

    extractor: Extractor
    sinks: list[Sink]  # of the global descriptor, if the extractor gives one, and of each scale
    states: Sequence[str] | None  # of the images before they were hashed; None = in a worker with files of its own
    bad: dict[int, str] = field(default_factory=dict)  # row -> reason
    is_announced: bool = False  # where the features are

    @property
    def of_scales(self) -> list[Sink]:
        """The sinks of local features."""
        return self.sinks[bool(self.extractor.vector_size) :]

    @property
    def stores(self) -> list[RowStore[Any]]:
        """The stores of the sinks; none in memory."""
        return [sink.store for sink in self.sinks if sink.store is not None]

    def missing(self, rows: Sequence[int]) -> list[int]:
        """The rows that a sink lacks, without bad ones."""
        return sorted({row for sink in self.sinks for row in sink.missing(rows)} - self.bad.keys())

    def without_programs(self) -> "Extraction":
        """A copy that can be sent to workers: its extractor has compiled nothing."""
        extractor: Any = self.extractor
        extractor = replace(extractor) if hasattr(extractor, "__dataclass_fields__") else extractor
        return replace(self, extractor=extractor, states=None)

    def announcement(self, missing: Sequence[int], requested: int) -> Iterator[str]:
        """A line: how many of the `requested` images are missing; if none, only once. Requires space on the disk."""
        if not self.stores or not requested or (self.is_announced and not missing):
            return
        where, self.is_announced = ", ".join(str(store.folder) for store in self.stores), True
        total = len(self.sinks[0].keys)
        if not missing:
            number = f"all {total}" if requested == total else f"the {requested} of {total}"
            yield f"{number} images from {where}"
            return
        needed = sum(sink.forecast(len(missing)) for sink in self.sinks)
        require_space(self.stores[0].folder, needed)
        scales = [f"about {scale.typical_count} features of {scale.dimension} dimensions each"
                  for scale in self.extractor.scales]  # fmt: skip
        each = ", ".join(scales) or f"descriptors of {self.extractor.vector_size} numbers"
        yield f"{len(missing)} of {total} images to do, {each}: about {needed / _MB:.1f} MB in {where}"

    def size_lines(self) -> Iterator[str]:
        """One line per scale: size of the local features on disk, and as float32, as the paper stores them."""
        for scale, sink in zip(self.extractor.scales, self.of_scales, strict=True):
            if sink.store is not None:
                size, features = sink.store.size_bytes, int(sink.store.counts.clip(0).sum())
                images, paper = max(int(sink.store.done.sum()), 1), max(features, 1) * (4 * scale.dimension + 16)
                yield (f"{size / _MB:.1f} MB, {size / images / _MB:.2f} MB and {features / images:.0f} features an "
                       f"image; as the paper stores them, in float32, {paper / _MB:.1f} MB: "
                       f"{size / paper:.2f}x")  # fmt: skip


def describe_rows(
    folder: ImageFolder, state: Extraction, skip_bad: bool, rows: Sequence[int], track: Track = no_progress
) -> tuple[Sequence[int], list[np.ndarray], dict[int, str]]:
    """Write the descriptions of images; returns the rows, the numbers of features by store, and the bad rows."""
    missing = state.missing(rows)
    before = state.states or dict(zip(missing, states(folder, missing), strict=True))
    for batch in describe_folder(folder, state.extractor, missing, state.bad, skip_bad=skip_bad, track=track):
        for row, now in zip(batch, states(folder, batch), strict=True):
            if now != before[row]:
                raise InputError(f"{folder.paths[row]}: changed while it was described; run again when it is complete")
        for sink in state.sinks:
            sink.write(batch)
    bad = {row: state.bad[row] for row in rows if row in state.bad}
    return rows, [store.counts[rows] for store in state.stores], bad


def open_sinks(
    root: Path | None, extractor: Extractor, recipe: Mapping[str, Any], keys: Sequence[str], **options: Any
) -> list[Sink]:
    """Open the sinks of an extractor, without a root in memory; `options` are the `lock` of a `RowStore`."""
    name, size = type(extractor).__name__, extractor.vector_size
    options |= {"num_images": len(keys), "keys": keys}
    sinks = []
    if size:
        path = None if root is None else store_path(root, name, recipe, VECTORS)
        store = None if path is None else features.open_vector_store(path, recipe, **options)
        sinks.append(Sink(attrgetter("vector"), store, keys, partial(features.forecast_vector_bytes, size=size)))
    for number, scale in enumerate(extractor.scales):
        of_scale = {**recipe, "scale": number} if len(extractor.scales) > 1 else recipe
        store = None if root is None else features.open_store(store_path(root, name, of_scale), of_scale, **options)
        forecast = partial(features.forecast_bytes, features_per_image=scale.typical_count, dimension=scale.dimension)
        sinks.append(Sink(lambda description, number=number: description.local[number], store, keys, forecast))
    return sinks
