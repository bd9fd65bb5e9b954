"""Writers of an extractor's features: each part of a description to a store, or to memory."""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mfvpr.features.extractor import Description, Extractor, Scale
from mfvpr.storage import features, vectors
from mfvpr.storage.disk import disk_errors_as_input_errors
from mfvpr.storage.manifest import VECTORS, store_path
from mfvpr.storage.rows import SHARDS, RowStore
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import write_text

_BAD = "bad.json"  # images that gave a shard nothing, with reasons, so that other shards do not wait for them
_MB = 1e6


@dataclass
class Sink:
    """One part of the descriptions of a folder's images, in a store or in memory.

    Attributes:
        pick: the part of a description.
        store: None = in memory.
        items: by row, without a store.
        forecast: number of images -> bytes on disk.
    """

    pick: Callable[[Description], Any]
    store: RowStore[Any] | None
    forecast: Callable[[int], int]
    items: dict[int, Any] = field(default_factory=dict)

    def missing(self, rows: Iterable[int]) -> list[int]:
        """The rows that are not here."""
        return [row for row in rows if (row not in self.items if self.store is None else not self.store.done[row])]

    def write(self, batch: Mapping[int, Description]) -> None:
        """Write the missing rows of a batch; with a store, they are on disk when this returns."""
        parts = {row: self.pick(batch[row]) for row in self.missing(batch)}
        if self.store is None:
            self.items |= parts
        else:
            self.store.write(parts)

    def read(self) -> Iterable[tuple[int, Any]]:
        """(row, part) of all rows that are here."""
        return self.items.items() if self.store is None else self.store.read()


@dataclass
class ExtractionState:
    """The state of one extractor on one folder of images.

    Attributes:
        sinks: of the parts of its descriptions.
        of_scales: the sinks of local features.
        bad: row -> reason, for images without features.
        is_announced: whether the user was told where the features are.
    """

    sinks: list[Sink]
    of_scales: list[Sink]
    bad: dict[int, str] = field(default_factory=dict)
    is_announced: bool = False

    def missing(self, rows: Sequence[int]) -> list[int]:
        """The rows that a sink lacks, without bad ones."""
        return sorted({row for sink in self.sinks for row in sink.missing(rows)} - self.bad.keys())

    def look(self, rows: Sequence[int]) -> list[int]:
        """The rows that no shard has extracted by now."""
        for sink in self.sinks if self.missing(rows) else ():
            if sink.store is not None:
                sink.store.look()
        return self.missing(rows)

    def read_bad(self) -> None:
        """Add the bad images of all shards, which stay bad: all runs evaluate the same images."""
        store = self.sinks[0].store
        if store is None:
            return
        with disk_errors_as_input_errors(store.folder, store.kind.content):
            for path in sorted((store.folder / SHARDS).glob(f"*-of-*/{_BAD}")):
                try:
                    self.bad |= {int(row): str(reason) for row, reason in json.loads(path.read_text("utf-8")).items()}
                except (ValueError, AttributeError):
                    raise InputError(f"{path}: expected reasons by row, got something else; delete this file, and run "
                                     "again") from None  # fmt: skip

    def write_bad(self) -> None:
        """Leave the bad images for other shards."""
        store = self.sinks[0].store
        if store is not None and store.shard is not None and self.bad:
            with disk_errors_as_input_errors(store.folder, store.kind.content):
                write_text(store.write_folder / _BAD, json.dumps(dict(sorted(self.bad.items()))))


def open_sinks(
    root: Path | None, extractor: Extractor, recipe: Mapping[str, Any], *, num_images: int, **options: Any
) -> list[Sink]:
    """Open the sinks of an extractor: of its global descriptor, if it gives one, then of each scale.

    Without a root, the sinks are in memory. `options` are `waiting` and `shard` of `storage.rows.RowStore`.
    """
    name, size = type(extractor).__name__, extractor.vector_size
    options["num_images"] = num_images
    sinks = []
    if size:
        path = None if root is None else store_path(root, name, recipe, VECTORS)
        store = None if path is None else vectors.open_vector_store(path, recipe, **options)
        sinks.append(Sink(lambda description: description.vector, store, lambda n: vectors.forecast_bytes(n, size)))
    for number, scale in enumerate(extractor.scales):
        of_scale = {**recipe, "scale": number} if len(extractor.scales) > 1 else recipe
        store = None if root is None else features.open_store(store_path(root, name, of_scale), of_scale, **options)
        sinks.append(Sink(
            lambda description, number=number: description.local[number], store,
            lambda n, scale=scale: features.forecast_bytes(n, scale.typical_count, scale.dimension),
        ))  # fmt: skip
    return sinks


def size_lines(sinks: Sequence[Sink], scales: Sequence[Scale]) -> Iterator[str]:
    """One line per scale: size of the local features on disk, and as float32, as the paper stores them."""
    for scale, sink in zip(scales, sinks, strict=True):
        if sink.store is not None:
            size, features = sink.store.size_bytes, int(sink.store.counts.clip(0).sum())
            images, paper = max(int(sink.store.done.sum()), 1), max(features, 1) * (4 * scale.dimension + 16)
            yield (f"{size / _MB:.1f} MB, {size / images / _MB:.2f} MB and {features / images:.0f} features an image; "
                   f"as the paper stores them, in float32, {paper / _MB:.1f} MB: {size / paper:.2f}x")  # fmt: skip
