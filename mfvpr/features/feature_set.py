"""Features on demand: where the local features of many images come from, and the few that lie on a device just now.

A data set's features need not fit into memory. They stay where they are (a store, a file of another program, a list),
known by their counts; rows are read when somebody matches them, and kept on the device until others need the room.
"""

import itertools
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from mfvpr.types import Features, per_keypoint
from mfvpr.utils import ragged
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import Device, compiled, free_bytes, round_up

SHARE = 1 / 3  # of the free memory, where nobody says how much
STEP = 32  # capacities are multiples of it
WRITTEN = 16  # rows that go to the device at a time: one program
KEPT, STAGED = 3 / 5, 1 / 24  # of the budget: for rows that stay, and for each of the parts on their way, up to six


class FeatureSource(Protocol):
    """Local features of M images, in rows."""

    @property
    def counts(self) -> np.ndarray:
        """`[M]` int keypoints of each image; below 0 = there are none to be read."""
        ...

    def read(self, rows: Iterable[int] | None = None) -> Iterator[tuple[int, Features]]:
        """(row, Features `[n, ...]`, NumPy, without padding) of the rows asked for, in their order; by default all."""
        ...


class InMemory:
    """A source of features that are in memory, `[n, ...]` each, without padding."""

    def __init__(self, images: Mapping[int, Features], total: int) -> None:
        """Of `total` images; rows that are not among `images` have none to be read."""
        self._images = images
        self.counts = np.array([len(images[row].mask) if row in images else -1 for row in range(total)], int)

    def read(self, rows: Iterable[int] | None = None) -> Iterator[tuple[int, Features]]:
        """See `FeatureSource`."""
        return ((row, self._images[row]) for row in (sorted(self._images) if rows is None else rows))


@dataclass(frozen=True)
class FeatureSet:
    """Local features of all images of a folder, of one scale.

    Attributes:
        source: where they are.
        bad: reason by row, for images that are not used: they gave no usable features, or no usable global descriptor.
    """

    source: FeatureSource
    bad: Mapping[int, str]

    @classmethod
    def of(cls, images: Sequence[Features], *, unit_length: bool = True) -> "FeatureSet":
        """Features of your own, image by image `[N_i, ...]`, of as many keypoints as each has; padding is dropped.

        Args:
            images: at least one.
            unit_length: whether descriptors must be of unit length, as for the weight 2 - distance; what is matched is
                the largest dot product, of whatever length.

        Raises:
            InputError: there are none, their arrays do not fit, or descriptors are not of unit length.
        """
        if not images:
            raise InputError("FeatureSet.of: expected the features of at least one image, got none")
        for number, image in enumerate(images):
            check_features(image, f"features of image {number}", unit_length=unit_length)
            if (dimension := image.descriptors.shape[1]) != (expected := images[0].descriptors.shape[1]):
                raise InputError(
                    f"features of image {number}: expected descriptors of {expected} dimensions, as those of image 0, "
                    f"got {dimension}; extract all images alike"
                )
        return cls(InMemory(dict(enumerate(map(without_padding, images))), len(images)), {})

    @property
    def counts(self) -> np.ndarray:
        """`[M]` int keypoints of each image, 0 where there are none to be read."""
        return np.maximum(self.source.counts, 0)

    def __len__(self) -> int:
        return len(self.source.counts)

    def __getitem__(self, row: int) -> Features:
        """Features `[n, ...]` of one image that is not bad, NumPy, without padding."""
        [(_, features)] = self.source.read([row])
        return features

    @cached_property
    def _example(self) -> Features:
        """The first image that has keypoints."""
        return self[int(np.argmax(self.counts > 0))]

    @property
    def keypoint_bytes(self) -> int:
        """Bytes of one keypoint with all that belongs to it, as the first image says that has any."""
        return sum(values[:1].nbytes for values in per_keypoint(self._example).values())

    @property
    def dimension(self) -> int:
        """Numbers of a descriptor, likewise."""
        return self._example.descriptors.shape[1]

    def read(self, rows: Iterable[int]) -> Iterator[tuple[int, Features]]:
        """(row, Features `[n, ...]`) of those among `rows` that have keypoints."""
        counts = self.counts
        return self.source.read([row for row in rows if counts[row] > 0])


def memory_budget(memory: float | None, devices: Sequence[Device]) -> int:
    """Bytes for features on each of the devices that share the work.

    They are `memory` GB, by default a third of what is free. Devices without a memory of their own share it.
    """
    free = free_bytes(devices[0])
    sharing = 1 if devices[0].memory_stats() else len(devices)
    return int((SHARE * free if memory is None else 1e9 * memory) / sharing)


def _capacities(counts: np.ndarray) -> np.ndarray:
    """One or two capacities for images of such counts: two where that spares the half of them a quarter or more."""
    half, most = ragged.sizes(counts, (0.5, 1.0), STEP)[[0, -1]]
    return np.array([half, most] if half <= 0.75 * most else [most])


def few_sizes(number: int) -> int:
    """At least as many slots, by a quarter more at most: another number is another program."""
    number = max(WRITTEN, number)
    return round_up(number, 2 ** (number.bit_length() - 3))


class Staged(NamedTuple):
    """Rows that are to be on the device, and those among them that are not there yet.

    capacity, slot: `[n]` where each of the rows is: in the slots of which capacity, and in which.
    new: (capacity, slots `[WRITTEN]`, Features `[WRITTEN, N, ...]`), some of which may be no rows: no slots either.
    """

    capacity: np.ndarray
    slot: np.ndarray
    new: Sequence[tuple[int, np.ndarray, Features]]


class Recent:
    """The slots of one capacity: which row is in which; what was used longest ago makes room."""

    def __init__(self, number: int) -> None:
        """All of them empty."""
        self.number = number
        self._slots: OrderedDict[int, int] = OrderedDict()

    def take(self, rows: Sequence[int]) -> tuple[list[int], list[int]]:
        """(slots of distinct rows, the rows among them that were not there).

        Raises:
            ValueError: more rows than slots.
        """
        if len(rows) > self.number:
            raise ValueError(f"expected at most {self.number} rows at the same time, got {len(rows)}")
        new = [row for row in rows if row not in self._slots]
        for row in rows:  # first all that are there, so that none of them makes room
            if row in self._slots:
                self._slots.move_to_end(row)
        for row in new:
            is_full = len(self._slots) == self.number
            self._slots[row] = self._slots.popitem(last=False)[1] if is_full else len(self._slots)
        return [self._slots[row] for row in rows], new


class Slots:
    """Rows of a feature set on one device, padded, in slots of a few capacities.

    An image's capacity depends on its count and on those of all the images that will be asked for, never on the
    others that are matched with it. `stage` reads, and may run ahead on another thread, by two calls; `put` writes to
    the device.
    """

    def __init__(self, features: FeatureSet, wanted: np.ndarray, budget: int, device: Device) -> None:
        """Nothing is on the device yet.

        Args:
            features: whose rows.
            wanted: `[n]` distinct rows that will be asked for.
            budget: bytes that the slots and what is on its way to them may take; a few slots there are in any case.
            device: where.
        """
        self._features, self._device = features, device
        counts = features.counts
        capacities = _capacities(counts[wanted])
        self._capacity = ragged.fitting(capacities, np.minimum(counts, capacities[-1]))
        asked = self._capacity[wanted[counts[wanted] > 0]]
        rows = {int(capacity): int(np.sum(asked == capacity)) for capacity in capacities}
        size = features.keypoint_bytes if asked.size else 1
        kept = KEPT * budget / max(1, sum(capacity * size * number for capacity, number in rows.items()))
        self._together = max(WRITTEN, int(STAGED * budget / (capacities[-1] * size)))
        self._recent = {
            capacity: Recent(few_sizes(min(number, max(self._together, int(kept * number)))))
            for capacity, number in rows.items()
        }
        self._arrays: dict[int, Features] = {}

    def parts(self, rows: np.ndarray) -> Iterator[np.ndarray]:
        """Distinct rows in parts that can be asked for at the same time, as they come."""
        return (rows[start : start + self._together] for start in range(0, len(rows), self._together))

    def stage(self, rows: np.ndarray) -> Staged:
        """Where rows `[n]` of one of the `parts` will be, each as often as it comes, having read what is not there."""
        distinct, place = np.unique(rows, return_inverse=True)
        capacity, slot = self._capacity[distinct], np.zeros(len(distinct), np.int32)
        missing: list[tuple[int, list[int]]] = []
        for size, recent in self._recent.items():
            there = capacity == size
            slot[there], new = recent.take(distinct[there].tolist())
            missing += [(size, new[start : start + WRITTEN]) for start in range(0, len(new), WRITTEN)]
        read = self._features.read([row for _, new in missing for row in new])
        written = []
        for size, new in missing:
            images = [image for _, image in itertools.islice(read, len(new))]
            slots = np.full(WRITTEN, self._recent[size].number, np.int32)
            slots[: len(new)] = slot[np.searchsorted(distinct, new)]
            written.append((size, slots, stacked(images, size, total=WRITTEN)))
        return Staged(capacity[place], slot[place], written)

    def put(self, staged: Staged) -> Mapping[int, Features]:
        """The rows on the device, by capacity `[slots, N, ...]`: good until the next call."""
        for capacity, slots, features in staged.new:
            rows = jax.device_put(features, self._device)
            if capacity not in self._arrays:
                self._arrays[capacity] = empty_slots(rows, self._recent[capacity].number)
            self._arrays[capacity] = write_slots(self._arrays[capacity], slots, rows)
        return self._arrays


def empty_slots(rows: Features, number: int) -> Features:
    """As many rows `[number, N, ...]` of zeros, where rows `[R, N, ...]` are."""
    return jax.tree.map(lambda leaf: jnp.zeros((number, *leaf.shape[1:]), leaf.dtype, device=leaf.device), rows)


def write_slots(arrays: Features, slots: np.ndarray, rows: Features) -> Features:
    """With rows `[R, N, ...]` in slots `[R]`, beyond the last those that are none; in place."""
    return jax.tree.map(lambda array, row: array.at[slots].set(row, mode="drop"), arrays, rows)


write_slots = compiled(write_slots, donate_argnums=0)  # the arrays may be as large as the memory allows


def stacked(images: Sequence[Features], capacity: int, *, total: int | None = None) -> Features:
    """Features `[n, ...]` of at least one image as `[R, capacity, ...]`, NumPy; see `ragged.padded`."""
    rows = [{name: values for name, values in per_keypoint(image).items() if name != "mask"} for image in images]
    arrays, mask = ragged.padded(rows, capacity, total=total)
    sizes = np.stack([image.image_size for image in images])
    return Features(**arrays, mask=mask, image_size=sizes if total is None else ragged.filled(sizes, total))


def without_padding(image: Features) -> Features:
    """In single precision, as it is matched."""
    real = np.asarray(image.mask)
    arrays = {name: np.asarray(values, np.float32)[real] for name, values in per_keypoint(image).items()}
    return Features(**arrays | {"mask": real[real]}, image_size=np.asarray(image.image_size, np.float32))


def check_features(image: Features, who: str, *, unit_length: bool) -> None:
    """Features of one's own, `[N, ...]`.

    Raises:
        InputError: arrays do not fit, or descriptors are not of unit length where they must be.
    """
    count = len(image.mask)
    shapes = {name: np.shape(values) for name, values in per_keypoint(image).items()}
    expected = {
        "keypoints": (count, 2),
        "descriptors": (count, *shapes["descriptors"][1:]),
        "scores": (count,),
        "mask": (count,),
    }
    if shapes != expected or len(shapes["descriptors"]) != 2 or np.asarray(image.mask).dtype != bool:
        raise InputError(
            f"{who}: expected keypoints [N, 2], descriptors [N, D], scores [N] and mask [N] bool, "
            f"got shapes {', '.join(str(shape) for shape in shapes.values())}; transpose descriptors that are [D, N]"
        )
    lengths = (
        np.linalg.norm(np.asarray(image.descriptors, np.float32)[image.mask], axis=1) if unit_length else np.ones(1)
    )
    if (wrong := np.abs(lengths - 1) > 0.01).any():
        raise InputError(
            f"{who}: expected descriptors of unit length, got {lengths[wrong][0]:.4g}; "
            "divide them by their Euclidean length, or say unit_length=False"
        )
