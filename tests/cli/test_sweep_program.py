"""`mfvpr sweep` as its users meet it: its numbers, its files, mistakes, and interruptions."""

import csv
import json
import subprocess
import sys
import time

import numpy as np
import pytest

from mfvpr.cli import evaluation, sweeping
from tests.programs import MFVPR, QUERIES, ROOT, job_of, settings_of, small

pytestmark = pytest.mark.thorough

SWEEP = sys.modules["mfvpr.tuning.sweeps"]


@pytest.fixture(scope="session")
def sweep(root):
    """Sweeps into a folder."""
    return job_of(root, "sweep", sweeping.sweep_program, (sweeping.searches, "sweep_figures"))


GRID = ("grid.sigma=[10,22.5]", "grid.weight=[fs,unit]", "grid.c=[0,2]", "fusion.c=2")


@pytest.fixture(scope="session")
def swept(sweep, tmp_path_factory):
    """The sweep that fills the store."""
    out = tmp_path_factory.mktemp("swept") / "out"
    return out, sweep(out, *GRID, pictures=True)


def recall_of(content, **parameters):
    [entry] = [entry for entry in content["settings"] if entry["parameters"] == parameters]
    return entry["recall_at"]


@pytest.mark.first_case
@pytest.mark.parametrize(("final", "c"), [("score", 0), ("combined", 2)])
def test_the_own_values_score_as_without_a_sweep(root, sweep, swept, tmp_path, final, c):
    content, out = sweep(tmp_path / "swept", *GRID, f"final={final}"), f"out={tmp_path}/evaluated"
    changes = ("figures=0", out, "scorer=histogram", GRID[-1], f"final={final}")
    evaluation.evaluate(settings_of(*small(root), *changes))
    rows = json.loads((tmp_path / "evaluated/results.json").read_text())
    assert content["own"] == {"sigma": 22.5, "weight": "fs", "c": c}
    deciding = {f"{row['tolerance']}": row["recall_at"] for row in rows if row["decides"]}
    assert recall_of(content, **content["own"]) == deciding


def test_every_file_tells_the_same(swept):
    out, content = swept
    with (out / "table.csv").open() as file:
        header, *lines = csv.reader(file)
    assert header == ["sigma", "weight", "c", "R@1 ±0", "R@1 ±1", "R@5 ±1"]
    assert len(lines) == len(content["settings"]) == 8
    for line, entry in zip(lines, content["settings"], strict=True):
        assert line[:3] == [f"{value}" for value in entry["parameters"].values()]
        recall = entry["recall_at"]
        expected = [recall["0"]["1"], recall["1"]["1"], recall["1"]["5"]]
        np.testing.assert_allclose([float(cell) / 100 for cell in line[3:]], expected, atol=6e-4)
    assert {"dataset", "data_fingerprint", "seconds", "versions"} <= {*content} | {"seconds"}
    assert (content["ground_truth"]["kind"], content["ground_truth"]["thresholds"]) == ("index", [0, 1])
    assert (content["unit"], content["thresholds"], content["ks"]) == ("frames", [0, 1], [1, 5])


def test_the_best_setting_is_chosen_and_told(swept):
    out, content = swept
    main = {tuple(entry["parameters"].values()): entry["recall_at"]["1"]["1"] for entry in content["settings"]}
    [chosen] = content["chosen"]
    assert main[tuple(chosen.values())] == max(main.values()) > min(main.values())
    for line in content["report"]:
        tolerance = f"{line['threshold']}"
        for name, setting in (("chosen", chosen), ("own", content["own"])):
            assert line[name]["recall"] == pytest.approx(recall_of(content, **setting)[tolerance]["1"], abs=1e-6)
        test = line["mcnemar"]
        gain = QUERIES * (line["chosen"]["recall"] - line["own"]["recall"])
        assert test["only_first"] - test["only_second"] == pytest.approx(gain)
    text = (out / "summary.txt").read_text()
    assert f"chosen: sigma = {chosen['sigma']:g}, weight = {chosen['weight']}, c = {chosen['c']}" in text
    assert "this flatters" in text


def test_where_the_combined_score_decides_every_setting_is_combined(sweep, swept, tmp_path):
    content = sweep(tmp_path / "final", "grid.sigma=[10]", "final=combined", "fusion.c=100")
    explicit = sweep(tmp_path / "given", "grid.sigma=[10]", "grid.c=[0,100]", "fusion.c=100")
    assert content["own"] == {"sigma": 22.5, "c": 100}
    combined, alone = (recall_of(explicit, sigma=10, c=c) for c in (100, 0))
    assert recall_of(content, sigma=10, c=100) == combined != alone


@pytest.mark.slow
def test_optuna_finds_the_same_with_the_same_seed(sweep, swept, tmp_path):
    def find(name, seed):
        space = ("search=optuna", "trials=5", "grid.sigma=[5,30]", "grid.weight=[fs,unit]")
        return sweep(tmp_path / name, *space, f"seed={seed}")

    first, again, other = find("first", 1), find("again", 1), find("other", 2)
    assert first == again
    tried = [entry["parameters"] for entry in first["settings"]]
    assert tried[0] == first["own"] == {"sigma": 22.5, "weight": "fs"}
    assert len(tried) == 6
    assert tried != [entry["parameters"] for entry in other["settings"]]


def test_bins_that_do_not_fit_are_refused(root, swept, tmp_path, refuse):
    arguments = ("search=optuna", "grid.bin_size=[0.1,5]", f"out={tmp_path}/out")
    assert "bin_size=0.1: expected at most 1024 bins" in refuse("sweep", *small(root), *arguments)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_ctrl_c_keeps_what_is_finished_and_the_next_run_does_the_rest(
    root, sweep, swept, tmp_path, monkeypatch, interrupt
):
    """The rows of finished settings are stored."""
    grid = ("grid.sigma=[5,10,15,20,22.5,30]", "chunk.settings=1", "chunk.queries=1")
    arguments = [*small(root), *grid, f"out={tmp_path}/out"]
    command = [*MFVPR, "sweep", *arguments]
    process = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True)
    store = root / "store"
    before = len(list(store.glob("sweep-*/*/[!.]*.npz")))
    while len(list(store.glob("sweep-*/*/[!.]*.npz"))) - before < 2:
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.01)
    interrupt(process)
    done, computed = list(store.glob("sweep-*/*/[!.]*.npz")), []
    assert 2 <= (finished := len(done) - before) < 6
    scores = SWEEP.pair_scores
    monkeypatch.setattr(SWEEP, "pair_scores", lambda *block: computed.append(1) or scores(*block))
    resumed = sweep(tmp_path / "out", *grid)
    assert len(computed) == (6 - finished) * QUERIES
    assert not list(store.glob("sweep-*/*/[!.]*.npz"))  # a finished sweep leaves none, which changed code could read
    assert resumed == sweep(tmp_path / "again", *grid[:1])
