"""A made-up city: what is measured is of the images that are asked for, and what follows from it is in closed form."""

import json

import numpy as np
import pytest

from experiments.benchmark import city
from experiments.benchmark.projection import Rates, forecast
from experiments.benchmark.synthetic_features import MadeUp
from mfvpr.storage.features import open_store
from mfvpr.storage.manifest import store_path

pytestmark = pytest.mark.slow

RATES = Rates(
    describing=0.5, comparing=1e-3, merging=1e-2, extracting=0.25, storing=0.125, reranking=2.0,
    vector_bytes=2048, row_bytes=1000,
)  # fmt: skip


def test_one_machine_takes_what_its_parts_take():
    plan = forecast(RATES, images=1000, queries=10, candidates=5, machines=1)
    assert plan.describing == 500
    assert plan.asking == 10 * 0.75
    assert (plan.filtering, plan.merging) == (pytest.approx(10), 0)
    assert plan.extracting == 50 * 0.375
    assert plan.reranking == 20
    assert plan.answering == pytest.approx(7.5 + 10 + 18.75 + 20)
    assert (plan.memory, plan.disk) == (2_048_000, 50_000)


def test_machines_divide_all_but_the_merging():
    one, four = (forecast(RATES, images=1000, queries=10, candidates=5, machines=count) for count in (1, 4))
    assert four.merging == pytest.approx(1e-2 * 10 * 5 * 4)
    assert four.filtering == pytest.approx(one.filtering / 4 + four.merging)
    assert four.answering == pytest.approx(one.answering / 4 + four.merging)
    for name in ("describing", "asking", "extracting", "reranking", "memory", "disk"):
        assert getattr(four, name) == pytest.approx(getattr(one, name) / 4)


def test_no_more_features_are_made_than_there_are_images():
    plan = forecast(RATES, images=30, queries=10, candidates=5, machines=1)
    assert plan.extracting == pytest.approx(30 * 0.375)
    assert plan.disk == 30 * 1000


def test_features_are_made_of_the_images_that_are_asked_for(tmp_path):
    data = MadeUp(300, 4, 30, 16, views=1)
    rows = np.unique([*range(0, 120, 2), *data.similar()[:, 0]])
    store, steps = city.make_features(data, tmp_path, rows)
    np.testing.assert_array_equal(np.flatnonzero(store.done), rows)
    assert len(list(tmp_path.rglob("*.npz"))) == len(rows)
    assert min(steps["making"].seconds, steps["storing"].seconds) > 0
    recipe = {"made_up": "city"} | vars(data)
    again = open_store(store_path(tmp_path, "city", recipe), recipe, num_images=300)
    for query, row in enumerate(data.similar()[:, 0].tolist()):
        [(_, features)] = again.read([row])
        np.testing.assert_array_equal(features.keypoints, data.image(row, query).keypoints)


def test_a_small_city_is_measured(tmp_path, monkeypatch, capsys):
    data = MadeUp(400, 6, 60, 16, views=1, likeness=0.12)
    monkeypatch.setattr(city, "DATA", data)
    monkeypatch.setattr(city, "CANDIDATES", 8)
    monkeypatch.setattr(city, "WHOLE", 1000)
    city.run(1, tmp_path / "out.json")
    content = json.loads((tmp_path / "out.json").read_text())
    asked, known = data.global_descriptors()
    candidates = np.argsort(-(asked @ known.T), axis=1)[:, :8]
    right = candidates == data.similar()
    found = content["found"]
    assert found["made"] == len(np.unique(candidates)) < 400
    assert found["rows_read"] == pytest.approx(found["made"], abs=1)
    assert found["recall"]["filter"] == pytest.approx(right[:, 0].mean())
    assert found["recall"]["shortlist"] == pytest.approx(right.any(axis=1).mean())
    assert found["recall"]["re-ranking"] <= found["recall"]["shortlist"]
    for step in found["steps"].values():
        assert step["seconds"] > 0
        assert step["peak"] > 0.05
    assert [(plan["features"], plan["machines"]) for plan in content["plans"]] == [
        (features, machines) for features in city.EXTRACTING for machines in city.MACHINES
    ]
    [first, *_] = content["plans"]
    assert first["memory"] == 1000 * 512 * 4
    assert first["disk"] == pytest.approx(1000 * found["written"] / found["made"])
    assert content["assumed"][-1] in capsys.readouterr().out
