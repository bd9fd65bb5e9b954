"""Fusions and several weights as a user of the programs meets them: the systems of a run folder."""

import json

import pytest

import mfvpr
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


# --- several weights of one scorer: a ranking of each, from the same matches --------------------------------------


def evaluate(root, out, *more):
    """A run without figures: its folder."""
    evaluation.evaluate(settings_of(*small(root), "figures=0", f"out={out}", *more))
    return out


@pytest.mark.slow
def test_every_weight_ranks_as_in_a_run_of_its_own(root, tmp_path):
    together = evaluate(root, tmp_path / "both", "scorer=histogram", "scorer.weight=[ratio,fs]", "final=combined")
    systems = [row["system"] for row in json.loads((together / "results.json").read_text()) if row["tolerance"] == 1]
    assert systems == ["retrieval", "histogram_ratio", "histogram_fs", "histogram_ratio + retrieval"]
    decided = together / "predictions" / "histogram_ratio_retrieval.csv"
    assert (together / "predictions.csv").read_bytes() == decided.read_bytes()
    for weight in ("ratio", "fs"):
        alone = evaluate(root, tmp_path / weight, "scorer=histogram", f"scorer.weight={weight}")
        ranked = together / "predictions" / f"histogram_{weight}.csv"
        assert ranked.read_bytes() == (alone / "predictions" / "histogram.csv").read_bytes()


@pytest.mark.parametrize(("arguments", "names", "final"), [
    (["scorer=sum", "scorer.weight=[unit,dmf]"], ["sum_unit", "sum_dmf"], "sum_unit"),
    (["scorer=anchor", "scorer.weight=[ratio]"], ["anchor_ratio"], "anchor_ratio"),
    (["scorer=ratio", "scorer.histogram.weight=[ratio,fs]", "final=combined"],
     ["anchor", "histogram_ratio", "histogram_fs"], "histogram_ratio + retrieval"),
])  # fmt: skip
def test_the_first_weight_of_the_main_scorer_decides(arguments, names, final):
    rankings = assembly.rankings(settings_of(*arguments))
    assert ([*rankings["scorers"]], rankings["final"]) == (names, final)


@pytest.mark.slow
def test_a_run_is_loaded_and_mapped_with_all_of_its_weights(root, small_street, tmp_path, capsys):
    several = ("scorer=histogram_ratio", "scorer.weight=[ratio,fs]")
    run = evaluate(root, tmp_path / "run", *several)
    system = mfvpr.load_system(run / "run.json")
    assert [*system.scorers.items()] == [
        ("histogram_ratio", mfvpr.HistogramOfShifts(weight=mfvpr.RatioWeight())),
        ("histogram_fs", mfvpr.HistogramOfShifts()),
    ]
    evaluate(root, tmp_path / "again", *several, f"confidence={run}/confidence.json")
    assert "other settings" not in capsys.readouterr().err
    alone = mfvpr.load_system(evaluate(root, tmp_path / "alone", several[0]) / "run.json")
    maps = [mfvpr.Map.create(tmp_path / name, small_street / "database", each)
            for name, each in (("several", system), ("one", alone))]  # fmt: skip
    query = small_street / "queries/0003.png"
    assert mfvpr.Map.open(tmp_path / "several").localize(query) == maps[0].localize(query) == maps[1].localize(query)
