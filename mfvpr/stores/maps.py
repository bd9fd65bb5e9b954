"""The rows of a map on disk: of every image its features, and behind them its descriptor, its name and its place.

    rows = MapRows(folder, recipe)
    with rows.adding():
        rows.add([(features, Entry(name, place, vector)), ...])
    for row, entry in rows.new():  # since the last time, whoever added them
        ...

One process adds at a time, any number read. A row is there when its second part is, which is written last, so nobody
sees half of one. Rows lie in segments of `SEGMENT`, each of two row stores (`mfvpr.stores.rows`), so that no folder
holds too many files; a process that is killed leaves out a number at most.
"""

import json
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mfvpr.data.files import clipped
from mfvpr.errors import InputError
from mfvpr.stores.features import FeatureStore, open_store
from mfvpr.stores.manifest import Kind
from mfvpr.stores.rows import RowStore, open_rows
from mfvpr.types import Features

SEGMENT = 4096  # rows
DEEPEST = 50  # levels of a place: Python's JSON reads fewer levels, the more functions are called already
MAP = Kind("map", 1, "places", "images", "adds", compress=False)
_TICK = 3.0  # seconds, at most, of the clocks by which file systems tell when a folder has changed


class Entry(NamedTuple):
    """What a map knows of an image beside its features.

    name: of the image.
    place: where it was taken: any JSON value.
    vector: `[D]` global descriptor, float32.
    """

    name: str
    place: Any
    vector: np.ndarray


def check_place(name: str, place: Any) -> None:
    """Refuse a place that is None, or that JSON would not give back as it is: a tuple comes back as a list."""
    try:
        text = json.dumps(place, allow_nan=False)
        if place is None or json.loads(text) != place:
            raise ValueError(f"{clipped(repr(place), 80)}, which JSON gives back as {clipped(text, 80)}")
        if _levels(place) > DEEPEST:
            raise RecursionError
    except RecursionError:
        raise InputError(
            f"{name}: expected a place of at most {DEEPEST} levels, got a deeper one; flatten it"
        ) from None
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: expected a place that JSON can say, and not null, got {error}; use text, numbers, "
                         "lists, and dictionaries by text") from None  # fmt: skip


def _levels(place: Any) -> int:
    """Number of lists and dictionaries within each other."""
    parts = place.values() if isinstance(place, dict) else place if isinstance(place, list) else None
    return 0 if parts is None else 1 + max(map(_levels, parts), default=0)


@dataclass
class _Segment:
    """Both stores of some rows, as they were when they were opened.

    Attributes:
        features: and
        entries: the stores.
        changed: when the folder of entries had changed by then, ns, by the file system's own clock; None = no folder.
        seen: when that time was first seen, and
        opened: when they were opened, seconds of a clock of this process.
        is_held: rows may be added.
    """

    features: FeatureStore
    entries: RowStore[Entry]
    changed: int | None
    seen: float
    opened: float
    is_held: bool = False

    @property
    def taken(self) -> np.ndarray:
        """`[SEGMENT]` bool, rows that are there, or were begun."""
        return self.features.done | self.entries.done

    @property
    def is_current(self) -> bool:
        """Whether nothing can have been added since; what changes within the same tick of a clock has the same time."""
        same = self.changed is not None and self.changed == _changed(self.entries.folder)
        return self.is_held or (same and self.opened - self.seen > _TICK)


@dataclass(eq=False)
class MapRows:
    """The rows of the map in a folder, which need not be there before the first is added.

    Attributes:
        folder: of the map.
        recipe: what its rows are made with (JSON values): another is refused.
    """

    folder: Path
    recipe: Mapping[str, Any]
    _segments: list[_Segment] = field(default_factory=list, repr=False)
    _known: list[np.ndarray] = field(default_factory=list, repr=False)  # by segment, the rows that `new` gave
    _held: ExitStack | None = field(default=None, repr=False)

    def new(self) -> Iterator[tuple[int, Entry]]:
        """(row, entry) of all rows that were not given before, in their order.

        Raises:
            InputError: they were made with something else, or are damaged.
        """
        number = next((number for number, known in enumerate(self._known) if not known.all()), len(self._known))
        while self._open(number):
            entries, known = self._segments[number].entries, self._known[number]
            rows = np.flatnonzero(entries.done & ~known).tolist()
            for row, entry in entries.read(rows):
                known[row] = True
                yield number * SEGMENT + row, entry
            if not self._segments[number].taken[-1]:
                break
            number += 1

    def counts(self, rows: Iterable[int]) -> np.ndarray:
        """`[n]` keypoints of rows that are there."""
        places = (divmod(row, SEGMENT) for row in rows)
        return np.array([self._segments[segment].features.counts[row] for segment, row in places], int)

    def features(self, rows: Sequence[int]) -> Iterator[tuple[int, Features]]:
        """(row, features) of rows that are there, in no order.

        Raises:
            InputError: they are damaged, or were and are gone.
        """
        segments: dict[int, list[int]] = {}
        for row in rows:
            segments.setdefault(row // SEGMENT, []).append(row % SEGMENT)
        for number, own in segments.items():
            if gone := [row for row in own if self._segments[number].features.counts[row] < 0]:
                raise InputError(f"{self.folder}: the features of row {number * SEGMENT + gone[0]} were damaged, and "
                                 "are gone; make the map anew")  # fmt: skip
            for row, features in self._segments[number].features.read(own):
                yield number * SEGMENT + row, features

    @contextmanager
    def adding(self) -> Iterator[None]:
        """Hold the map, so that nobody else adds to it.

        Raises:
            InputError: another process does, the map is of something else, or its folder cannot be written.
        """
        if self._held is not None:
            yield
            return
        with ExitStack() as held:
            self._held = held
            try:
                self._hold_last()
                yield
            finally:
                self._held = None
                for segment in self._segments:
                    segment.is_held = False

    def add(self, items: Sequence[tuple[Features, Entry]]) -> list[int]:
        """Rows of images that are now on disk; within `adding`.

        Raises:
            InputError: the disk is full, or cannot be written. Rows from before stay.
        """
        rows: list[int] = []
        while len(rows) < len(items):
            number, free = self._hold_last()
            some = items[len(rows) : len(rows) + SEGMENT - free]
            own = range(free, free + len(some))
            segment = self._segments[number]
            segment.features.write({row: features for row, (features, _) in zip(own, some, strict=True)})
            segment.entries.write({row: entry for row, (_, entry) in zip(own, some, strict=True)})
            rows += [number * SEGMENT + row for row in own]
        return rows

    def _hold_last(self) -> tuple[int, int]:
        """The last segment, held, and its first free row."""
        if self._held is None:
            raise ValueError(f"{self.folder}: rows are added within `adding`")
        number = max(0, len(self._segments) - 1)
        while True:
            segment = self._opened(number)
            if not segment.is_held and not segment.taken[-1]:
                for store in (segment.features, segment.entries):
                    self._held.enter_context(store)  # which looks again at what is there
                segment.is_held = True
            if not segment.taken[-1]:
                return number, int(np.max(np.flatnonzero(segment.taken), initial=-1)) + 1
            number += 1

    def _open(self, number: int) -> bool:
        """Have a segment as it is on disk; False where there is none."""
        if number < len(self._segments) and self._segments[number].is_current:
            return True
        there = (self.folder / f"{number:04d}").is_dir()
        if there:
            self._opened(number)
        return there

    def _opened(self, number: int) -> _Segment:
        """A segment as it is on disk."""
        before = self._segments[number] if number < len(self._segments) else None
        if before is not None and before.is_held:
            return before
        folder, now = self.folder / f"{number:04d}", time.monotonic()
        changed = _changed(folder / "entries")
        seen = before.seen if before is not None and before.changed == changed else now
        sizes = {"num_images": SEGMENT}
        # Entries first: what is added in between then has features, as these are written before.
        entries = open_rows(folder / "entries", MAP, self.recipe, sizes, pack=_pack, unpack=_unpack)
        features = open_store(folder / "features", self.recipe, num_images=SEGMENT)
        segment = _Segment(features, entries, changed, seen, now)
        if before is None:
            self._segments.append(segment)
            self._known.append(np.zeros(SEGMENT, bool))
        else:
            self._segments[number] = segment
        return segment


def _changed(folder: Path) -> int | None:
    try:
        return folder.stat().st_mtime_ns
    except FileNotFoundError:
        return None


def _pack(entry: Entry) -> dict[str, np.ndarray]:
    text = json.dumps([entry.name, entry.place], allow_nan=False)
    return {"vector": np.asarray(entry.vector, np.float32), "text": np.frombuffer(text.encode("ascii"), np.uint8)}


def _unpack(parts: Mapping[str, np.ndarray]) -> Entry:
    name, place = json.loads(parts["text"].tobytes().decode("ascii"))
    return Entry(name, place, parts["vector"])
