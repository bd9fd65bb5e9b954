"""A half of the path to learn from: its candidates and matches, and images of several sizes."""

import math
from dataclasses import replace

import jax
import numpy as np
import optax
import pytest

from mfvpr import AggregatedScore, HistogramOfShifts, InputError, MatchCount, RatioWeight, score_candidates
from mfvpr.baselines.learned_weight import ABSOLUTE, LearnedWeight
from mfvpr.tuning.learning import models as comparison
from mfvpr.tuning.learning.models import (
    LOSSES,
    Model,
    Options,
    cross_entropy,
    mean_loss,
)
from mfvpr.tuning.learning.splits import Batch
from mfvpr.tuning.learning.training import Schedule, fit
from mfvpr.tuning.sweeps import Axes
from tests.builders import make_matches
from tests.tuning.learning.paths import QUERIES, SIZES, TOLERANCES, split

pytestmark = pytest.mark.thorough

OPTIONS = Options(batch=4, hidden=5, inputs=ABSOLUTE)


@pytest.mark.parametrize("half", [0, 1])
def test_candidates_are_right_wrong_or_of_no_account(half):
    """Correct within the widest tolerance alone: neither positive nor negative. Reported places: not there at all."""
    at = split(half=half)
    batch = at.batch(at.train, len(at.train) + 2)
    reported = set(at.half.report.tolist())
    kinds = {"correct": 0, "incorrect": 0, "near": 0, "hidden": 0}
    for row, query in enumerate(at.train):
        frames = dict(zip(at.candidates.scores[query].tolist(), at.candidates.indices[query].tolist(), strict=True))
        rows = zip(batch.retrieval_scores[row].tolist(), batch.positives[row].tolist(), batch.mask[row], strict=True)
        taught = {frames[score]: positive for score, positive, real in rows if real}
        for frame in range(QUERIES):
            apart = abs(frame - query)
            if any(abs(frame - other) <= TOLERANCES[2] for other in reported):
                kind, expected = "hidden", None
            elif apart <= TOLERANCES[1]:
                kind, expected = "correct", True
            elif apart <= TOLERANCES[2]:
                kind, expected = "near", None
            else:
                kind, expected = "incorrect", False
            assert taught.get(frame) is expected
            kinds[kind] += 1
    assert min(kinds.values()) > 0
    assert not batch.mask[len(at.train) :].any()


HISTOGRAM = HistogramOfShifts(bin_size=20.0, sigma=20.0)
scores_of_one = jax.jit(score_candidates)


def scores_of(scorer, at, query):
    """Scores by the public function: every query with the sizes of its own images, and room for all bins."""
    return np.asarray(scores_of_one(replace(scorer, max_bins=2 * max(SIZES) // 20), at.match_set[query]))


def test_images_of_two_sizes_are_reported_on_as_one_by_one():
    at, c = split(), 2.5
    expected = []
    for query in at.half.report:
        order = np.argsort(-(scores_of(HISTOGRAM, at, query) + c * at.candidates.scores[query]), kind="stable")
        expected.append([abs(at.candidates.indices[query][order[0]] - query) <= width for width in TOLERANCES])
    compared = comparison.HalfComparison(at, Axes(HISTOGRAM, {}, {}), OPTIONS)
    np.testing.assert_array_equal(compared.evaluate("it", HISTOGRAM, {"c": c}).hits, np.transpose(expected))


def test_images_of_two_sizes_are_learned_from_as_one_by_one():
    """The loss of a batch is that of its queries' scores, which are finite."""
    at = split()
    model = Model.of_ranking(at, HISTOGRAM, OPTIONS)
    batch = at.batch(at.train, len(at.train))
    loss = jax.jit(model.objective(LOSSES["cross_entropy"]))(model.start, batch)
    scores = np.stack([scores_of(model.scorer_of(model.start), at, query) for query in at.train])
    assert np.all(np.isfinite(scores))
    expected = mean_loss(cross_entropy, 2 * scores / model.unit, at.correct[at.train], at.usable[at.train])
    assert float(loss) == pytest.approx(float(expected), rel=1e-4)


def test_queries_without_a_wrong_candidate_teach_nothing_and_judge_nothing():
    """Their loss is 0 from the start: as a validation it would stop every training at once."""
    alone = range(0, QUERIES, 3)
    every, rest = split(), split(only_right=alone)
    for chosen, before in ((rest.train, every.train), (rest.validation, every.validation)):
        assert list(chosen) == [query for query in before if query not in alone]
        assert len(chosen) < len(before)


def test_what_cannot_be_compared_is_refused():
    at = split()
    data = at.match_set, at.candidates
    with pytest.raises(InputError, match=r"MatchCount: .*numbers to learn"):
        comparison.compare(Axes(MatchCount(), {}, {}), at.protocol, *data)
    without_halves = replace(at.protocol, halves=(), split=None)
    with pytest.raises(InputError, match=r"split=None: .*first_half, second_half .*both"):
        comparison.compare(Axes(AggregatedScore(), {}, {}), without_halves, *data)
    with pytest.raises(InputError, match=r"split=first_half: .*queries .*got 0"):
        split(only_right=range(QUERIES))


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
    loss = jax.jit(teachable.objective(None))
    schedule, validate = Schedule(optax.adam(0.05), steps=40), lambda learned: float(loss(learned, taught))
    result = fit(teachable.start, teachable.objective(None), lambda _: taught, schedule, validate=validate)
    assert loss(result.parameters, other) < 0.85 * loss(teachable.start, other)
    learned = teachable.scorer_of(result.parameters)
    clear, doubtful = (
        jax.tree.map(lambda leaf: leaf[0, 0], replace(other.matches, ratio=np.full_like(other.matches.ratio, ratio)))
        for ratio in (0.4, 0.9)
    )
    weigh = jax.jit(LearnedWeight.__call__)
    assert np.all((weigh(learned.weight, clear) > 2 * weigh(learned.weight, doubtful))[:24])
