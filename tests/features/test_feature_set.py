"""Features on demand: own features that are checked, and rows on a device that make room for others."""

from collections import Counter
from dataclasses import fields, replace

import jax
import numpy as np
import pytest

from mfvpr import Features, InputError
from mfvpr.features import FeatureSet
from mfvpr.features.feature_set import RESIDENT, WRITTEN, Slots, memory_budget, stack_features
from tests.builders import make_features

DEVICE = jax.devices()[0]
KEYPOINT = 4 * (16 + 2 + 1) + 1  # bytes of one keypoint of `make_features`


class Counting:
    """A source that says how often each row was read."""

    def __init__(self, source):
        self.source, self.counts, self.reads = source, source.counts, Counter()

    def read(self, rows=None):
        for row, image in self.source.read(rows):
            self.reads[row] += 1
            yield row, image


def images_of(counts, seed=0, **options):
    rng = np.random.default_rng(seed)
    return [make_features(rng, count, **options) for count in counts]


def counted(counts):
    source = Counting(FeatureSet.of(images_of(counts)).source)
    return FeatureSet(source, {}), source


def on_device(slots, rows):
    """Each row as it lies there `[N, ...]`, NumPy."""
    staged = slots.stage(np.asarray(rows, int))
    arrays = jax.tree.map(np.array, dict(slots.put(staged)))
    return [
        jax.tree.map(lambda leaf, slot=slot: leaf[slot], arrays[int(capacity)])
        for capacity, slot in zip(staged.capacity, staged.slot, strict=True)
    ]


def assert_are(got, images, rows):
    for features, row in zip(got, rows, strict=True):
        expected = jax.tree.map(lambda leaf: leaf[0], stack_features([images[row]], len(features.mask)))
        for part in fields(Features):
            np.testing.assert_array_equal(getattr(features, part.name), getattr(expected, part.name))


# Own features


def test_own_features_lose_their_padding_and_nothing_else():
    images = images_of([9, 0, 4], capacity=9)
    feature_set = FeatureSet.of(images)
    assert len(feature_set) == 3
    assert feature_set.counts.tolist() == [9, 0, 4]
    assert feature_set.bad == {}
    assert [row for row, _ in feature_set.read(range(3))] == [0, 2]
    for name in ("keypoints", "descriptors", "scores"):
        np.testing.assert_array_equal(getattr(feature_set[2], name), getattr(images[2], name)[:4])
    assert feature_set[2].mask.all()
    assert feature_set.keypoint_bytes == KEYPOINT


AXES = {"keypoints": (2, 5, 2), "descriptors": (2, 5, 16), "scores": (2, 5), "mask": (2, 5), "image_size": (2, 2)}
STACKED = {name: np.ones(shape, bool if name == "mask" else float) for name, shape in AXES.items()}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ([], "at least one image, got none"),
        ([{}, {"image_size": None}], r"image 1: .*image_size \[2\].* got shapes \(5,\) and \(\)"),
        ([STACKED], r"mask \[N\]"),
        ([{}, {"descriptors": np.full((5, 16), 2.0)}], "image 1: .*unit length, got 8;"),
        ([{}, {"descriptors": np.ones((5, 8)) / np.sqrt(8)}], "image 1: .*16 .*, got 8;"),
    ],
)
def test_own_features_that_do_not_fit_are_refused(changes, message):
    [image] = images_of([5])
    with pytest.raises(InputError, match=message) as error:
        FeatureSet.of([replace(image, **change) for change in changes])
    assert "\n" not in str(error.value)


# Memory


class Accelerator:
    platform = "gpu"

    def memory_stats(self):
        return {"bytes_limit": 9 * 10**9, "bytes_in_use": 3 * 10**9}


def test_processors_share_what_is_given_and_accelerators_have_their_own():
    assert memory_budget(3, [DEVICE]) == 3 * 10**9
    assert memory_budget(3, [DEVICE] * 8) == 3 * 10**9 // 8
    assert memory_budget(3, [Accelerator()] * 8) == 3 * 10**9  # pyright: ignore
    assert memory_budget(None, [Accelerator()] * 8) == 2 * 10**9  # pyright: ignore
    assert 10**6 < memory_budget(None, [DEVICE]) < 10**13


# Rows on a device


COUNTS = [30, 25, 0, 200, 31, 1, 180, 29, 200, 32]


@pytest.mark.parametrize("rows", [[0], [0, 3], [3, 0, 3, 0, 9], [1, 5, 4, 6, 8, 9], []])
def test_rows_lie_there_as_they_are(rows):
    images = images_of(COUNTS)
    slots = Slots(FeatureSet.of(images), np.arange(10), 10**9, DEVICE)
    got = on_device(slots, rows)
    assert_are(got, images, rows)
    assert {len(features.mask) for features in got} <= {32, 224}
    assert_are(on_device(slots, [*rows, 7]), images, [*rows, 7])


def test_what_fits_is_read_once():
    counts = [30, 200, 30] * 33 + [200]
    features, source = counted(counts)
    slots = Slots(features, np.arange(100), 10**9, DEVICE)
    source.reads.clear()
    rng = np.random.default_rng(0)
    for _ in range(10):
        on_device(slots, rng.integers(0, 100, 60))
    assert max(source.reads.values()) == 1
    assert len(source.reads) > 90


def test_few_slots_hold_the_rows_in_use_and_reads_are_as_few_as_can_be():
    """Against a model that knows what was used when."""
    counts = [30] * 60 + [200] * 40
    images, (features, source) = images_of(counts), counted(counts)
    slots = Slots(features, np.arange(100), 0, DEVICE)
    source.reads.clear()
    rng = np.random.default_rng(1)
    there, reads = {32: [], 224: []}, 0  # by capacity, what was used longest ago first
    for _ in range(30):
        rows = np.unique(rng.integers(0, 100, WRITTEN))
        assert_are(on_device(slots, rows), images, rows)
        for capacity, order in there.items():
            wanted = [row for row in rows.tolist() if (counts[row] > 30) == (capacity == 224)]
            reads += len(set(wanted) - set(order))
            used = [row for row in wanted if row in order] + [row for row in wanted if row not in order]
            order[:] = ([row for row in order if row not in wanted] + used)[-WRITTEN:]
    assert sum(source.reads.values()) == reads
    assert reads > 250


def test_slots_and_what_is_on_its_way_stay_within_the_budget():
    features, _ = counted([200] * 190 + [30] * 210)
    rows = np.arange(400)
    total_bytes = (190 * 224 + 210 * 32) * KEYPOINT
    for share in (1, 3):
        budget = share * total_bytes
        slots = Slots(features, rows, int(budget), DEVICE)
        staged = [slots.stage(part) for part in slots.parts(rows)]
        assert len(next(slots.parts(rows))) > (WRITTEN if share >= 1.5 else 0)
        largest = max(sum(leaf.nbytes for *_, new in part.new for leaf in jax.tree.leaves(new)) for part in staged)
        for part in staged:
            arrays = slots.put(part)
        taken = sum(leaf.nbytes for leaf in jax.tree.leaves(arrays))
        assert 0.45 * min(budget, total_bytes) < taken < 1.25 * total_bytes
        assert taken + 6 * largest < budget + 6 * WRITTEN * (224 + 32) * KEYPOINT  # of each capacity, `WRITTEN` rows
        again = [slots.stage(part) for part in slots.parts(rows)]
        assert any(part.new for part in again) == (share < 1 / RESIDENT)


def test_rows_are_written_by_one_program_for_each_capacity(compilations):
    rng = np.random.default_rng(5)

    def use(counts, num_rows, budget):
        features = FeatureSet.of(images_of(counts, dimension=24))
        slots = Slots(features, np.arange(len(counts)), budget, DEVICE)
        for part in slots.parts(rng.permutation(len(counts))[:num_rows]):
            jax.block_until_ready(slots.put(slots.stage(part)))

    for budget in (0, 10**8):
        use([40] * 37 + [300] * 36, 73, budget)
        compilations.reset()
        use([50] * 40 + [310] * 33, 37, budget)
        use([64] * 38 + [320] * 35, 9, budget)
        assert compilations.count == 0
