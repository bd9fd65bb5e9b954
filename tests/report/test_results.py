"""Results in Python: tables, predictions, run folders and pages of several data sets and systems."""

import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import mfvpr
from mfvpr import datasets
from mfvpr.datasets import IndexFile
from mfvpr.datasets.ground_truth import RADIUS, TOLERANCES
from mfvpr.evaluation import Fusion
from mfvpr.evaluation.dataset_ranking import KS
from mfvpr.features import Aggregated, Sift, VladFitting
from mfvpr.report.pages import Run
from mfvpr.retrieval import Retrieval
from mfvpr.utils import InputError
from tests.programs import composed

pytestmark = pytest.mark.thorough

SIFT = Sift(max_keypoints=60, image_size=(160, 120))


def half_count(matches):
    """A scorer without recipe."""
    return mfvpr.MatchCount()(matches) / 2


@pytest.fixture(scope="module")
def systems():
    pipeline = mfvpr.Pipeline(SIFT, Retrieval(Aggregated(SIFT, VladFitting(num_words=8))), candidates=5)
    paper = mfvpr.System(pipeline, {"histogram": mfvpr.HistogramOfShifts(), "my + count": half_count})
    return {"paper": paper, "mine": replace(paper, fused={"my + count": Fusion()}, final="my + count + retrieval")}


@pytest.fixture(scope="module")
def result(dataset, small_street, split, systems):
    truth = IndexFile("truth.csv", is_widened=True)
    data = {"one": dataset, "two": datasets.folder(small_street / "database", split, ground_truth=truth)}
    return mfvpr.evaluate(data, systems)


def test_one_result_has_all_data_sets_and_systems(result, dataset, systems):
    table = result.table([1, 0], [1, 5])
    assert table.header == ["data set", "system", "sequence", "R@1 ±0", "R@1 ±1", "R@5 ±1"]
    parts = ["first", "second", "mean", "pooled"]
    expected = [("one", system, "") for system in systems] + [("two", system, p) for system in systems for p in parts]
    assert [tuple(row[:3]) for row in table.rows] == expected
    assert table.rows[0][3:] == table.rows[5][3:]  # the sequences are the parts of the one
    assert result.to_latex([0], [1]).count(" \\\\\n") == 11
    alone = mfvpr.evaluate(dataset, systems["mine"]).table([0, 1], [1, 5])
    assert [row[0] for row in alone.rows] == ["retrieval", "histogram", "my + count", "my + count + retrieval"]
    assert alone.rows[-1][1:] == table.rows[1][3:]
    assert repr(result) == "Result(one, two; paper, mine)"
    with pytest.raises(InputError, match=r"expected one data set .* got 4"):
        result.only  # noqa: B018


def test_predictions_are_written_with_full_paths_and_correct_images(result, dataset, systems, tmp_path):
    alone = replace(result, parts={("one", "paper"): result.parts["one", "paper"]})
    alone.write_predictions(tmp_path / "preds")
    alone.write_predictions(tmp_path / "pairs.txt", layout="hloc")
    rows = result.parts["one", "paper"].systems["histogram"][0].rows
    queries, database = dataset.queries, dataset.database
    lines = (tmp_path / "preds" / "004.txt").read_text().split("\n\n")
    correct = dataset.truth.positives(2).of(4)
    headings = ("Query path:", "Predictions paths:", "Positives paths:")
    expected = [[str(queries.paths[4])], *([str(database.paths[row]) for row in part] for part in (rows[4], correct))]
    assert lines == ["\n".join([heading, *part]) for heading, part in zip(headings, expected, strict=True)] + [""]
    pairs = [f"{query} {database.names[row]}" for query, part in zip(queries.names, rows, strict=True) for row in part]
    assert (tmp_path / "pairs.txt").read_text().splitlines() == pairs
    parts = replace(result, parts={("two", "paper"): result.parts["two", "paper"]})
    parts.write_predictions(tmp_path / "parts")
    assert {path.name for path in (tmp_path / "parts").iterdir()} == {"first", "second"}
    with pytest.raises(InputError, match="expected one data set"):
        result.write_predictions(tmp_path / "all")


def test_predictions_are_those_of_the_score_that_decides(result, dataset):
    predictions = [each for each in result.predictions if (each.dataset, each.system) == ("two", "mine")]
    assert len(result.predictions) == 4 * len(predictions) == 4 * len(dataset.queries)
    [ranked] = result.parts["one", "mine"].systems["my + count + retrieval"]
    names = np.array(dataset.database.names)[ranked.rows[:, 0]]
    assert [each.prediction for each in predictions] == names.tolist()
    assert [each.query for each in predictions] == [*dataset.queries.names]
    np.testing.assert_array_equal([each.score for each in predictions], ranked.scores[:, 0])
    correct = dataset.truth.positives(2).contains(ranked.rows)[:, 0]
    assert [each.is_correct for each in predictions] == correct.tolist()
    unknown = replace(dataset, sequences=(replace(dataset.only, truth=None),))
    [first, *_] = mfvpr.Result({("a", "b"): replace(result.parts["one", "mine"], dataset=unknown)}, None).predictions
    assert (first.prediction, first.is_correct) == (names[0], None)


def test_a_saved_result_is_a_run_folder(result, dataset, tmp_path):
    folders = result.save(tmp_path / "all")
    assert folders[1] == tmp_path / "all" / "one" / "mine"
    run = Run(folders[1])
    assert (run.headline, run.thresholds) == ("my + count + retrieval", [1, 2, 5])
    assert [row["scorer"] for row in run.results[::3]] == ["none", "histogram", "my + count", "my + count"]
    expected = {"name": "half_count", "c": None, "retrieval_score": "cosine", "weights": {}}
    assert run.results[-1]["parameters"] == expected
    assert (tmp_path / "all" / "table.csv").read_text() == result.table().csv()
    with pytest.raises(InputError, match="expected a new or empty run folder"):
        result.save(tmp_path / "all")
    result.write_report(tmp_path / "all.html")
    assert "one/mine" in (tmp_path / "all.html").read_text("utf-8")
    mfvpr.Result({("one", "mine"): result.parts["one", "mine"]}, result.cache).write_report(tmp_path / "one.html")
    assert "queries worth one" in (tmp_path / "one.html").read_text("utf-8")


def test_frames_have_a_row_for_each_ranking_and_sequence(result, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(DataFrame=list))
    rows = result.to_pandas([1], [1, 5])
    assert len(rows) == (3 + 4) * 5  # rankings of both systems; a sequence, or two with their means
    last = rows[-1]
    assert list(last) == ["data set", "system", "score", "decides", "sequence", "tolerance", "R@1", "R@5"]
    recall = result.parts["two", "mine"].recall([1], [1, 5])["my + count + retrieval"]
    np.testing.assert_allclose([last["R@1"], last["R@5"]], recall.pooled[0])


def test_defaults_are_those_of_the_programs():
    assert composed()["recall"] == {"tolerances": [*TOLERANCES], "radius": RADIUS, "ks": [*KS]}


def test_data_sets_without_ground_truth_have_predictions_alone(result, dataset, tmp_path):
    without = replace(dataset, name="dark", sequences=(replace(dataset.only, truth=None),))
    dark = replace(result.parts["one", "paper"], dataset=without)
    both = replace(result, parts={("dark", "paper"): dark, ("one", "paper"): result.parts["one", "paper"]})
    assert {row[0] for row in both.table().rows} == {"one"}
    assert len(both.save(tmp_path / "both")) == 2
    with pytest.raises(InputError, match="no ground truth, so no recall"):
        replace(result, parts={("dark", "paper"): dark}).table()
