"""shifts.csv of a run: its pairs, and that their shifts are those of the library."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from mfvpr import HistogramOfShifts
from mfvpr.cli import evaluation
from mfvpr.cli.jobs import prepare
from mfvpr.evaluation.stages import SHIFT_FLOOR, dominant_shifts
from mfvpr.matchers import MatchSet
from mfvpr.report.run_files import SHIFTS
from mfvpr.utils import Stopwatch
from tests.builders import make_matches, of_query
from tests.programs import csv_rows, settings_of, shared, small

pytestmark = pytest.mark.thorough

STEERING = ("scorer=histogram", "scorer.bin_size=5", "scorer.sigma=10", "scorer.weight=ratio", "figures=0")


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return shared(tmp_path_factory)


def test_every_first_answer_has_the_shift_that_the_library_says(root, tmp_path):
    settings = settings_of(*small(root), *STEERING, "final=combined", f"out={tmp_path}/out")
    evaluation.evaluate(settings)
    lines, first = csv_rows(tmp_path / "out" / "shifts.csv"), {}
    for line in reversed(csv_rows(tmp_path / "out" / "predictions.csv")):
        first[line["query"]] = line
    assert list(lines[0]) == ["query", "prediction", *SHIFTS]
    assert [(line["query"], line["prediction"]) for line in lines] == [
        (line["query"], line["database"]) for line in reversed(first.values())
    ]
    inputs = prepare(settings, Stopwatch())
    matches, candidates = inputs.match()
    weight = evaluation.assembly.scorers(settings.scorer)["histogram"].weight
    scorer = HistogramOfShifts(bin_size=5.0, sigma=10.0, weight=weight)
    names = inputs.dataset.database.names
    for row, line in enumerate(lines):
        place = list(candidates.indices[row]).index(names.index(line["prediction"]))
        pair = jax.tree.map(lambda leaf: leaf[place], matches[row])  # noqa: B023
        numbers = [float(line[name]) for name in SHIFTS]
        fitted = scorer.with_capacity(pair.image_size0, pair.image_size1)
        np.testing.assert_allclose(numbers[:2], fitted.dominant_shift(pair, refine=True), atol=0.02)
        low, high = np.asarray(fitted.shift_interval(pair), np.float64)
        half = np.hypot((high - low) / 2, SHIFT_FLOOR * 160)
        expected = [(low + high) / 2 - half, (low + high) / 2 + half]
        np.testing.assert_allclose(np.reshape(numbers[2:6], (2, 2)).T, expected, atol=0.02)
        assert numbers[6:] == [160, 120]


@pytest.mark.parametrize("direction", ["candidate_minus_query", "query_minus_candidate"])
def test_shifts_are_those_of_the_middle_of_the_query_in_either_direction(direction):
    """p1 = c1 + p0 - c0 + (17, -9), of images of two sizes; and NaN of a pair of which no match votes."""
    rng = np.random.default_rng(0)
    size0, size1 = np.array([320, 240]), np.array([400, 300])
    points0 = size0 / 2 + rng.uniform(-70, 70, (40, 2))
    points1 = size1 / 2 + points0 - size0 / 2 + [17, -9]
    pair = make_matches(points0, points1, sizes=(size0, size1))
    silent = replace(pair, scores0=np.zeros(40, np.float32), scores1=np.zeros(40, np.float32))
    matches, counts = of_query([pair, silent])
    match_set = MatchSet([matches], np.array([counts]), 40)
    scorer = HistogramOfShifts(bin_size=4.0, sigma=5.0, direction=direction)
    shifts, intervals, sizes = dominant_shifts(scorer, match_set, np.array([0, 0]), np.array([0, 1]))
    expected = size1 / 2 - size0 / 2 + [17, -9]
    np.testing.assert_allclose(shifts[0], expected, atol=0.01)
    assert (intervals[0, 0] < expected).all()
    assert (expected < intervals[0, 1]).all()
    assert (intervals[0, 1] - intervals[0, 0] >= 2 * SHIFT_FLOOR * 320).all()  # of the longer side, along both axes
    assert sizes[0].tolist() == [*size0]
    assert np.isnan([*shifts[1], *intervals[1].ravel()]).all()
