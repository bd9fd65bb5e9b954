"""Features on demand: where the local features of many images come from, and the few that lie on a device just now.

A data set's features need not fit into memory. They stay where they are (a store, a file of another program, a list),
known by their counts; rows are read when somebody matches them, and kept on the device until others need the room.
"""

from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from mfvpr import ragged
from mfvpr.errors import InputError
from mfvpr.numerics import Device, compiled, free_bytes
from mfvpr.types import Features, per_keypoint

SHARE = 1 / 3  # of the free memory, where nobody says how much
STEP = 32  # capacities are multiples of it
WRITTEN = 64  # rows that go to the device at a time: one program


class FeatureSource(Protocol):
    """Local features of M images, in rows."""

    counts: np.ndarray  # [M] int keypoints of each image; below 0 = there are none to be read

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
            _check(image, number, unit_length)
        return cls(InMemory(dict(enumerate(map(_without_padding, images))), len(images)), {})

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

    def read(self, rows: Iterable[int]) -> Iterator[tuple[int, Features]]:
        """(row, Features `[n, ...]`) of those among `rows` that have keypoints."""
        counts = self.counts
        return self.source.read([row for row in rows if counts[row] > 0])


def memory_budget(memory: float | None, device: Device) -> int:
    """Bytes for features on a device: of `memory` GB, by default a third of what is free there.

    Devices that share the machine's memory share what is given.
    """
    own = bool(device.memory_stats())
    sharing = 1 if own else jax.local_device_count(device.platform)
    return int((SHARE * free_bytes(device) if memory is None else 1e9 * memory) / sharing)


def _capacities(counts: np.ndarray) -> np.ndarray:
    """One or two capacities for images of such counts: two where that spares the half of them a quarter or more."""
    half, most = ragged.sizes(counts, (0.5, 1.0), STEP)[[0, -1]]
    return np.array([half, most] if half <= 0.75 * most else [most])


class Staged(NamedTuple):
    """Rows that are to be on the device, and those among them that are not there yet.

    capacity, slot: `[R]` where each of the rows is: in the slots of which capacity, and in which.
    new: by capacity, (slots `[n]`, Features `[n, N, ...]`).
    """

    capacity: np.ndarray
    slot: np.ndarray
    new: dict[int, tuple[np.ndarray, Features]]


class Slots:
    """Rows of a feature set on one device, padded, in slots of a few capacities; what was used longest ago makes room.

    An image's capacity depends on its count and on those of all the images that will be asked for, never on the
    others that are matched with it. `stage` reads, and may run ahead on another thread; `put` writes to the device.
    """

    def __init__(self, features: FeatureSet, wanted: np.ndarray, budget: int, device: Device) -> None:
        """Nothing is read yet.

        Args:
            features: whose rows.
            wanted: the rows that will be asked for.
            budget: bytes that the slots may take; a few slots there are in any case.
            device: where.
        """
        self._features, self._device, self._budget = features, device, budget
        counts = features.counts
        capacities = _capacities(counts[wanted])
        self._capacity = ragged.fitting(capacities, np.minimum(counts, capacities[-1]))
        self._wanted = {int(c): int(np.sum((self._capacity == c)[wanted] & (counts[wanted] > 0))) for c in capacities}
        self._used: dict[int, OrderedDict[int, int]] = {capacity: OrderedDict() for capacity in self._wanted}
        self._arrays: dict[int, Features] = {}
        self._number: dict[int, int] = {}
        self._bytes = 0

    def parts(self, rows: np.ndarray) -> Iterator[np.ndarray]:
        """The rows in parts that the slots hold at the same time, as they come."""
        room: dict[int, int] = {}
        start = 0
        for place, row in enumerate(rows.tolist()):
            capacity = int(self._capacity[row])
            if room.get(capacity, 0) >= self._slots(capacity, row):
                yield rows[start:place]
                start, room = place, {}
            room[capacity] = room.get(capacity, 0) + 1
        if start < len(rows):
            yield rows[start:]

    def stage(self, rows: np.ndarray) -> Staged:
        """Where distinct rows will be, one of `parts`, having read those that are not there."""
        missing: dict[int, dict[int, int]] = {}  # by capacity: row -> slot
        for row in rows.tolist():  # first all that are there, so that none of them makes room
            used = self._used[int(self._capacity[row])]
            if row in used:
                used.move_to_end(row)
        for row in rows.tolist():
            capacity = int(self._capacity[row])
            used = self._used[capacity]
            if row not in used:
                full = len(used) >= self._slots(capacity, row)
                used[row] = used.popitem(last=False)[1] if full else len(used)
                missing.setdefault(capacity, {})[row] = used[row]
        read = dict(self._features.read([row for slots in missing.values() for row in slots]))
        new = {
            capacity: (np.array([*slots.values()], np.int32), stacked([read[row] for row in slots], capacity))
            for capacity, slots in missing.items()
        }
        capacity = self._capacity[rows]
        slot = [self._used[int(one)][row] for one, row in zip(capacity, rows.tolist(), strict=True)]
        return Staged(capacity, np.array(slot, np.int32), new)

    def put(self, staged: Staged) -> Mapping[int, Features]:
        """The rows on the device, by capacity `[slots, N, ...]`: good until the next call."""
        for capacity, (slots, features) in staged.new.items():
            if capacity not in self._arrays:
                self._arrays[capacity] = self._empty(features, self._number[capacity])
            for start in range(0, len(slots), WRITTEN):
                part = ragged.filled(np.arange(len(slots))[start : start + WRITTEN], WRITTEN)
                rows = jax.device_put(jax.tree.map(lambda leaf: leaf[part], features), self._device)  # noqa: B023
                self._arrays[capacity] = _write(self._arrays[capacity], slots[part], rows)
        return self._arrays

    def _slots(self, capacity: int, row: int) -> int:
        """How many of a capacity there are: for all that will be asked for, or what its part of the budget holds."""
        if capacity not in self._number:
            self._bytes = self._bytes or _bytes_of_keypoint(self._features, row)
            total = sum(number * size for size, number in self._wanted.items()) * self._bytes
            share = min(1.0, self._budget / max(total, 1))
            number = self._wanted[capacity]
            self._number[capacity] = max(1, min(number, max(WRITTEN, int(share * number))))
        return self._number[capacity]

    def _empty(self, features: Features, number: int) -> Features:
        with jax.default_device(self._device):
            return jax.tree.map(lambda leaf: jnp.zeros((number, *leaf.shape[1:]), leaf.dtype), features)


def _write(arrays: Features, slots: np.ndarray, rows: Features) -> Features:
    return jax.tree.map(lambda array, row: array.at[slots].set(row), arrays, rows)


_write = compiled(_write, donate_argnums=0)  # in place: the arrays may be as large as the memory allows


def _bytes_of_keypoint(features: FeatureSet, row: int) -> int:
    [(_, image)] = features.read([row])
    return sum(values.nbytes for values in per_keypoint(image).values()) // len(image.mask)


def stacked(images: Sequence[Features], capacity: int) -> Features:
    """Features `[n, ...]` of at least one image as `[R, capacity, ...]`, NumPy."""
    rows = [{name: values for name, values in per_keypoint(image).items() if name != "mask"} for image in images]
    arrays, mask = ragged.padded(rows, capacity)
    return Features(**arrays, mask=mask, image_size=np.stack([image.image_size for image in images]))


def _without_padding(image: Features) -> Features:
    real = np.asarray(image.mask)
    return replace(image, **{name: np.asarray(values)[real] for name, values in per_keypoint(image).items()})


def _check(image: Features, number: int, unit_length: bool) -> None:
    """Of one's own image `[N, ...]`."""
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
            f"features of image {number}: expected keypoints [N, 2], descriptors [N, D], scores [N] and mask [N] bool, "
            f"got shapes {', '.join(str(shape) for shape in shapes.values())}; transpose descriptors that are [D, N]"
        )
    lengths = np.linalg.norm(np.asarray(image.descriptors, np.float32)[image.mask], axis=1)
    if unit_length and (wrong := np.abs(lengths - 1) > 0.01).any():
        raise InputError(
            f"features of image {number}: expected descriptors of unit length, got {lengths[wrong][0]:.4g}; "
            "divide them by their Euclidean length, or say unit_length=False"
        )
