"""Several weights of one scorer in one run: a ranking of each, from the same matches."""

import json

import pytest

import mfvpr
from mfvpr.cli import evaluation
from mfvpr.systems import assembly
from tests.programs import settings_of, small

pytestmark = pytest.mark.slow


def evaluate(root, out, *more):
    """A run without figures: its folder."""
    evaluation.evaluate(settings_of(*small(root), "figures=0", f"out={out}", *more))
    return out


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


@pytest.mark.parametrize(("program", "arguments", "words"), [
    ("evaluate", ["scorer.histogram.weight=[]"], "scorer.histogram.weight=[]: expected "),
    ("evaluate", ["scorer.histogram.weight=[fs,heavy]"], "heavy']: expected "),
    ("evaluate", ["scorer.histogram.weight=[fs,fs]"], "expected every scorer once, got histogram_fs twice"),
    ("sweep", ["scorer=histogram", "scorer.weight=[fs,ratio]", "grid.weight=[unit]"], "scorer.weight: expected one "),
    ("learn", ["scorer=histogram", "scorer.weight=[fs,ratio]"], "scorer.weight: expected one weight"),
])  # fmt: skip
def test_weights_that_cannot_be_used(refuse_at_once, program, arguments, words):
    assert words in refuse_at_once(program, *arguments)
