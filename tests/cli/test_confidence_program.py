"""Confidence of predictions in the run folder: curves, refused queries, re-ranking of uncertain queries."""

import json
from pathlib import Path

import numpy as np
import pytest

from mfvpr.evaluation import precision_recall, read_confidences, reliability
from tests.programs import QUERIES, csv_rows, small

pytestmark = pytest.mark.slow

SYSTEMS = ("retrieval", "histogram", "histogram + retrieval")
LINES = ("scorer=histogram", "figures=0")


@pytest.fixture
def evaluate(root, tmp_path, succeed):
    """Evaluates into a folder of this name: the folder, stderr, stdout."""

    def run(name, *more):
        stdout, stderr = succeed("evaluate", *small(root), *LINES, f"out={tmp_path}/{name}", *more)
        return tmp_path / name, stderr, stdout

    return run


@pytest.fixture
def confidence(evaluate):
    return evaluate("first")[0] / "confidence.json"


def test_a_run_says_how_sure_its_answers_are(evaluate):
    out, _, stdout = evaluate("first")
    assert "ECE" not in stdout  # said in files, until it is asked for
    gains, top = csv_rows(out / "gains.csv"), csv_rows(out / "top_predictions.csv")
    hits = {system: np.array([line[system] == "1" for line in gains]) for system in SYSTEMS}
    first = [line for line in csv_rows(out / "predictions.csv") if line["rank"] == "1"]
    assert [[line[name] for name in ("query", "prediction", "score", "correct")] for line in top] == [
        [line[name] for name in ("query", "database", "score", "correct")] for line in first
    ]
    probability = np.array([float(line["confidence"]) for line in top])
    assert len(np.unique(probability)) > QUERIES / 2
    table = {line["system"]: line for line in csv_rows(out / "confidence.csv")}
    assert tuple(table) == SYSTEMS
    curves = csv_rows(out / "precision_recall.csv")
    curve = precision_recall(np.array([float(line["score"]) for line in top]), hits["histogram"])
    written = [line for line in curves if (line["system"], line["by"]) == ("histogram", "score")]
    points = [[float(line[name]) for line in written] for name in ("threshold", "precision", "recall")]
    np.testing.assert_allclose(points, curve, rtol=1e-6)
    assert table["histogram"]["AP by score"] == f"{100 * curve.average_precision:.1f}"
    assert table["histogram"]["R@100P by score"] == f"{100 * curve.recall_at(1):.1f}"
    error = reliability(probability, hits["histogram"]).calibration_error
    assert table["histogram"]["ECE"] == f"{100 * error:.1f}"
    absent = np.array([float(line["absent_confidence"] or "nan") for line in top])
    both = np.concatenate([probability, absent]), np.append(hits["histogram"], np.zeros(len(absent), bool))
    assert table["histogram"]["ECE with absent"] == f"{100 * reliability(*both).calibration_error:.1f}"
    [*_, origin] = read_confidences(out / "confidence.json")
    assert 0 < origin["absent_queries"] <= np.isfinite(absent).sum()


def test_below_the_threshold_the_answer_is_no_place(evaluate, confidence):
    systems, origin = read_confidences(confidence)
    assert (tuple(systems), origin["queries"], origin["correct_within"]) == (SYSTEMS, QUERIES, [1, "frames"])
    first = csv_rows(confidence.parent / "top_predictions.csv")
    least = np.median([float(line["confidence"]) for line in first])
    threshold = (f"confidence={confidence}", f"threshold={least}")
    out, stderr, _ = evaluate("second", *threshold)
    assert "was fitted on these very images" in stderr
    assert "other settings" not in stderr
    top = csv_rows(out / "top_predictions.csv")
    probability, score = (np.array([float(line[name]) for line in top]) for name in ("confidence", "score"))
    lacks = np.array([line["reason"] not in ("", "low confidence") for line in top])
    refused = (probability < least) | lacks
    names = [line["prediction"] for line in first]
    assert score[~refused].mean() > score[refused].mean()
    assert [line["prediction"] == "no place" for line in top] == refused.tolist()
    assert lacks.sum() < QUERIES / 2  # small images at night: they score no better than noise
    reasons = [line["reason"] for line in top if line["reason"] != "no better than noise"]
    assert reasons == np.where(refused, "low confidence", "")[~lacks].tolist()
    assert [line["refused"] for line in top] == np.where(refused, names, "").tolist()
    outcome = {"": "refused", "0": "incorrect", "1": "correct"}
    assert [line["outcome"] for line in top] == [
        outcome[line["correct"] * (line["prediction"] != "no place")] for line in top
    ]
    correct = np.array([line["histogram"] == "1" for line in csv_rows(out / "gains.csv")])
    assert [line["correct"] for line in top] == correct.astype(int).astype(str).tolist()
    line = next(line for line in csv_rows(out / "confidence.csv") if line["system"] == "histogram")
    counts = [int(line[name]) for name in ("correct", "incorrect", "refused", "of these correct")]
    assert counts == [(correct & ~refused).sum(), (~correct & ~refused).sum(), refused.sum(), (correct & refused).sum()]
    predictions = csv_rows(out / "predictions.csv")
    none = [line for line in predictions if line["database"] == "no place"]
    shifted = [(line["query"], line["prediction"]) for line in csv_rows(out / "shifts.csv")]
    assert shifted == [(line["query"], line["prediction"]) for line in top if line["prediction"] != "no place"]
    refusing = {line["query"] for line in none}
    assert refusing == {line["query"] for line in top if line["prediction"] == "no place"}
    rest = [line for line in csv_rows(out / "predictions" / "histogram.csv") if line["query"] not in refusing]
    assert [line for line in predictions if line not in none] == rest
    unknown, *_ = evaluate("third", *threshold, "dataset.ground_truth=none", "dataset.index_file=null")
    unknown_values = {"correct": "", "in_database": "", "absent_confidence": ""}
    expected = [{**line, **unknown_values, "outcome": line["outcome"] * (line["reason"] != "")} for line in top]
    assert csv_rows(unknown / "top_predictions.csv") == expected
    assert not (unknown / "confidence.csv").exists()


def test_no_place_is_right_where_the_database_does_not_show_it(evaluate, confidence, root, tmp_path):
    """Ground truth without the first query's place: it is a negative, and its refusal is correct."""
    index = next(setting for setting in small(root) if setting.startswith("dataset.index_file=")).partition("=")[2]
    header, line, *lines = Path(index).read_text().splitlines()
    (tmp_path / "index.csv").write_text("\n".join([header, f"{line.partition(',')[0]},", *lines]))
    index = f"dataset.index_file={tmp_path}/index.csv"
    out, *_ = evaluate("second", f"confidence={confidence}", "threshold=1", index)
    predictions = csv_rows(out / "top_predictions.csv")
    assert {line["prediction"] for line in predictions} == {"no place"}
    assert [line["in_database"] for line in predictions] == ["0"] + ["1"] * (QUERIES - 1)
    hits = [str(int(line["histogram"] == "1")) for line in csv_rows(out / "gains.csv")]
    assert [line["correct"] for line in predictions] == hits
    assert hits[0] == "0"


def test_confidence_of_other_settings_is_said(evaluate, confidence):
    _, stderr, _ = evaluate("second", f"confidence={confidence}", "scorer.weight=ratio", "fusion.c=2")
    assert "other settings of scorer, fusion:" in stderr
    for changed, words in (("recall.tolerances=[0]", "recall"), ("candidates=5", "candidates")):
        _, stderr, _ = evaluate(words, f"confidence={confidence}", changed)
        assert f"other settings of {words}" in stderr
    out, stderr, _ = evaluate("third", f"confidence={confidence}", "scorer=paper")
    assert "other settings" not in stderr  # the histogram is the same beside others
    assert "sum" not in {line["system"] for line in csv_rows(out / "confidence.csv")}
    fused = ("scorer=ratio", "fusion.c=zscore", "fusion.weights={anchor: 1}", "final=combined")
    other, *_ = evaluate("fused", *fused)
    for window, warns in ((6, True), (10, False)):
        changed = f"scorer.anchor.window={window}"
        _, stderr, _ = evaluate(f"window_{window}", f"confidence={other}/confidence.json", *fused, changed)
        assert ("other settings of scorer:" in stderr) == warns


def test_a_file_tells_what_it_was_fitted_on(evaluate, confidence, refuse, root, tmp_path):
    """The queries tell, whatever the folder is called; the database alone may be the same."""
    content = json.loads(confidence.read_text())
    seen, other = content["made"]["data_fingerprint"], tmp_path / "other.json"
    [queries] = [folder for key, folder in seen.items() if key != "database"]
    for number, (fingerprint, absent) in enumerate([
        ({"database": "other", "query fwd": queries}, 0), ({"database": seen["database"], "query": "other"}, 5),
    ]):  # fmt: skip
        made = content["made"] | {"data_fingerprint": fingerprint, "absent_queries": absent}
        other.write_text(json.dumps(content | {"made": made}))
        _, stderr, _ = evaluate(f"{number}", f"confidence={other}")
        assert ("was fitted on these very images" in stderr) == (number == 0)
        assert ("was fitted without absent places" in stderr) == (absent == 0)
    del content["systems"]["histogram"]
    other.write_text(json.dumps(content))
    error = refuse("evaluate", *small(root), *LINES, f"confidence={other}", f"out={tmp_path}/out")
    assert "got retrieval, histogram + retrieval" in error
