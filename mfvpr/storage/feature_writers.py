"""Where what an extractor gives is kept: a store, or the memory of this process, for each part of a description."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mfvpr.features.extractor import Extractor, Scale
from mfvpr.storage import features, vectors
from mfvpr.storage.bad import known_bad, leave_bad
from mfvpr.storage.manifest import VECTORS, store_path
from mfvpr.storage.rows import RowStore

_MB = 1e6


@dataclass
class Sink:
    """Where one part of the descriptions of a folder's images is kept: in a store, or in memory.

    Attributes:
        pick: the part of a description.
        store: None = in memory.
        items: by row, where there is no store.
        forecast: bytes on disk of so many images.
    """

    pick: Callable[[Any], Any]
    store: RowStore[Any] | None
    forecast: Callable[[int], int]
    items: dict[int, Any] = field(default_factory=dict)

    def lacks(self, rows: Sequence[int]) -> list[int]:
        """Those of some rows that are not here."""
        if self.store is None:
            return [row for row in rows if row not in self.items]
        return [row for row in rows if not self.store.done[row]]

    def keep(self, batch: Mapping[int, Any]) -> None:
        """A batch of rows; where there is a store, they are on disk when this returns."""
        if self.store is None:
            self.items |= batch
        else:
            self.store.write({row: batch[row] for row in self.lacks([*batch])})


@dataclass
class Taken:
    """What an extractor takes from a folder's images.

    Attributes:
        sinks: where that is kept.
        bad: why some gave nothing, by row.
        announced: whether people know.
    """

    sinks: list[Sink]
    bad: dict[int, str] = field(default_factory=dict)
    announced: bool = False

    def lacks(self, rows: Sequence[int]) -> list[int]:
        """Those of some rows that are not here, though they are not bad."""
        return sorted({row for sink in self.sinks for row in sink.lacks(rows)} - self.bad.keys())

    def look(self, rows: Sequence[int]) -> list[int]:
        """Those of some rows that no shard has taken by now."""
        for sink in self.sinks if self.lacks(rows) else ():
            if sink.store is not None:
                sink.store.look()
        self.know_bad()
        return self.lacks(rows)

    def know_bad(self) -> None:
        """What shards said is bad stays so, or each would have its own data set."""
        store = self.sinks[0].store
        if store is not None and store.shard is not None:
            self.bad |= known_bad(store)

    def leave_bad(self) -> None:
        """Tell other shards which images are."""
        store = self.sinks[0].store
        if store is not None and store.shard is not None and self.bad:
            leave_bad(store, self.bad)


def open_sinks(
    root: Path | None,
    extractor: Extractor,
    recipe: Mapping[str, Any],
    *,
    num_images: int,
    **how: Any,
) -> list[Sink]:
    """Those of an extractor: of its global descriptor, where it gives one, then of every scale.

    Args:
        root: folder of stores; None = in memory.
        extractor: whose.
        recipe: of what it takes from these images.
        num_images: M.
        **how: `waiting` and `shard` of `stores.rows.open_rows`.
    """
    name, size = type(extractor).__name__, extractor.vector_size
    options: dict[str, Any] = {"num_images": num_images} | how
    sinks = []
    if size:
        path = None if root is None else store_path(root, name, recipe, VECTORS)
        store = None if path is None else vectors.open_vector_store(path, recipe, **options)
        sinks.append(Sink(lambda description: description.vector, store, lambda n: vectors.forecast_bytes(n, size)))
    for number, scale in enumerate(extractor.scales):
        own = {**recipe, "scale": number} if len(extractor.scales) > 1 else recipe
        store = None if root is None else features.open_store(store_path(root, name, own), own, **options)
        sinks.append(Sink(
            lambda description, number=number: description.local[number], store,
            lambda n, scale=scale: features.forecast_bytes(n, scale.typical_count, scale.dimension),
        ))  # fmt: skip
    return sinks


def account(sinks: Sequence[Sink], scales: Sequence[Scale]) -> Iterator[str]:
    """What the local features of each scale take on disk, beside what they would as the paper keeps them."""
    for scale, sink in zip(scales, sinks, strict=True):
        if sink.store is not None:
            size, features = sink.store.size_bytes, int(sink.store.counts.clip(0).sum())
            images, paper = max(int(sink.store.done.sum()), 1), max(features, 1) * (4 * scale.dimension + 16)
            yield (f"{size / _MB:.1f} MB, {size / images / _MB:.2f} MB and {features / images:.0f} features an image; "
                   f"as the paper stores them, in float32, {paper / _MB:.1f} MB: {size / paper:.2f}x")  # fmt: skip
