"""Fusions as a user of the programs meets them: the systems of a run folder, and what can be swept of them."""

import json

import pytest

from mfvpr import HistogramOfShifts, RatioWeight
from mfvpr.cli import evaluation, sweeping
from mfvpr.systems import assembly
from tests.programs import settings_of, small

FUSED = ("scorer=ratio", "fusion.c=zscore", "fusion.weights={retrieval: 0.5, anchor: 1}")
SYSTEM = "histogram + anchor + retrieval"


@pytest.mark.slow
def test_a_run_ranks_by_what_is_fused(root, tmp_path):
    out = tmp_path / "out"
    more = ("final=combined", "previous_queries=1", "figures=1", f"out={out}")
    evaluation.evaluate(settings_of(*small(root), *FUSED, *more))
    rows = json.loads((out / "results.json").read_text())
    rows_by_system = {row["system"]: row for row in rows if row["tolerance"] == 1}
    assert [*rows_by_system] == ["retrieval", "anchor", "histogram", SYSTEM, f"{SYSTEM} + frames"]
    assert [row["scorer"] for row in rows_by_system.values()] == [
        "none", "anchor", "histogram", "histogram + anchor", "histogram + anchor",
    ]  # fmt: skip
    parameters = {name: row["parameters"] for name, row in rows_by_system.items()}
    assert parameters["anchor"]["weight"] == parameters["histogram"]["weight"] == "ratio"
    assert parameters[SYSTEM] == {
        "histogram": parameters["histogram"], "anchor": parameters["anchor"],
        "c": "zscore", "retrieval_score": "cosine", "weights": {"retrieval": 0.5, "anchor": 1},
    }  # fmt: skip
    assert parameters[f"{SYSTEM} + frames"] == parameters[SYSTEM] | {"previous": 1, "reach": 15.0, "gain": 0.4}
    decided = out / "predictions" / "histogram_anchor_retrieval.csv"
    assert (out / "predictions.csv").read_bytes() == decided.read_bytes()
    assert f"\n{SYSTEM}," in (out / "table.csv").read_text()


@pytest.mark.parametrize(("arguments", "features", "side"), [([], "aliked", 320), (["features=sift"], "sift", 336)])
def test_our_system_ranks_by_the_histogram_of_ratios(arguments, features, side):
    config = settings_of("system=mfvpr", *arguments)
    assert (config.features["name"], config.features["image_size"]) == (features, [side, side])
    rankings = assembly.rankings(config)
    assert rankings["scorers"] == {"histogram": HistogramOfShifts(weight=RatioWeight())}
    assert rankings["final"] == "histogram"
    config = settings_of("system=mfvpr", *arguments, "grid.sigma=[10]", config="sweep")
    assert sweeping.axes_of(config).grid() == [{"sigma": 10}]
