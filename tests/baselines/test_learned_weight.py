"""The learned match weight: its start, its inputs, its values against loops, its gradients."""

import math
import operator
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from mfvpr import AggregatedScore, HistogramOfShifts, UnitWeight, score_candidates
from mfvpr.baselines.learned_weight import ABSOLUTE, RELATIVE, LearnedWeight
from mfvpr.core.weights import match_weights
from tests.builders import double, make_matches, per_match, random_matches, stack
from tests.scorers import pair_of

pytestmark = pytest.mark.thorough

SIZES = ((320, 240), (400, 300))
KEY = jax.random.key(0)


def pairs(seed=0, counts=(40, 25, 0), capacity=50):
    """Several pairs, the last without a match; NaN on padding."""
    rng = np.random.default_rng(seed)
    return stack([random_matches(rng, count, capacity=capacity, sizes=SIZES) for count in counts])


scores = jax.jit(score_candidates)
weigh = jax.jit(LearnedWeight.__call__)
both = pytest.mark.parametrize("names", [RELATIVE, ABSOLUTE])
LEARNED = ("hidden", "hidden_bias", "output", "output_bias")


def random_weight(names=ABSOLUTE):
    """A weight that is far from its start."""
    start, rng = LearnedWeight.create(KEY, pairs(), 5, names=names), np.random.default_rng(1)
    return replace(start, **{name: np.float32(rng.normal(size=getattr(start, name).shape)) for name in LEARNED})


def raw_oracle(matches, k, names):
    """The inputs of one match before they are standardized, float64."""
    real = [other for other in range(len(matches.mask)) if matches.mask[other]]

    def rank(values):
        below, equal = (sum(test(values[other], values[k]) for other in real) for test in (operator.lt, operator.eq))
        return (below + equal / 2) / len(real)

    values = {
        "scores0": matches.scores0[k],
        "scores1": matches.scores1[k],
        "distance": matches.distance[k],
        "ratio": matches.ratio[k],
        "distance_rank": rank(matches.distance),
        "score0_rank": rank(matches.scores0),
        "score1_rank": rank(matches.scores1),
        "relative_distance": matches.distance[k] / np.median([matches.distance[other] for other in real]),
    }
    for side in "01":
        points, size = getattr(matches, f"points{side}"), getattr(matches, f"image_size{side}")
        for axis, name in enumerate("xy"):
            half = float(size[axis]) / 2
            values[f"{name}{side}"] = (float(points[k][axis]) - half) / half
    return [float(values[name]) for name in names]


def oracle(weight, matches, k):
    raw = raw_oracle(matches, k, weight.names)
    center, scale = weight.center.tolist(), weight.scale.tolist()
    inputs = [(raw[f] - center[f]) / scale[f] for f in range(len(raw))]
    total = float(weight.output_bias)
    for unit in range(len(weight.output)):
        drive = sum(inputs[f] * float(weight.hidden[f, unit]) for f in range(len(raw)))
        total += float(weight.output[unit]) * math.tanh(drive + float(weight.hidden_bias[unit]))
    return math.log1p(math.exp(total))


def test_starts_as_the_unit_weight_in_a_scorer():
    matches = pairs()
    weight = LearnedWeight.create(KEY, matches)
    for scorer in (HistogramOfShifts(max_bins=64), AggregatedScore()):
        learned = scores(replace(scorer, weight=weight), matches)
        np.testing.assert_allclose(learned, scores(replace(scorer, weight=UnitWeight()), matches), rtol=1e-6)


@both
def test_statistics_are_those_of_the_real_matches(names):
    matches = pairs()
    weight = LearnedWeight.create(KEY, matches, names=names)
    real = [raw_oracle(pair_of(matches, pair), k, names) for pair, k in np.argwhere(matches.mask)]
    assert len(real) == 65
    np.testing.assert_allclose(weight.center, np.mean(real, axis=0), atol=1e-6)
    np.testing.assert_allclose(weight.scale, np.std(real, axis=0), rtol=1e-5)
    assert weight.center.shape == (len(names),)


@both
def test_whole_pairs_of_padding_may_hold_anything(names):
    matches = pairs()
    spoiled = jax.tree.map(np.copy, matches)
    for values in jax.tree.leaves(spoiled):
        values[2] = {"b": False, "f": np.nan, "i": -7}[values.dtype.kind]
    expected, got = (LearnedWeight.create(KEY, batch, names=names) for batch in (matches, spoiled))
    jax.tree.map(np.testing.assert_array_equal, got, expected)
    total = jax.jit(lambda weight, padding: jnp.sum(match_weights(weight, padding)))
    value, gradient = jax.value_and_grad(total)(random_weight(names), pair_of(spoiled, 2))
    assert value == 0
    assert all(np.all(leaf == 0) for leaf in jax.tree.leaves(gradient))


@both
def test_values_equal_the_loops(names):
    matches, weight = pair_of(pairs(2)), random_weight(names)
    matches.distance[3] = matches.distance[5]  # equals share their ranks
    order = np.random.default_rng(5).permutation(50)  # padding in between
    matches = per_match(matches, lambda rows: rows[order])
    expected = [oracle(weight, matches, k) for k in np.flatnonzero(matches.mask)]
    assert np.ptp(expected) > 0.5
    weights = weigh(weight, matches)
    np.testing.assert_allclose(weights[matches.mask], expected, rtol=2e-5)
    assert np.all(np.isfinite(weights))


def test_relative_inputs_are_those_of_other_units():
    """Another detector's scores, another length of descriptors; and more padding."""
    matches, weight = pair_of(pairs(7)), random_weight(RELATIVE)
    expected = weigh(weight, matches)[:40]
    other = replace(
        matches,
        scores0=np.float32(8) * matches.scores0**3,
        scores1=matches.scores1 + 5,
        distance=np.float32(4) * matches.distance,
    )
    np.testing.assert_allclose(weigh(weight, other)[:40], expected, rtol=1e-5)
    wider = pair_of(pairs(7, capacity=100))
    np.testing.assert_allclose(weigh(weight, wider)[:40], expected, rtol=1e-6)


def test_statistics_have_no_gradient():
    learned = jax.jit(jax.grad(lambda weight, matches: jnp.sum(match_weights(weight, matches))))(
        random_weight(), pair_of(pairs())
    )
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(learned))
    assert not np.any(learned.center)
    assert not np.any(learned.scale)
    assert all(np.any(getattr(learned, name)) for name in LEARNED)


@both
def test_gradients_equal_finite_differences(names):
    with jax.enable_x64(True):
        matches, weight = double((random_matches(np.random.default_rng(6), 7, sizes=SIZES), random_weight(names)))
        free = {name: getattr(weight, name) for name in LEARNED}

        @jax.jit
        def total(free, points1, ratio):
            return jnp.sum(replace(weight, **free)(replace(matches, points1=points1, ratio=ratio)) ** 2)

        check_grads(total, (free, matches.points1, matches.ratio), order=1, modes=["rev"])


def test_matches_without_a_ratio_raise():
    matches = make_matches([(1, 2)], [(3, 4)])
    for call in (random_weight(), random_weight().inputs, lambda matches: LearnedWeight.create(KEY, matches)):
        with pytest.raises(ValueError, match="match them with_ratio=True"):
            call(matches)
