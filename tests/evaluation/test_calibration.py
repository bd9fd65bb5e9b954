"""confidence of top predictions: its inputs against explicit loops, its fit, its file."""

import itertools
import math
import statistics
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import special

from mfvpr.datasets import Positives
from mfvpr.datasets.ground_truth import FrameTruth
from mfvpr.evaluation import (
    Ranked,
    confidence_inputs,
    fit_confidence,
    precision_recall,
    read_confidences,
    reliability,
    write_confidences,
)
from mfvpr.evaluation.calibration import absent_ranking
from mfvpr.evaluation.confidence import chance_calibration_error, confidence_from_json
from mfvpr.report.evaluations import EvaluationReport
from mfvpr.utils import InputError


def rank_by_scores(scores, rows):
    """Sorted, those without a candidate (-1) last, and three columns of padding."""
    scores = np.where(rows < 0, -np.inf, scores)
    order = np.argsort(-scores, axis=1, kind="stable")
    rows, scores = (np.take_along_axis(values, order, axis=1) for values in (rows, scores))
    padding = (0, 0), (0, 3)
    return Ranked(np.pad(rows, padding, constant_values=-1), np.pad(scores, padding, constant_values=np.nan))


@pytest.fixture(scope="module")
def ranking():
    """30 queries, 20 of 60 images; lists are short, empty, or of one place."""
    rng = np.random.default_rng(0)
    rows = np.argsort(rng.random((30, 60)), axis=1)[:, :20]
    rows[rng.random(rows.shape) < 0.1] = -1
    rows[3] = -1
    rows[4] = np.arange(20) // 5
    return rank_by_scores(rng.gamma(2.0, 5.0, (30, 20)), rows)


def test_inputs_are_those_of_loops_over_candidates(ranking):
    inputs = confidence_inputs(ranking)
    for query, (rows, scores) in enumerate(zip(ranking.rows.tolist(), ranking.scores.tolist(), strict=True)):
        if rows[0] < 0:
            assert np.isnan(inputs[query]).all()
            continue
        elsewhere = [score for row, score in zip(rows, scores, strict=True) if row >= 0 and abs(row - rows[0]) > 5]
        every = [score for row, score in zip(rows, scores, strict=True) if row >= 0]
        squares = sum((score - statistics.fmean(elsewhere)) ** 2 for score in elsewhere) if elsewhere else 0
        spread = math.sqrt((squares + 2 * statistics.pvariance(every)) / (len(elsewhere) + 2))
        margin = math.log(1 + (scores[0] - max(elsewhere)) / spread) if elsewhere else math.inf
        height = math.log(1 + (scores[0] - statistics.fmean(elsewhere)) / spread) if elsewhere else math.inf
        np.testing.assert_allclose(inputs[query], [margin, height], rtol=1e-9)
    assert np.isinf(inputs[4]).all()


@pytest.mark.parametrize(("tolerance", "around"), [(0, 5), (1, 5), (2, 10)])
def test_an_absent_place_is_five_times_as_far_as_a_correct_prediction_at_least_five_frames(tolerance, around):
    ranked = Ranked(np.arange(30)[None], -np.arange(30.0)[None])
    absent = absent_ranking(ranked, FrameTruth(((0,),), 30), tolerance)
    assert absent.rows[0, : 29 - around].tolist() == list(range(around + 1, 30))
    assert (absent.rows[0, 29 - around :] == -1).all()


def draw_answers(weights, bias, queries=4000, seed=1):
    rng = np.random.default_rng(seed)
    values = rng.gamma(2.0, 0.5, (queries, len(weights)))
    return values, rng.random(queries) < special.expit(values @ np.array(weights) + bias)


def test_the_model_that_answers_were_drawn_from_is_found():
    values, correct = draw_answers([2.0, 0.7], -1.5)
    model = fit_confidence(values, correct)
    weights = np.array(model.weights) / np.array(model.scale)
    np.testing.assert_allclose(weights, [2.0, 0.7], atol=0.25)
    assert model.bias - weights @ np.array(model.center) == pytest.approx(-1.5, abs=0.25)
    other, hits = draw_answers([2.0, 0.7], -1.5, seed=2)
    sure = model.probability(other) > 0.9
    assert np.mean(hits[sure]) == pytest.approx(np.mean(model.probability(other)[sure]), abs=0.03)


def test_a_surer_input_never_makes_an_answer_less_probable():
    values, correct = draw_answers([-2.0, 1.0], 0.0)
    weights = fit_confidence(values, correct).weights
    assert weights[0] == 0 < weights[1]


@pytest.mark.parametrize("correct", [True, False])
def test_where_all_answers_are_right_or_wrong_p_is_not_certain(correct):
    values, _ = draw_answers([1.0, 1.0], 0.0, queries=50)
    place = Ranked(np.arange(4)[None], np.array([[2.2, 2.1, 2.0, 1.9]]))  # no other: what is known of all predictions
    model = fit_confidence(values, np.arange(50) < 30)
    assert model(place)[0] == pytest.approx(special.expit(model.bias))
    probability = fit_confidence(np.vstack([values, [[np.nan, np.nan]]]), np.full(51, correct)).probability(values)
    probability = probability if correct else 1 - probability
    np.testing.assert_allclose(probability, 50.5 / 51, rtol=1e-3)
    with pytest.raises(InputError, match="expected predictions to fit it on"):
        fit_confidence(np.full((2, 2), np.nan), np.zeros(2, bool))


def test_what_is_written_is_read(ranking, tmp_path):
    values = confidence_inputs(ranking)
    model = fit_confidence(values, values[:, 0] > 0.3)
    assert np.isnan(model(ranking)).sum() == 1
    write_confidences(tmp_path / "confidence.json", {"histogram + retrieval": model}, {"dataset": "ä"})
    systems, recipe = read_confidences(tmp_path / "confidence.json")
    assert (systems, recipe) == ({"histogram + retrieval": model}, {"dataset": "ä"})
    np.testing.assert_array_equal(systems["histogram + retrieval"](ranking), model(ranking))


@pytest.mark.parametrize(
    "content", ["", "[]", '{"format": 3}', '{"format": "mfvpr confidence 3", "systems": {"h": {}}}']
)
def test_other_files_are_refused_in_one_line(content, tmp_path):
    path = tmp_path / "confidence.json"
    path.write_text(content)
    with pytest.raises(InputError, match=r"confidence.json: expected .*\(.*\); ") as refusal:
        read_confidences(path)
    assert "\n" not in str(refusal.value)
    with pytest.raises(InputError, match="got nothing"):
        read_confidences(tmp_path / "none.json")


MODEL = {"center": [0, 0], "scale": [1, 1], "weights": [0, 1], "bias": 0.5, "refusals": [0.2, 1]}


@pytest.mark.parametrize("change", [
    {"apart": 3}, {"apart": 6}, {"scale": [1, 0]}, {"weights": [0, -1]}, {"refusals": [0, 0.5]}, {"bias": math.inf},
    {"refusals": [0.2, 1.1]}, {"center": [0, math.nan]}, {"center": [0, 0, 0]}, {"scale": [1]}, {"bias": "1"},
])  # fmt: skip
def test_values_of_other_rows_or_versions_make_no_model(change):
    assert confidence_from_json(MODEL | {"apart": 5}).weights == (0, 1)
    with pytest.raises((TypeError, ValueError)):
        confidence_from_json(MODEL | change)


def test_halves_of_drives_there_and_back_share_no_place():
    """Two drives of 20 places, the second backward; a query shows the places beside it as well."""
    rows = [range(max(0, place - 1), min(20, place + 2)) for place in (*range(20), *reversed(range(20)))]
    rows[20:20], nowhere = [[], []], {20, 21, 42, 43}  # two queries at the end of each drive have no place
    rows += [[], []]
    places = [Positives.from_rows(list(map(list, drive)), 20) for drive in (rows[:22], rows[22:])]
    sequences = [SimpleNamespace(truth=SimpleNamespace(shows_place=lambda _, drive=drive: drive, unit="frames"))
                 for drive in places]  # fmt: skip
    ranked: Any = SimpleNamespace(dataset=SimpleNamespace(sequences=sequences))
    reported = []
    for half in EvaluationReport(ranked, [1], [1]).path_halves():
        places = [{place for row in part for place in rows[row]} for part in (half.tune, half.report)]
        assert not places[0] & places[1]
        assert min(map(len, places)) >= 9
        reported.extend(half.report)
        assert sum(query in nowhere for query in half.report) == 2
    assert sorted(reported) == list(range(44))


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


def test_equal_confidences_are_answered_together_and_all_queries_have_positives_by_default():
    curve = precision_recall(np.array([np.inf, np.inf]), np.array([False, True]))
    assert (curve.precision.tolist(), curve.recall.tolist(), curve.average_precision) == ([0.5], [0.5], 0.25)
    assert precision_recall(-np.arange(10.0), np.arange(10) < 6).recall_at(1.0) == 0.6
    for has_positives in (np.zeros(10, bool), None):
        none = precision_recall(np.full(10, np.nan), np.zeros(10, bool), has_positives)
        assert (none.average_precision, none.recall_at(0.5), len(none.thresholds)) == (0.0, 0.0, 0)


def test_correct_predictions_for_queries_without_positives_are_refused():
    correct = np.array([False, True])
    with pytest.raises(InputError, match="no correct predictions for queries without positives"):
        precision_recall(np.array([0.9, 0.8]), correct, ~correct)


def test_reliability_is_that_of_loops_over_bins():
    confidence, correct, _ = made_up(5)
    curve, error, total = reliability(confidence, correct), 0.0, 0
    for number in range(10):
        inside = [
            query for query in range(40) if number == min(math.floor(10 * np.nan_to_num(confidence[query], nan=-1)), 9)
        ]
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
