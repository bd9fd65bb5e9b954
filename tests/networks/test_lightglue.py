"""LightGlue against the public code's numbers (golden), and what padding and an early stop may change: nothing."""

import re
from dataclasses import replace
from functools import cache, partial

import jax
import numpy as np
import pytest

from mfvpr.checkpoints.checkpoint import read_checkpoint
from mfvpr.checkpoints.conversion import TABLES, convert
from mfvpr.checkpoints.networks import plan_network
from mfvpr.core.types import per_keypoint
from mfvpr.matchers import LightGlueMatcher
from mfvpr.networks import LightGlue
from mfvpr.networks.lightglue import assignment
from mfvpr.utils import InputError
from tests.builders import double, read_golden, stack
from tests.golden import make_lightglue_real
from tests.golden.make_lightglue import DEPTH, REAL, SEEDS, SIZES, SMALL, SURE, checkpoint, pair
from tests.needs import LIGHTGLUE as FILE
from tests.needs import needs
from tests.networks.checkpoints import fill, fill_published

pytestmark = pytest.mark.thorough

INPUTS = SMALL["inputs"]
assigned = jax.jit(assignment)


build_small = partial(LightGlue, *SMALL.values())


@cache
def small_network(seed=0, sure=None):
    return fill(build_small, TABLES["lightglue"], checkpoint(seed, sure))


@cache
def small(seed=0, sure=None, dtype=np.float32):
    """The packed weights of a small network."""
    return jax.jit(LightGlue.pack)(jax.tree.map(lambda leaf: leaf.astype(dtype), small_network(seed, sure)))


@pytest.fixture(scope="module")
def real_golden():
    return read_golden("lightglue_real")


@pytest.fixture(scope="module")
def matcher():
    """With the published weights."""
    return LightGlueMatcher.of(fill_published("aliked_lightglue", read_checkpoint(FILE)))


match_one = jax.jit(lambda matcher, features0, features1: matcher(features0, features1))


def padded(features, capacity, garbage=np.nan):
    """The same keypoints among more slots."""

    def rows(values):
        fill = np.full((capacity - len(values), *values.shape[1:]), False if values.dtype == bool else garbage)
        return np.concatenate([values, fill.astype(values.dtype)])

    return replace(features, **{name: rows(values) for name, values in per_keypoint(features).items()})


def assert_same(assignments, expected, atol=1e-5):
    """As assignments, and as their logarithms, which go down to -100."""
    np.testing.assert_allclose(assignments, expected, rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(np.exp(assignments), np.exp(expected), rtol=0, atol=atol)


@pytest.mark.optimized
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("counts", SIZES, ids=str)
def test_assignments_are_the_public_codes(golden, counts, seed):
    features0, features1 = pair(counts, INPUTS, seed)
    assignments = np.asarray(assigned(small(seed), padded(features0, 40), padded(features1, 40)))
    assert assignments.shape == (40, 40)
    assert_same(assignments[: counts[0], : counts[1]], golden[f"random/{seed}/{counts}"])
    assert (assignments[counts[0] :] == -np.inf).all()
    assert (assignments[:, counts[1] :] == -np.inf).all()


@pytest.mark.optimized
@pytest.mark.slow
def test_in_double_precision_nothing_but_rounding_is_left(golden):
    with jax.enable_x64(True):
        assignments = assigned(small(dtype=np.float64), *map(double, pair(SIZES[0], INPUTS, 0)))
    np.testing.assert_allclose(assignments, golden[f"random/0/{SIZES[0]}"], rtol=0, atol=1e-11)


@pytest.mark.parametrize("sure", SURE)
def test_layers_behind_a_sure_one_are_left_out(golden, sure):
    features = [padded(image, 40) for image in pair(SIZES[0], INPUTS, 0)]
    rows, columns = SIZES[0]
    assignments = np.asarray(assigned(small(0, sure), *features, depth_confidence=DEPTH))[:rows, :columns]
    assert_same(assignments, golden[f"sure/{sure}"])
    if sure is not None:
        assert np.abs(assignments - golden["sure/None"]).max() > 0.1


def test_less_is_sure_enough_behind_more_layers():
    """A confidence of 0.85: below 0.9, the first layer's threshold, above 0.8 + 0.1 e^(-4 / 3), the second's."""
    features = [padded(image, 40) for image in pair(SIZES[0], INPUTS, 0)]
    weights, expected = (small(0, sure) for sure in (None, 1))
    kernel, bias = (np.zeros_like(leaf) for leaf in weights.confidences)
    even = weights._replace(confidences=type(weights.confidences)(kernel, bias + np.float32(np.log(0.85 / 0.15))))
    assignments, stopped = (assigned(packed, *features, depth_confidence=DEPTH) for packed in (even, expected))
    np.testing.assert_array_equal(assignments, stopped)


@pytest.mark.optimized
def test_a_pair_depends_neither_on_its_padding_nor_on_its_batch():
    """One that stops early does not stop others."""
    pairs = [pair(counts, INPUTS, 5) for counts in ((20, 30), (30, 12), (7, 7))]
    weights = [small(0, sure) for sure in (0, None, 1)]
    stacked = [stack([padded(image, 40) for image in side]) for side in zip(*pairs, strict=True)]
    together = jax.jit(jax.vmap(partial(assignment, depth_confidence=DEPTH)))
    batch = np.asarray(together(stack(weights), *stacked))
    for number, (features0, features1) in enumerate(pairs):
        count0, count1 = len(features0.mask), len(features1.mask)
        for garbage in (np.inf, 1e30):
            sides = padded(features0, 40, garbage), padded(features1, 40, garbage)
            assignments = np.asarray(assigned(weights[number], *sides, depth_confidence=DEPTH))
            assert_same(assignments[:count0, :count1], batch[number, :count0, :count1])


def test_what_is_not_finite_is_no_keypoint_and_of_none_nothing_is_said():
    features0, features1 = (padded(image, 40) for image in pair((20, 30), INPUTS, 3))
    features0.descriptors[4, 1], features0.keypoints[9, 0] = np.nan, np.inf
    without = replace(features0, mask=features0.mask & ~np.isin(np.arange(40), [4, 9]))
    assignments, expected = (np.asarray(assigned(small(), image, features1)) for image in (features0, without))
    np.testing.assert_array_equal(assignments, expected)
    assert (assignments[[4, 9]] == -np.inf).all()
    assert np.isfinite(assignments[:4, :30]).all()
    nobody = replace(features0, mask=np.zeros(40, bool))
    assert (np.asarray(assigned(small(), nobody, features1)) == -np.inf).all()


@pytest.mark.optimized
@needs(FILE)
def test_published_weights_assign_as_the_public_code(golden, matcher):
    for counts in REAL:
        assignments = assigned(matcher.weights, *(padded(image, 72) for image in pair(counts, 128, 0)))
        expected = golden[f"real/{counts}"]
        assert (np.exp(expected) > 0.9).sum() >= 10
        np.testing.assert_allclose(np.exp(assignments[: counts[0], : counts[1]]), np.exp(expected), rtol=0, atol=2e-5)


def test_older_names_of_the_published_tensors_are_known():
    shapes, tensors = plan_network(build_small).shapes, checkpoint(0)
    name, older_name = r"transformers\.(\d)\.(self|cross)_attn", r"\2_attn.\1"
    older = {re.sub(name, older_name, key): array for key, array in tensors.items()}
    assert older.keys() != tensors.keys()
    converted = convert(older | {"confidence_thresholds": np.zeros(3)}, TABLES["lightglue"], shapes)
    expected = convert(tensors, TABLES["lightglue"], shapes)
    assert all(np.array_equal(converted[path], expected[path]) for path in shapes)
    twice = {"self_attn.0.Wqkv.bias": tensors["transformers.0.self_attn.Wqkv.bias"]}
    with pytest.raises(InputError, match=r"self_attn.0.Wqkv.bias twice"):
        convert(tensors | twice, TABLES["lightglue"], shapes)


@pytest.mark.optimized
@needs(FILE)
@pytest.mark.parametrize("name", make_lightglue_real.PAIRS)
def test_photographs_are_matched_as_by_the_public_code(real_golden, matcher, name):
    """The same pairs of keypoints with the same scores, whatever the padding."""
    features0, features1 = (padded(image, 192) for image in make_lightglue_real.features(real_golden, name))
    matches = match_one(matcher, features0, features1)
    real = np.asarray(matches.mask)
    pairs = np.stack([matches.index0, matches.index1], axis=1)[real]
    np.testing.assert_array_equal(pairs, real_golden[f"{name}/matches"])
    np.testing.assert_allclose(np.asarray(matches.confidence)[real], real_golden[f"{name}/scores"], rtol=0, atol=1e-4)
    assert len(pairs) > 20
