"""A half of the path to learn from: its candidates and matches, and images of several sizes."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from mfvpr import AggregatedScore, AnchorPoints, HistogramOfShifts, InputError, MatchCount, Runtime, score_candidates
from mfvpr.baselines.learned_weight import ABSOLUTE
from mfvpr.tuning.learning import comparison
from mfvpr.tuning.learning.comparison import Options, start
from mfvpr.tuning.learning.models import LOSSES, Model, cross_entropy, first_numbers, mean_loss
from mfvpr.tuning.sweeps import Axes
from tests.builders import random_matches, stack
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


def test_statistics_of_a_learned_weight_are_of_nothing_hidden():
    """Distances of hidden candidates, and of candidates of no account, are moved out of range: nothing changes."""

    def weight(at):
        return start(at, AggregatedScore(), OPTIONS, learned_weight=True).start["weight"]

    at = split()
    moved = []
    for query, flat in enumerate(at.match_set.matches):
        there = np.repeat(at.usable[query], at.match_set.counts[query]) & (query in at.train)
        moved.append(replace(flat, distance=np.where(there, flat.distance, np.float32(50))))
    far = replace(at, match_set=replace(at.match_set, matches=moved))
    jax.tree.map(np.testing.assert_array_equal, weight(far), weight(at))
    distances = np.concatenate([
        at.match_set.matches[query].distance[np.repeat(at.usable[query], at.match_set.counts[query])]
        for query in at.train[np.linspace(0, len(at.train) - 1, 4).astype(int)]
    ])  # fmt: skip
    assert weight(at).center[ABSOLUTE.index("distance")] == pytest.approx(distances.mean(), rel=1e-5)


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
    compared = comparison._HalfComparison(at, Axes(HISTOGRAM, {}, {}), OPTIONS, None, Runtime())
    np.testing.assert_array_equal(compared.evaluate("it", HISTOGRAM, {"c": c}).hits, np.transpose(expected))


def test_images_of_two_sizes_are_learned_from_as_one_by_one():
    """The loss of a batch is that of its queries' scores, which are finite."""
    at = split()
    model = start(at, HISTOGRAM, OPTIONS)
    batch = at.batch(at.train, len(at.train))
    loss = jax.jit(model.objective(LOSSES["cross_entropy"]))(model.start, batch)
    scores = np.stack([scores_of(model.scorer_of(model.start), at, query) for query in at.train])
    assert np.all(np.isfinite(scores))
    expected = mean_loss(cross_entropy, 2 * scores / model.unit, at.correct[at.train], at.usable[at.train])
    assert float(loss) == pytest.approx(float(expected), rel=1e-4)


def test_anchors_start_near_the_hard_score():
    matches = stack([random_matches(np.random.default_rng(seed), 200) for seed in range(10)])
    model = Model(AnchorPoints(), {"numbers": first_numbers(AnchorPoints(), 1.0)}, 1.0)
    soft = scores_of_one(model.scorer_of(model.start), matches)
    hard = scores_of_one(AnchorPoints(temperature=None), matches)
    assert np.median(np.abs(soft / hard - 1)) < 0.08


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_a_start_that_is_not_above_0_is_refused(value):
    with pytest.raises(InputError, match=r"^sigma=.*: .*above 0"):
        first_numbers(replace(HISTOGRAM, sigma=np.float32(value)), 1.0)


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
