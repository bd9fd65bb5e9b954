"""Matches that teach: which of them count as correct, the loss against a loop, and what is learned from them."""

import math
from dataclasses import replace

import jax
import numpy as np
import optax
import pytest

from mfvpr import AggregatedScore, HistogramOfShifts, RatioWeight
from mfvpr.baselines.learned_weight import RELATIVE, LearnedWeight
from mfvpr.tuning.learning.models import TEACHER_SIGMA, Model, Options, of_matches
from mfvpr.tuning.learning.splits import Batch
from mfvpr.tuning.learning.training import Schedule, fit
from tests.builders import make_matches
from tests.tuning.learning.paths import SIZES, split

pytestmark = pytest.mark.thorough

SHIFT = (30, -20)
TEACHER = HistogramOfShifts(bin_size=5.0, sigma=10.0, weight=RatioWeight(), max_bins=160)


def pair(rng, correct, size=24, capacity=30):
    """Half of the matches of a correct pair share a shift; these have the smaller ratios, incorrect ones look alike."""
    agree = (np.arange(size) < size // 2) & correct
    points0 = rng.uniform(50, 250, (size, 2))
    apart = rng.uniform(60, 150, (size, 2)) * rng.choice([-1, 1], (size, 2))  # further than the teacher's reach
    points1 = points0 + SHIFT + np.where(agree[:, None], 0, apart)
    ratio = np.where(agree, rng.uniform(0.3, 0.7, size), rng.uniform(0.6, 1, size))
    return make_matches(points0, points1, distance=rng.uniform(0.2, 1, size), ratio=ratio, capacity=capacity)


def batch(seed=0, queries=4, candidates=3):
    """The first candidate of every query is correct; the last of the last query is none."""
    rng = np.random.default_rng(seed)
    pairs = [pair(rng, candidate == 0) for _ in range(queries) for candidate in range(candidates)]
    matches = jax.tree.map(lambda *leaves: np.stack(leaves).reshape(queries, candidates, *leaves[0].shape), *pairs)
    mask = np.ones((queries, candidates), bool)
    mask[-1, -1] = False
    positives = np.tile(np.arange(candidates) == 0, (queries, 1))
    return Batch(matches, np.zeros(mask.shape, np.float32), positives, mask)


def model(taught):
    weight = LearnedWeight.create(jax.random.key(0), taught.matches, 4)
    return Model(AggregatedScore(), {"numbers": {}, "weight": weight}, 1.0, TEACHER)


def test_the_loss_is_that_of_a_loop():
    taught = batch()
    start_model = model(taught)
    rng = np.random.default_rng(3)
    output = np.float32(rng.normal(size=4))
    start = start_model.start | {
        "weight": replace(start_model.start["weight"], output=output, output_bias=np.float32(0.3))
    }
    correct, incorrect = [], []
    for query, candidate in np.argwhere(taught.mask):
        matches = jax.tree.map(lambda leaf: leaf[query, candidate], taught.matches)  # noqa: B023
        logits = np.asarray(start["weight"].logits(matches), np.float64)
        for k in np.flatnonzero(matches.mask):
            off = np.abs(matches.points1[k] - matches.points0[k] - np.float32(SHIFT)).max()
            if taught.positives[query, candidate] and off < 2:
                correct.append(math.log1p(math.exp(-logits[k])))
            else:
                incorrect.append(math.log1p(math.exp(logits[k])))
    assert len(correct) == 4 * 12
    expected = (np.mean(correct) + np.mean(incorrect)) / 2
    assert float(jax.jit(start_model.objective(None))(start, taught)) == pytest.approx(expected, rel=1e-5)


def test_it_finds_what_tells_right_matches_from_wrong_ones():
    taught, other = batch(), batch(seed=9)
    teachable = model(taught)
    result = fit(teachable.start, teachable.objective(None), lambda _: taught, Schedule(optax.adam(0.05), steps=40))
    loss = jax.jit(teachable.objective(None))
    assert loss(result.parameters, other) < 0.85 * loss(teachable.start, other)
    learned = teachable.scorer_of(result.parameters)
    assert isinstance(learned, AggregatedScore)
    clear, doubtful = (
        jax.tree.map(lambda leaf: leaf[0, 0], replace(other.matches, ratio=np.full_like(other.matches.ratio, ratio)))
        for ratio in (0.4, 0.9)
    )
    weigh = jax.jit(LearnedWeight.__call__)
    assert np.all((weigh(learned.weight, clear) > 2 * weigh(learned.weight, doubtful))[:24])
    assert teachable.values(result.parameters) == {}


def test_the_teacher_goes_with_the_size_of_the_images_that_learning_sees():
    taught_split = split()
    matches = [*taught_split.match_set.matches]
    for query in taught_split.half.report:
        matches[query] = replace(matches[query], image_size0=np.float32([900, 900]))
    taught_split = replace(taught_split, match_set=replace(taught_split.match_set, matches=matches))
    taught_model = of_matches(taught_split, HistogramOfShifts(bin_size=20.0, sigma=20.0), Options(batch=4))
    assert taught_model.teacher.sigma == pytest.approx(TEACHER_SIGMA * max(SIZES))
    assert taught_model.teacher.bin_size == pytest.approx(taught_model.teacher.sigma / 2)
    assert taught_model.teacher.max_bins >= 2 * max(SIZES) / taught_model.teacher.bin_size
    assert taught_model.start["weight"].names == RELATIVE
