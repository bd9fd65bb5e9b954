"""The benchmark of matchers: every score of both on the same shortlists, as an evaluation has them."""

import json

import pytest

from experiments.benchmark import matchers
from mfvpr import MatchCount, Matching
from mfvpr.checkpoints import load_model
from mfvpr.datasets import folder_dataset
from mfvpr.evaluation import evaluate
from mfvpr.features import Aggregated, AlikedFeatures, VladFitting
from mfvpr.retrieval import Retrieval
from tests import random_checkpoints

pytestmark = pytest.mark.slow

SMALL = {"SIZE": (96, 96), "KEYPOINTS": 30, "CANDIDATES": 3}


@pytest.mark.slow
@pytest.mark.skipif(not random_checkpoints.LIGHTGLUE.is_file(), reason="no ../shared/weights: LightGlue's do not ship")
def test_matchers_are_compared_on_the_same_shortlists(small_street, weights, tmp_path, monkeypatch, capsys):
    street = folder_dataset(small_street / "database", small_street / "queries", name="street", ground_truth="order")
    monkeypatch.setenv("MFVPR_WEIGHTS", str(weights))
    monkeypatch.setenv("MFVPR_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(matchers, "datasets", lambda _: [street])
    for name, value in SMALL.items():
        monkeypatch.setattr(matchers, name, value)
    matchers.run(1, tmp_path / "out.json")
    [(place, rows)] = json.loads((tmp_path / "out.json").read_text())["tables"].items()
    names = [("", "filter"), *((name, score) for name, scores in matchers.SCORERS.items() for score in scores)]
    assert (place, [(row["matcher"], row["score"]) for row in rows]) == ("street", names)
    assert all(row["matching_ms"] > 0 for row in rows[1:])
    recall = {(row["matcher"], row["score"]): row["recall"]["1"]["recall"] for row in rows}
    extractor = AlikedFeatures(load_model(matchers.NETWORK), image_size=(96, 96), max_keypoints=30)
    filter = Retrieval(Aggregated(extractor, VladFitting()))
    options = {"candidates": 3, "matching": Matching()}
    expected = evaluate(street, extractor, filter, {"count": MatchCount()}, **options).recall([1], [1])
    assert recall["mutual neighbors", "count"] == pytest.approx(expected["count"].pooled[0, 0])
    assert min(recall["mutual neighbors", "count"], recall["LightGlue", "count"]) > 0
    assert "LightGlue         sum of confidence" in capsys.readouterr().out
