"""shifts.csv of a run: which pairs it is of, and that it is what the library says of them."""

import csv

import jax
import numpy as np
import pytest

from experiments import evaluation, prepare
from mfvpr import HistogramOfShifts
from mfvpr.evaluations import Stopwatch
from mfvpr.report.shifts import HEADER
from tests.programs import composed, shared, small

STEERING = ("scorer=histogram", "scorer.bin_size=5", "scorer.sigma=10", "scorer.weight=ratio", "figures=0")


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return shared(tmp_path_factory)


def lines_of(file):
    with file.open(newline="") as opened:
        return [*csv.DictReader(opened)]


@pytest.mark.parametrize("final", ["score", "combined"])
def test_every_first_answer_has_the_shift_that_the_library_says(root, tmp_path, final):
    settings = composed(*small(root), *STEERING, f"final={final}", f"out={tmp_path}/out")
    evaluation.evaluate(settings)
    lines, first = lines_of(tmp_path / "out" / "shifts.csv"), {}
    for line in reversed(lines_of(tmp_path / "out" / "predictions.csv")):
        first[line["query"]] = line
    assert list(lines[0]) == list(HEADER)
    assert [(line["query"], line["answer"]) for line in lines] == [
        (line["query"], line["database"]) for line in reversed(first.values())
    ]
    tools, images = prepare.begun(settings, Stopwatch())
    matches, candidates = prepare.matched(settings, tools, images, Stopwatch())
    scorer = HistogramOfShifts(
        bin_size=5.0, sigma=10.0, weight=evaluation.build.scorers(settings["scorer"])["histogram"].weight
    )
    names = images.dataset.database.names
    for row, line in enumerate(lines):
        place = list(candidates.indices[row]).index(names.index(line["answer"]))
        pair = jax.tree.map(lambda leaf: leaf[place], matches[row])  # noqa: B023
        numbers = [float(line[name]) for name in HEADER[2:]]
        fitted = scorer.with_capacity(pair.image_size0, pair.image_size1)
        np.testing.assert_allclose(numbers[:2], fitted.dominant_shift(pair, refine=True), atol=0.02)
        np.testing.assert_allclose(np.reshape(numbers[2:], (2, 2)).T, fitted.shift_interval(pair), atol=0.02)


def test_only_a_histogram_has_one(root, tmp_path):
    evaluation.evaluate(composed(*small(root), "scorer=sum", "figures=0", f"out={tmp_path}/out"))
    assert not (tmp_path / "out" / "shifts.csv").exists()
