"""Precision, recall and calibration against explicit loops and closed forms."""

import itertools
import math

import numpy as np
import pytest

from mfvpr.evaluation import precision_recall, reliability
from mfvpr.evaluation.confidence import chance_calibration_error
from mfvpr.utils import InputError


def made_up(seed=0, queries=40):
    """Confidences with equal ones and some without a prediction, hits, and queries that have a prediction."""
    rng = np.random.default_rng(seed)
    confidence = rng.integers(0, 12, queries) / 11
    correct, has_positives = rng.random(queries) < confidence, rng.random(queries) < 0.9
    confidence[rng.random(queries) < 0.1] = np.nan
    return confidence, correct & has_positives & ~np.isnan(confidence), has_positives


@pytest.mark.parametrize("seed", range(4))
def test_curve_is_that_of_counting_answers_at_every_threshold(seed):
    confidence, correct, has_positives = made_up(seed)
    curve = precision_recall(confidence, correct, has_positives)
    thresholds = sorted({value for value in confidence.tolist() if not math.isnan(value)}, reverse=True)
    assert curve.thresholds.tolist() == thresholds
    area, before = 0.0, 0.0
    for threshold, precision, recall in zip(*curve, strict=True):
        answered = [query for query in range(40) if confidence[query] >= threshold]
        hits = sum(correct[query] for query in answered)
        assert precision == pytest.approx(hits / len(answered))
        assert recall == pytest.approx(hits / sum(has_positives))
        area, before = area + (recall - before) * precision, recall
    assert curve.average_precision == pytest.approx(area)
    for wanted in (1.0, 0.9, 0.5):
        reached = [recall for _, precision, recall in zip(*curve, strict=True) if precision >= wanted]
        assert curve.recall_at(wanted) == max(reached, default=0)


def test_all_queries_have_positives_by_default_and_perhaps_no_prediction():
    assert precision_recall(-np.arange(10.0), np.arange(10) < 6).recall_at(1.0) == 0.6
    for has_positives in (np.zeros(10, bool), None):
        none = precision_recall(np.full(10, np.nan), np.zeros(10, bool), has_positives)
        assert (none.average_precision, none.recall_at(0.5), len(none.thresholds)) == (0.0, 0.0, 0)


def test_correct_predictions_for_queries_without_positives_are_refused():
    correct = np.array([False, True])
    with pytest.raises(InputError, match="no correct predictions for queries without positives"):
        precision_recall(np.array([0.9, 0.8]), correct, ~correct)


@pytest.mark.parametrize("bins", [1, 4, 10])
def test_reliability_is_that_of_loops_over_bins(bins):
    confidence, correct, _ = made_up(5)
    curve = reliability(confidence, correct, bins=bins)
    error, total = 0.0, 0
    for number in range(bins):
        last = number == bins - 1
        inside = [query for query in range(40) if number / bins <= confidence[query] < (number + 1) / bins
                  or (last and confidence[query] == 1)]  # fmt: skip
        assert curve.count[number] == len(inside)
        if inside:
            mean, share = (sum(values[query] for query in inside) / len(inside) for values in (confidence, correct))
            assert curve.probability[number] == pytest.approx(mean)
            assert curve.correct[number] == pytest.approx(share)
            error, total = error + len(inside) * abs(mean - share), total + len(inside)
        else:
            assert np.isnan([curve.probability[number], curve.correct[number]]).all()
    assert curve.calibration_error == pytest.approx(error / total)


def test_calibration_error_by_chance_is_that_of_probabilities_that_are_true():
    """One bin of n fair coins, and all 2^n outcomes of a few predictions in several bins."""
    expected = sum(math.comb(100, heads) / 2**100 * abs(heads - 50) / 100 for heads in range(101))
    assert chance_calibration_error(np.full(100, 0.5)) == pytest.approx(expected, rel=1e-9)
    probability, expected = np.array([0.05, 0.07, 0.31, 0.35, 0.38, 0.9, 1.0]), 0.0
    for outcome in itertools.product([False, True], repeat=7):
        correct = np.array(outcome)
        expected += np.where(correct, probability, 1 - probability).prod() * (
            reliability(probability, correct).calibration_error
        )
    assert chance_calibration_error(np.append(probability, np.nan)) == pytest.approx(expected, rel=1e-9)
    assert np.isnan(chance_calibration_error(np.full(3, np.nan)))
    assert chance_calibration_error(np.array([0.0, 1.0, np.nan])) == 0
    assert np.isnan(reliability(np.full(3, np.nan), np.zeros(3, bool)).calibration_error)


@pytest.mark.parametrize("value", [5.0, np.inf, -np.inf])
@pytest.mark.parametrize("correct", [[True, False], [False, True]])
def test_equal_confidences_are_answered_together_however_large(value, correct):
    curve = precision_recall(np.array([value, value]), np.array(correct))
    assert (curve.precision.tolist(), curve.recall.tolist(), curve.average_precision) == ([0.5], [0.5], 0.25)
