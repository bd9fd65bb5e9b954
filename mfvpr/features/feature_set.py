"""Sources of local features (a store, a file of another program, a list), and the features that are on a device.

A data set's features need not fit into memory: only their counts are always known. Rows are read when they are matched,
and stay on the device until it is full.
"""

import itertools
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Int, Shaped

from mfvpr.core.types import Array, Features, per_keypoint
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import Device, compiled, free_bytes, repeat_last, round_up

SHARE = 1 / 3  # of the free memory, by default
STEP = 32  # capacities are multiples of it
WRITTEN = 16  # rows that go to the device at a time: one program
RESIDENT, STAGED = 3 / 5, 1 / 24  # of the budget: for rows that stay, and for each of up to six parts on their way


class FeatureSource(Protocol):
    """Local features of images, by row."""

    @property
    def counts(self) -> Int[np.ndarray, " images"]:
        """Number of keypoints of each image; below 0 = the image has no features to read."""
        ...

    def read(self, rows: Iterable[int] | None = None) -> Iterator[tuple[int, Features]]:
        """Read (row, Features `[n, ...]`, NumPy, without padding) of `rows`, in their order; by default of all."""
        ...


class InMemory:
    """A source of features in memory: Features `[n, ...]` without padding, by row of `total` images."""

    def __init__(self, images: Mapping[int, Features], total: int) -> None:
        self._images = images
        self.counts = np.array([len(images[row].mask) if row in images else -1 for row in range(total)], int)

    def read(self, rows: Iterable[int] | None = None) -> Iterator[tuple[int, Features]]:
        return ((row, self._images[row]) for row in (sorted(self._images) if rows is None else rows))


@dataclass(frozen=True)
class FeatureSet:
    """Local features of all images of a folder, of one scale."""

    source: FeatureSource
    bad: Mapping[int, str]  # images without usable features or without a usable global descriptor: row -> reason

    @classmethod
    def of(cls, images: Sequence[Features], *, unit_length: bool = True) -> "FeatureSet":
        """Make a set from your own features, one `[N_i, ...]` per image, at least one; padding is dropped.

        Descriptors must be of `unit_length`, as the weight 2 - distance requires; matching itself looks for the largest
        dot product, and takes any. No images, other lengths, and arrays of wrong shapes raise an `InputError`.
        """
        if not images:
            raise InputError("FeatureSet.of: expected the features of at least one image, got none")
        for number, image in enumerate(images):
            check_features(image, f"features of image {number}", unit_length=unit_length)
            if (dimension := image.descriptors.shape[1]) != (expected := images[0].descriptors.shape[1]):
                got = f"{dimension}; extract all images alike"
                raise InputError(f"features of image {number}: expected {expected} dimensions, got {got}")
        return cls(InMemory(dict(enumerate(map(without_padding, images))), len(images)), {})

    @property
    def counts(self) -> Int[np.ndarray, " images"]:
        """Number of keypoints of each image; 0 if the image has no features to read."""
        return np.maximum(self.source.counts, 0)

    def __len__(self) -> int:
        return len(self.source.counts)

    def __getitem__(self, row: int) -> Features:
        """Features `[n, ...]` of one image that is not bad, NumPy, without padding."""
        [(_, features)] = self.source.read([row])
        return features

    @cached_property
    def dimension(self) -> int:
        """Length of a descriptor, of the first image that has keypoints."""
        return self[int(np.argmax(self.counts > 0))].descriptors.shape[1]

    @property
    def keypoint_bytes(self) -> int:
        """Bytes of one keypoint with its descriptor, position and score, float32, and mask."""
        return 4 * (self.dimension + 3) + 1

    def read(self, rows: Iterable[int]) -> Iterator[tuple[int, Features]]:
        """Read (row, Features `[n, ...]`) of the images in `rows` that have keypoints."""
        counts = self.counts
        return self.source.read([row for row in rows if counts[row] > 0])


def memory_budget(memory: float | None, devices: Sequence[Device]) -> int:
    """Bytes for features on each device: `memory` GB, by default a third of the free memory."""
    sharing = 1 if devices[0].memory_stats() else len(devices)  # devices without memory share the host's
    return int((SHARE * free_bytes(devices[0]) if memory is None else 1e9 * memory) / sharing)


class Staged(NamedTuple):
    """Slots of rows on the device, and the rows that have to be written to them first."""

    capacity: Int[np.ndarray, " rows"]  # of each row's slot
    slot: Int[np.ndarray, " rows"]  # number of each row's slot, among those of its capacity
    # Rows to write: (capacity, slots, Features `[WRITTEN, N, ...]`); padding has a slot beyond the last.
    new: Sequence[tuple[int, Int[np.ndarray, " WRITTEN"], Features]]


class Slots:
    """Rows of a feature set on one device, padded, in slots of a few capacities; the least recently used makes room.

    An image's capacity depends on its count and those of all planned images, never on the images that it is matched
    with. `stage` reads rows, and may run ahead on another thread by two calls; `put` writes them to the device.
    """

    def __init__(self, features: FeatureSet, planned: Int[np.ndarray, " rows"], budget: int, device: Device) -> None:
        """Plan empty slots for the distinct `planned` rows, with `budget` bytes for them and for rows on their way."""
        self._features, self._device = features, device
        counts = features.counts
        # The capacity that fits all counts, and a smaller one for half of the images if it saves a quarter.
        half, most = few_capacities(counts[planned], (0.5, 1.0), STEP)[[0, -1]].tolist()
        capacities = [half, most] if half <= 0.75 * most else [most]
        self._capacity = np.array(capacities)[np.searchsorted(capacities, np.minimum(counts, most))]
        planned = planned[counts[planned] > 0]
        rows = {capacity: int(np.sum(self._capacity[planned] == capacity)) for capacity in capacities}
        size = features.keypoint_bytes if len(planned) else 1
        share = RESIDENT * budget / max(1, sum(capacity * size * number for capacity, number in rows.items()))
        self._part_size = max(WRITTEN, int(STAGED * budget / (most * size)))
        self._numbers: dict[int, int] = {}  # of slots, by capacity
        for capacity, number in rows.items():
            number = max(WRITTEN, min(number, max(self._part_size, int(share * number))))
            # Rounded up, by a quarter at most, because each number needs a program of its own.
            self._numbers[capacity] = round_up(number, 2 ** (number.bit_length() - 3))
        self._slots = {capacity: OrderedDict[int, int]() for capacity in capacities}  # by row, the oldest first
        self._arrays: dict[int, Features] = {}

    def parts(self, rows: Int[np.ndarray, " rows"]) -> Iterator[Int[np.ndarray, " part"]]:
        """Split distinct rows into parts that fit on the device together, in their order."""
        return (rows[start : start + self._part_size] for start in range(0, len(rows), self._part_size))

    def stage(self, rows: Int[np.ndarray, " rows"]) -> Staged:
        """Assign slots to rows of one of the `parts`, with repetitions, and read the rows that are in no slot."""
        distinct, inverse = np.unique(rows, return_inverse=True)
        capacity, slot = self._capacity[distinct], np.zeros(len(distinct), np.int32)
        missing: list[tuple[int, list[int]]] = []
        for size, slots in self._slots.items():
            members = distinct[capacity == size].tolist()
            if len(members) > self._numbers[size]:
                raise ValueError(f"expected at most {self._numbers[size]} rows at the same time, got {len(members)}")
            new = [row for row in members if row not in slots]
            for row in members:  # before new rows come, so that none of these rows makes room for them
                if row in slots:
                    slots.move_to_end(row)
            for row in new:
                is_full = len(slots) == self._numbers[size]
                slots[row] = slots.popitem(last=False)[1] if is_full else len(slots)
            slot[capacity == size] = [slots[row] for row in members]
            missing += [(size, new[start : start + WRITTEN]) for start in range(0, len(new), WRITTEN)]
        features = self._features.read([row for _, new in missing for row in new])
        writes = []
        for size, new in missing:
            images = [image for _, image in itertools.islice(features, len(new))]
            numbers = np.full(WRITTEN, self._numbers[size], np.int32)
            numbers[: len(new)] = slot[np.searchsorted(distinct, new)]
            writes.append((size, numbers, stack_features(images, size, total=WRITTEN)))
        return Staged(capacity[inverse], slot[inverse], writes)

    def put(self, staged: Staged) -> Mapping[int, Features]:
        """Write staged rows to the device; return all slots `[slots, N, ...]` by capacity, until the next call."""
        for capacity, slots, features in staged.new:
            rows, number = jax.device_put(features, self._device), self._numbers[capacity]
            if capacity not in self._arrays:
                zeros = lambda leaf, number=number: jnp.zeros((number, *leaf.shape[1:]), leaf.dtype, device=leaf.device)  # noqa: E731
                self._arrays[capacity] = jax.tree.map(zeros, rows)
            self._arrays[capacity] = _write_slots(self._arrays[capacity], slots, rows)
        return self._arrays


@partial(compiled, donate_argnums=0)  # the arrays may be as large as the memory allows
def _write_slots(arrays: Features, slots: Int[Array, " rows"], rows: Features) -> Features:
    """Write rows `[R, N, ...]` to slots in place; rows with a slot beyond the last are dropped."""
    return jax.tree.map(lambda array, row: array.at[slots].set(row, mode="drop"), arrays, rows)


def stack_features(images: Sequence[Features], capacity: int, *, total: int | None = None) -> Features:
    """Pad Features `[n, ...]` of at least one image to `[R, capacity, ...]`, NumPy; see `pad_rows`."""
    rows = [{name: values for name, values in per_keypoint(image).items() if name != "mask"} for image in images]
    arrays, mask = pad_rows(rows, capacity, total=total)
    sizes = np.stack([image.image_size for image in images])
    return Features(**arrays, mask=mask, image_size=sizes if total is None else repeat_last(sizes, total))


def without_padding(image: Features) -> Features:
    """Features without padding, in single precision."""
    mask = np.asarray(image.mask)
    arrays = {name: np.asarray(values, np.float32)[mask] for name, values in per_keypoint(image).items()}
    return Features(**arrays | {"mask": mask[mask]}, image_size=np.asarray(image.image_size, np.float32))


def strength(image: Features) -> float:
    """Sum of the detection scores of one image's features; negative scores count as 0."""
    return float(np.maximum(np.asarray(image.scores)[np.asarray(image.mask)], 0).sum())


def check_features(image: Features, name: str, *, unit_length: bool) -> None:
    """Check Features of one image that come from user code; errors begin with `name`."""
    shapes = np.shape(image.mask), np.shape(image.image_size)
    if len(shapes[0]) != 1 or shapes[1] != (2,):
        expected = "a mask [N] and an image_size [2] of one image"
        raise InputError(f"{name}: expected {expected}, got shapes {shapes[0]} and {shapes[1]}; see Features.of")
    if not unit_length:
        return
    lengths = np.linalg.norm(np.asarray(image.descriptors, np.float32)[image.mask], axis=1)
    if (wrong := np.abs(lengths - 1) > 0.01).any():
        got = f"{lengths[wrong][0]:.4g}; divide them by their Euclidean length, or say unit_length=False"
        raise InputError(f"{name}: expected descriptors of unit length, got {got}")


def pad_rows(
    rows: Sequence[Mapping[str, np.ndarray]], capacity: int, *, total: int | None = None
) -> tuple[dict[str, Shaped[np.ndarray, "rows slots ..."]], Bool[np.ndarray, "rows slots"]]:
    """At least one row as `total` padded arrays by name, 0 beyond the ends of the rows, and the mask."""
    total = len(rows) if total is None else total
    arrays = {name: np.zeros((total, capacity, *values.shape[1:]), values.dtype) for name, values in rows[0].items()}
    counts = np.zeros(total, int)
    for place, row in enumerate(rows):
        counts[place] = len(next(iter(row.values())))
        for name, values in row.items():
            arrays[name][place, : counts[place]] = values
    return arrays, np.arange(capacity) < counts[:, None]


def few_capacities(counts: Int[np.ndarray, "..."], quantiles: Sequence[float], step: int) -> Int[np.ndarray, " _"]:
    """Few capacities, ascending multiples of `step`, that hold rows of lengths `counts`: quantiles of those above 0."""
    lengths = counts[counts > 0]
    if not lengths.size:
        return np.array([step])
    return np.unique(np.ceil(np.quantile(lengths, quantiles) / step).astype(int) * step)
