"""Scorers of the host, which others write: what is wrong with them is said, and what they did is not kept."""

from dataclasses import replace

import numpy as np
import pytest

import mfvpr
from mfvpr import OpenCvHomography, score_candidates, score_grid
from mfvpr.evaluation import stages
from mfvpr.matching import MatchSet
from mfvpr.tuning import sweeps
from mfvpr.types import Shortlist, per_match
from mfvpr.utils import InputError
from tests.builders import make_matches
from tests.scoring.test_homography import plane_points, stacked

COUNTS = (60, 120, 20)
BATCH = stacked([make_matches(*plane_points(seed, count, 0.5), capacity=128) for seed, count in enumerate(COUNTS)])
LINES = {name: values[BATCH.mask] for name, values in per_match(BATCH).items()}
ROW = replace(BATCH, mask=np.ones(200, bool), image_size0=BATCH.image_size0[0], **LINES)
MATCHES = MatchSet.of([ROW], np.array([COUNTS]))
CANDIDATES = Shortlist(np.arange(3)[None], np.array([[0.3, 0.2, 0.1]], np.float32), np.ones((1, 3), bool))
SETTINGS = [{"max_distance": 9.0}]
WAYS = {
    "candidates": lambda scorer: score_candidates(scorer, BATCH),
    "grid": lambda scorer: score_grid(scorer, BATCH, max_distance=[9.0]),
    "pipeline": lambda scorer: stages.score({"own": scorer}, MATCHES, CANDIDATES),
    "sweep": lambda scorer: sweeps.sweep(scorer, SETTINGS, MATCHES, CANDIDATES),
}


@mfvpr.value
class Host:
    """Whatever a function says of the masks."""

    shift: float = 0.0

    def __call__(self, matches):
        return np.float32(0)

    def score_pairs(self, matches):
        return answer(np.asarray(matches.mask))


def answer(masks):
    return masks.sum(axis=1)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("wrong", [lambda _: 1.0, lambda _: np.ones(1), lambda masks: masks[:, :1]])
def test_a_number_for_each_pair_is_expected(monkeypatch, way, wrong):
    monkeypatch.setitem(globals(), "answer", wrong)
    with pytest.raises(InputError, match=r"Host\.score_pairs: .*\d+ pairs, got an array"):
        WAYS[way](Host())


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("wrong", [lambda masks: masks.sum(axis=1) * 1j, lambda masks: ["x"] * len(masks)])
def test_real_numbers_are_expected(monkeypatch, way, wrong):
    monkeypatch.setitem(globals(), "answer", wrong)
    with pytest.raises(InputError, match=r"Host\.score_pairs: .*real numbers.* got (complex|<U)"):
        WAYS[way](Host())


@pytest.mark.parametrize("way", WAYS)
def test_a_class_that_is_no_value_is_refused(way):
    class Plain(OpenCvHomography):
        pass

    with pytest.raises(InputError, match=r"Plain: .*score_pairs.*decorate"):
        WAYS[way](Plain())


def test_no_sweep_keeps_what_nobody_sees(monkeypatch, tmp_path):
    def first():
        return sweeps.sweep(Host(), SETTINGS, MATCHES, CANDIDATES, folder=tmp_path)[0, 0, 0, :3].tolist()

    assert first() == [1, 0, 2]
    monkeypatch.setitem(globals(), "answer", lambda masks: -masks.sum(axis=1))
    assert first() == [2, 0, 1]
