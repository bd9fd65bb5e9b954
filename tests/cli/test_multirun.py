"""Hydra's multirun: many jobs, one after the other or at the same time."""

import os
import threading

import pytest

from mfvpr.cli import console
from mfvpr.storage import matches as match_store
from tests.programs import CANDIDATES, QUERIES, composed, csv_rows, matches_path, results, run, small

pytestmark = pytest.mark.thorough

SIGMA = "grid.sigma=[10]"


def test_a_multirun_makes_one_run_folder_per_job(root, tmp_path, monkeypatch, call, succeed):
    monkeypatch.chdir(tmp_path)
    jobs = ("experiment=weight", "scorer=sum,histogram", "candidates=8,0")
    code, stdout, stderr = call("sweep", "-m", *small(root), *jobs)
    assert code == 2
    folders = sorted((tmp_path / "runs" / "folder").iterdir())
    assert [f"results: {path.relative_to(tmp_path)}" in stdout for path in folders] == [True, True]
    assert {results(path)["scorer"]["method"] for path in folders} == {"sum", "histogram"}
    assert stderr.splitlines()[-1].startswith("error: candidates=0: expected ")
    assert "Traceback" not in stderr
    assert [number for number in range(4) if f"job {number}: " in stderr] == [0, 1, 2, 3]
    [joint] = (tmp_path / "runs" / "multirun").iterdir()
    lines = csv_rows(joint / "table.csv")
    assert [(line["job"], line["scorer"]) for line in lines] == [("0", "sum"), ("2", "histogram")]
    for line in lines:
        content = results(tmp_path / line["run"])
        assert line["system"] == content["scorer"]["method"] == line["scorer"]
        for verdict in content["report"]:
            assert float(line[f"R@1 ±{verdict['threshold']}"]) == round(100 * verdict["chosen"]["recall"], 1)
    assert (joint / "table.md").exists()
    stdout, _ = succeed("report", joint)
    assert lines[0]["run"] in (joint / "report.html").read_text()


def test_a_joint_table_has_a_line_per_job_and_system(root, tmp_path, monkeypatch, succeed):
    monkeypatch.chdir(tmp_path)
    succeed("evaluate", "-m", *small(root), "figures=0", "scorer=sum", "candidates=4,8")
    [joint] = (tmp_path / "runs" / "multirun").iterdir()
    lines = csv_rows(joint / "table.csv")
    assert [line["candidates"] for line in lines] == ["4", "4", "4", "8", "8", "8"]
    for number in (0, 3):
        assert [line["system"] for line in lines[number : number + 3]] == ["retrieval", "sum", "sum + retrieval"]
        names = [name for name in lines[number] if name.startswith("R@")]
        rows = csv_rows(tmp_path / lines[number]["run"] / "table.csv")
        assert [[row[name] for name in names] for row in rows] == [
            [line[name] for name in names] for line in lines[number : number + 3]
        ]


@pytest.mark.slow
def test_weights_of_every_score_are_one_command(root, tmp_path, monkeypatch, succeed):
    monkeypatch.chdir(tmp_path)
    stdout, _ = succeed("sweep", "-m", *small(root), "experiment=weight", "grid.weight=[fs,unit]")
    assert [f"settings of the {name} score" in stdout for name in ("sum", "anchor", "histogram")] == [True] * 3


def test_a_job_waits_for_the_matches_of_another_and_a_single_run_does_not(root, tmp_path, monkeypatch, succeed, call):
    overrides = *small(root), SIGMA
    settings = composed(*overrides, config="sweep")
    path, recipe = matches_path(settings)
    succeed("sweep", *overrides, f"out={tmp_path}/first")
    with match_store.open_match_store(path, recipe, num_queries=QUERIES, num_candidates=CANDIDATES) as complete:
        assert complete.done.all()  # so others read it at the same time
        succeed("sweep", *overrides, f"out={tmp_path}/second")
    next(path.glob("3-*.npz")).unlink()
    taken, announced = threading.Event(), threading.Event()

    def another():
        with match_store.open_match_store(path, recipe, num_queries=QUERIES, num_candidates=CANDIDATES):
            taken.set()
            announced.wait(timeout=60)

    other, tell = threading.Thread(target=another), console.tell
    monkeypatch.setattr(console, "tell", lambda text: (tell(text), "waiting until" in text and announced.set()))
    other.start()
    assert taken.wait(timeout=60)
    code, _, stderr = call("sweep", *overrides, f"out={tmp_path}/single")
    assert (code, announced.is_set()) == (2, False)
    assert stderr.startswith(f"error: {path}: in use by process {os.getpid()}; ")
    assert stderr.count("\n") == 1
    monkeypatch.chdir(tmp_path)
    _, stderr = succeed("sweep", "-m", *overrides, f"out={tmp_path}/job")
    other.join(timeout=60)
    assert f"{path}: in use by process {os.getpid()}; waiting" in stderr
    assert {place.name for place in tmp_path.iterdir()} == {"runs", "first", "second", "job"}


@pytest.mark.slow
def test_jobs_in_several_processes(root, tmp_path):
    jobs = ("launcher=joblib", "hydra.launcher.n_jobs=2", "candidates=4,8", f"cache={tmp_path}/store", SIGMA)
    done = run("-m", *small(root), *jobs, program="sweep", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("results: runs/folder/") == 2
    assert {results(path)["candidates"] for path in (tmp_path / "runs" / "folder").iterdir()} == {4, 8}
    assert "error" not in done.stderr
