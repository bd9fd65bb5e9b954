"""The benchmark of a synthetic city extracts shortlisted images alone, and its forecast has a closed form."""

import json

import numpy as np
import pytest

from experiments.benchmark import city
from experiments.benchmark.city import forecast
from experiments.benchmark.synthetic_features import SyntheticSet

pytestmark = pytest.mark.slow

RATES = dict(
    describing=0.5, comparing=1e-3, merging=1e-2, extracting=0.25, storing=0.125, reranking=2.0,
    vector_bytes=2048, row_bytes=1000,
)  # fmt: skip


def test_one_machine_takes_what_its_parts_take():
    plan = forecast(RATES, images=1000, queries=10, candidates=5, machines=1)
    expected = {"describing": 500, "asking": 7.5, "retrieving": 10, "merging": 0, "extracting": 50 * 0.375,
                "reranking": 20, "answering": 7.5 + 10 + 18.75 + 20, "memory": 2_048_000, "disk": 50_000}  # fmt: skip
    assert plan == pytest.approx(expected)


def test_machines_divide_all_but_the_merging():
    single, four = (forecast(RATES, images=1000, queries=10, candidates=5, machines=count) for count in (1, 4))
    assert four["merging"] == pytest.approx(1e-2 * 10 * 5 * 4)
    for name in ("describing", "asking", "extracting", "reranking", "memory", "disk"):
        assert four[name] == pytest.approx(single[name] / 4)
    for name in ("retrieving", "answering"):
        assert four[name] == pytest.approx(single[name] / 4 + four["merging"])


def test_no_more_features_are_made_than_there_are_images():
    plan = forecast(RATES, images=30, queries=10, candidates=5, machines=1)
    assert plan["extracting"] == pytest.approx(30 * 0.375)
    assert plan["disk"] == 30 * 1000


def test_features_are_made_of_the_images_that_are_asked_for(tmp_path):
    data = SyntheticSet(300, 4, 30, 16, views=1)
    rows = np.unique([*range(0, 120, 2), *data.similar()[:, 0]])
    store, steps = city.make_features(data, tmp_path, rows)
    np.testing.assert_array_equal(np.flatnonzero(store.done), rows)
    assert len(list(tmp_path.rglob("*.npz"))) == len(rows)
    assert min(steps["making"].seconds, steps["storing"].seconds) > 0
    again = data.open_store(tmp_path, "city", 300)
    for query, row in enumerate(data.similar()[:, 0].tolist()):
        [(_, features)] = again.read([row])
        np.testing.assert_array_equal(features.keypoints, data.image(row, query).keypoints)


def test_a_small_city_is_measured(tmp_path, monkeypatch, capsys):
    data = SyntheticSet(400, 6, 60, 16, views=1, likeness=0.12)
    monkeypatch.setattr(city, "DATA", data)
    monkeypatch.setattr(city, "CANDIDATES", 8)
    monkeypatch.setattr(city, "WHOLE", 1000)
    city.run(1, tmp_path / "out.json")
    content = json.loads((tmp_path / "out.json").read_text())
    queries, database = data.global_descriptors()
    candidates = np.argsort(-(queries @ database.T), axis=1)[:, :8]
    correct = candidates == data.similar()
    measured = content["found"]
    assert measured["made"] == len(np.unique(candidates)) < 400
    assert measured["rows_read"] == pytest.approx(measured["made"], abs=1)
    assert measured["recall"]["retrieval"] == pytest.approx(correct[:, 0].mean())
    assert measured["recall"]["shortlist"] == pytest.approx(correct.any(axis=1).mean())
    assert measured["recall"]["re-ranking"] <= measured["recall"]["shortlist"]
    for step in measured["steps"].values():
        assert step["seconds"] > 0
        assert step["peak"] > 0.05
    assert [(plan["features"], plan["machines"]) for plan in content["plans"]] == [
        (features, machines) for features in city.EXTRACTING for machines in city.MACHINES
    ]
    [first, *_] = content["plans"]
    assert first["memory"] == 1000 * 512 * 4
    assert first["disk"] == pytest.approx(1000 * measured["written"] / measured["made"])
    assert content["assumed"][-1] in capsys.readouterr().out
