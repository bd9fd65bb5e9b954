"""What a half of the path may learn from: which candidates, which matches, and images of several sizes."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from experiments import lessons
from experiments.models import LOSSES, model
from mfvpr import AggregatedScore, AnchorPoints, HistogramOfShifts, score_candidates
from mfvpr.learning.losses import cross_entropy, mean_loss
from mfvpr.learning.match_weight import FEATURE_NAMES
from tests.builders import random_matches
from tests.learning.schools import QUERIES, SIZES, TOLERANCES, school


@pytest.mark.parametrize("half", [0, 1])
def test_candidates_are_right_wrong_or_of_no_account(half):
    """Right within the widest tolerance alone: neither positive nor negative. Reported places: not there at all."""
    at = school(half=half)
    lesson = at.lesson(at.learning, len(at.learning) + 2)
    reported = set(at.half.report.tolist())
    kinds = {"right": 0, "wrong": 0, "near": 0, "hidden": 0}
    for row, query in enumerate(at.learning):
        frames = dict(zip(at.candidates.scores[query].tolist(), at.candidates.indices[query].tolist(), strict=True))
        rows = zip(lesson.filter_scores[row].tolist(), lesson.positives[row].tolist(), lesson.mask[row], strict=True)
        taught = {frames[score]: positive for score, positive, real in rows if real}
        for frame in range(QUERIES):
            apart = abs(frame - query)
            if any(abs(frame - other) <= TOLERANCES[2] for other in reported):
                kind, expected = "hidden", None
            elif apart <= TOLERANCES[1]:
                kind, expected = "right", True
            elif apart <= TOLERANCES[2]:
                kind, expected = "near", None
            else:
                kind, expected = "wrong", False
            assert taught.get(frame) is expected
            kinds[kind] += 1
    assert min(kinds.values()) > 0
    assert not lesson.mask[len(at.learning) :].any()


def test_statistics_of_a_learned_weight_are_of_nothing_hidden():
    """Distances of hidden candidates, and of candidates of no account, are moved out of range: nothing changes."""

    def start(at):
        return lessons._start(at, "it", AggregatedScore(), fused=False, learned_weight=True).start["weight"]

    at = school()
    moved = []
    for query, flat in enumerate(at.matches.matches):
        there = np.repeat(at.usable[query], at.matches.counts[query]) & (query in at.learning)
        moved.append(replace(flat, distance=np.where(there, flat.distance, np.float32(50))))
    far = replace(at, matches=replace(at.matches, matches=moved))
    jax.tree.map(np.testing.assert_array_equal, start(far), start(at))
    distances = np.concatenate([
        at.matches.matches[query].distance[np.repeat(at.usable[query], at.matches.counts[query])]
        for query in at.learning[:4]
    ])  # fmt: skip
    assert start(at).center[FEATURE_NAMES.index("distance")] == pytest.approx(distances.mean(), rel=1e-5)


HISTOGRAM = HistogramOfShifts(bin_size=20.0, sigma=20.0)
scores_of_one = jax.jit(score_candidates)


def scores_of(scorer, at, query):
    """By the public function: every query with the sizes of its own images, and room for all bins."""
    return np.asarray(scores_of_one(replace(scorer, max_bins=2 * max(SIZES) // 20), at.matches[query]))


def test_images_of_two_sizes_are_reported_on_as_one_by_one():
    at, c = school(), 2.5
    expected = []
    for query in at.half.report:
        order = np.argsort(-(scores_of(HISTOGRAM, at, query) + c * at.candidates.scores[query]), kind="stable")
        expected.append([abs(at.candidates.indices[query][order[0]] - query) <= width for width in TOLERANCES])
    np.testing.assert_array_equal(lessons._reported(at, "it", HISTOGRAM, {"c": c}).hits, np.transpose(expected))


def test_images_of_two_sizes_are_learned_from_as_one_by_one():
    """The loss of a lesson is that of its queries' scores, which are finite."""
    at = school()
    start = lessons._start(at, "it", HISTOGRAM, fused=False, learned_weight=False)
    lesson = at.lesson(at.learning, len(at.learning))
    found = jax.jit(start.objective(LOSSES["cross_entropy"]))(start.start, lesson)
    scores = np.stack([scores_of(start.scorer_of(start.start), at, query) for query in at.learning])
    assert np.all(np.isfinite(scores))
    expected = mean_loss(cross_entropy, 2 * scores / start.unit, at.right[at.learning], at.usable[at.learning])
    assert float(found) == pytest.approx(float(expected), rel=1e-4)


def test_anchors_start_near_the_hard_score():
    matches = [random_matches(np.random.default_rng(seed), 200) for seed in range(10)]
    matches = jax.tree.map(lambda *leaves: np.stack(leaves), *matches)
    start = model("it", AnchorPoints(), 1.0, fused=None, weight=None)
    soft = scores_of_one(start.scorer_of(start.start), matches)
    hard = scores_of_one(AnchorPoints(temperature=None), matches)
    assert np.median(np.abs(soft / hard - 1)) < 0.08


def test_queries_without_a_wrong_candidate_teach_nothing_and_judge_nothing():
    """Their loss is 0 from the start: as a validation it would stop every training at once."""
    alone = range(0, QUERIES, 3)
    every, rest = school(), school(only_right=alone)
    for chosen, before in ((rest.learning, every.learning), (rest.validating, every.validating)):
        assert list(chosen) == [query for query in before if query not in alone]
        assert len(chosen) < len(before)
