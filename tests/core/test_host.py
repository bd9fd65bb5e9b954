"""Scorers of users that run on the host: errors, and sweeps that do not store their scores."""

from dataclasses import replace

import numpy as np
import pytest

import mfvpr
from mfvpr import OpenCvHomography, score_candidates, score_grid
from mfvpr.core.types import Shortlist, per_match
from mfvpr.evaluation import stages
from mfvpr.matchers import MatchSet
from mfvpr.tuning import sweeps
from mfvpr.utils import InputError
from tests.baselines.test_homography import plane_points
from tests.builders import make_matches, stack

COUNTS = (60, 120, 20)
POINTS = [plane_points(seed, *case) for seed, case in enumerate(zip(COUNTS, (0.5, 0.2, 0.8), strict=True))]
PAIRS = [make_matches(points0, points1, capacity=128, index0=np.arange(len(points0))) for points1, points0 in POINTS]
BATCH = stack(PAIRS)
LINES = {name: values[BATCH.mask] for name, values in per_match(BATCH).items()}
ROW = replace(BATCH, mask=np.ones(200, bool), image_size0=BATCH.image_size0[0], **LINES)
MATCHES = MatchSet.of([ROW], np.array([COUNTS]))
CANDIDATES = Shortlist(np.arange(3)[None], np.array([[0.3, 0.2, 0.1]], np.float32), np.ones((1, 3), bool))
SETTINGS = [{"max_distance": 9.0}]
WAYS = {
    "candidates": lambda scorer: score_candidates(scorer, BATCH),
    "grid": lambda scorer: score_grid(scorer, BATCH, max_distance=[9.0]),
    "pipeline": lambda scorer: stages.score({"own": scorer}, MATCHES, CANDIDATES),
    "sweep": lambda scorer: sweeps.rank_settings(scorer, SETTINGS, MATCHES, CANDIDATES),
}


@mfvpr.value
class Host:
    """Scores by `answer` from the masks."""

    shift: float = 0.0

    def __call__(self, matches):
        return np.float32(0)

    def score_pairs(self, matches):
        return answer(np.asarray(matches.mask))


def answer(masks):
    return masks.sum(axis=1)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (lambda _: 1.0, r"\d+ pairs, got an array"),
        (lambda _: np.ones(1), r"\d+ pairs, got an array"),
        (lambda masks: masks[:, :1], r"\d+ pairs, got an array"),
        (lambda masks: masks.sum(axis=1) * 1j, "real numbers.* got complex"),
        (lambda masks: ["x"] * len(masks), "real numbers.* got <U"),
    ],
)
def test_a_real_number_for_each_pair_is_expected(monkeypatch, way, wrong, words):
    monkeypatch.setitem(globals(), "answer", wrong)
    with pytest.raises(InputError, match=rf"Host\.score_pairs: .*{words}"):
        WAYS[way](Host())


@pytest.mark.parametrize("way", WAYS)
def test_a_class_that_is_no_value_raises(way):
    class Plain(OpenCvHomography):
        pass

    with pytest.raises(InputError, match=r"Plain: .*score_pairs.*decorate"):
        WAYS[way](Plain())
