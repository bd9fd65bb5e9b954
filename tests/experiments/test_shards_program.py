"""Runs that several tasks share: agreed settings, states, what is missing, and the same results as of one task."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time

import pytest

from tests.programs import ROOT, folder, run, small, typed

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """The data set, without anything that was taken from it."""
    place = tmp_path_factory.mktemp("shards")
    small(place)
    return place


@pytest.fixture(scope="module")
def settings(root):
    return (*(setting for setting in small(root) if not setting.startswith("store=")), "figures=0")


@pytest.fixture(scope="module")
def plain(root, settings, tmp_path_factory):
    place = tmp_path_factory.mktemp("plain")
    assert run(*settings, f"store={place}/store", f"out={place}/out").returncode == 0
    return place / "out"


@pytest.fixture
def task(monkeypatch, capsys, settings, tmp_path):
    def start(shard, *more):
        shared_folders = (f"store={tmp_path}/store", f"out={tmp_path}/out", f"shard={shard}")
        return typed(monkeypatch, capsys, "evaluate", *settings, *shared_folders, *more)

    return start


@pytest.fixture
def shards_program(monkeypatch, capsys, tmp_path):
    def run(command, place=None):
        return typed(monkeypatch, capsys, "shards", command, place or tmp_path / "out")

    return run


def tables(place):
    """Every file that says what was found, but for times and folders."""
    names = ("predictions", "table", "gains", "failures", "answers", "shifts", "confidence", "differences")
    return {name: (place / f"{name}.csv").read_bytes() for name in names}


def test_tasks_in_any_order_leave_the_results_of_one(task, shards_program, plain, tmp_path):
    code, out, error = shards_program("missing")
    assert (code, out, error.count("\n")) == (2, "", 1)
    assert error.startswith(f"error: {tmp_path}/out/shards/run.json: expected ")
    code, out, _ = task("2/3")
    assert code == 0
    assert "shard 2/3 has done what it can: database features: " in out
    assert "missing, of shards 0-1;" in out
    assert shards_program("missing")[1] == "0-2\n"
    code, out, _ = shards_program("status")
    assert code == 0
    assert out.startswith("0/3: not begun\n1/3: not begun\n2/3: ended, waiting for database features: ")
    assert out.endswith("results: not yet\n")
    assert task("0/3")[0] == 0
    code, out, _ = task("1/3")  # the last that takes features, so that it goes on
    assert code == 0
    assert "shard 1/3 has done its part: " in out
    assert shards_program("missing")[1] == "0,2\n"
    assert task("2/3")[0] == 0
    assert shards_program("missing")[1] == "0\n"
    code, out, _ = task("0/3")
    assert code == 0
    assert f"results: {tmp_path}/out" in out
    assert shards_program("missing")[:2] == (0, "")
    assert shards_program("status")[1] == "0/3: complete\n1/3: complete\n2/3: complete\n" + f"results: {tmp_path}/out\n"
    content, expected = (json.loads((out / "results.json").read_text()) for out in (tmp_path / "out", plain))
    assert [row | {"seconds": 0} for row in content] == [row | {"seconds": 0} for row in expected]
    assert tables(tmp_path / "out") == tables(plain)
    code, out, _ = task("0/3")  # again
    assert (code, out) == (0, f"shard 0/3 is complete; results: {tmp_path}/out\n")


def test_tasks_must_agree(task, shards_program, tmp_path, root, settings):
    assert task("0/2")[0] == 0
    code, _, error = task("0/4")
    assert code == 2
    assert "shard=0/4: shards=4, expected 2 " in error
    code, _, error = task("1/2", "scorer.histogram.sigma=7")
    assert code == 2
    assert "sigma=7" in error
    assert "name another out=DIR" in error
    other = tmp_path / "other"
    shutil.copytree(root / "streets-v1-seed0-24x160x120", other)
    (other / "database" / "0003.png").write_bytes((other / "database" / "0004.png").read_bytes())
    code, _, error = task(
        "1/2", *(setting for setting in folder(other) if "=" in setting and setting != "dataset=folder")
    )
    assert code == 2
    assert error.count("\n") == 1 or "data.json" in error
    assert "images.database" in error
    code, _, error = task("1/2", f"store={tmp_path}/local")  # of the same path on another machine, as it were
    assert code == 2
    assert "shard=1/2: expected the store=" in error
    (tmp_path / "out" / "shards" / "run.json").write_text("{")
    code, _, error = task("1/2")
    assert code == 2
    assert "run.json: expected a file of a run" in error


@pytest.mark.parametrize(
    "typed_in, words",
    [
        (("shard=2/2",), "shard=2/2: expected i/n with i from 0"),
        (("shard=1",), "shard=1: expected i/n"),
        (("shard=a/b",), "shard=a/b: expected i/n"),
        (("wait=-1",), "wait=-1: expected a number"),
        (("shard=null", "wait=5"), "wait=5: expected shard=i/n as well"),
        (("shard=null", "coordinator=a:1"), "coordinator=a:1: expected shard=i/n as well"),
        (("store=null",), "shard=0/2: expected store=DIR as well"),
        (("out=null",), "shard=0/2: expected out=DIR as well"),
    ],
)
def test_wrong_settings(task, typed_in, words):
    code, _, error = task("0/2", *typed_in)
    assert code == 2
    assert error.startswith(f"error: {words}")
    assert error.count("\n") == 1


def test_a_folder_of_another_run_is_refused(task, tmp_path, shards_program, plain):
    shutil.copytree(plain, tmp_path / "out")
    code, _, error = task("0/1")
    assert code == 2
    assert f"out={tmp_path}/out: expected a new or empty folder" in error
    (tmp_path / "out" / "shards").mkdir()
    for wrong in ('{"format": "mfvpr shards 1", "shards": -2}', '{"format": "mfvpr shards 1", "shards": "x"}', "[]"):
        (tmp_path / "out" / "shards" / "run.json").write_text(wrong)
        code, _, error = shards_program("missing")
        assert code == 2
        assert error.startswith(f"error: {tmp_path}/out/shards/run.json: expected ")


def command(settings, place, shard):
    shared_folders = (f"store={place}/store", f"out={place}/out", f"shard={shard}")
    return [sys.executable, "-m", "experiments.evaluate", *settings, *shared_folders]


def test_the_same_shard_twice_is_refused_and_killed_ones_go_on(settings, plain, tmp_path, shards_program):
    """Killed at many moments, beside each other; whoever is started again goes on; clocks may differ."""
    place, delays = tmp_path, iter([3, 5, 7, 4])

    def work(delays):
        while missing := shards_program("missing")[1].strip():
            shards = [0, 1] if "-" in missing else [int(missing)]
            tasks = [subprocess.Popen(command(settings, place, f"{shard}/2"), cwd=ROOT, stdout=subprocess.DEVNULL,
                                      stderr=subprocess.DEVNULL) for shard in shards]  # fmt: skip
            if (delay := next(delays, None)) is not None:
                time.sleep(delay)
                for process in tasks:
                    process.send_signal(signal.SIGKILL)
            for process in tasks:
                process.wait()
            for path in (place / "out" / "shards").rglob("*.json"):
                os.utime(path, (0, 4e9))  # of another clock

    first = subprocess.Popen(command(settings, place, "0/2"), cwd=ROOT, stderr=subprocess.DEVNULL)
    while not shards_program("status")[1].startswith("0/2: at work"):
        time.sleep(0.05)
    first.send_signal(signal.SIGSTOP)
    second = subprocess.run(command(settings, place, "0/2"), cwd=ROOT, capture_output=True, text=True)
    first.send_signal(signal.SIGCONT)
    assert second.returncode == 2
    assert f"{place}/out/shards/0-of-2: in use by process {first.pid}" in second.stderr
    first.wait()
    work(delays)
    assert tables(place / "out") == tables(plain)
    # A row of a complete task is damaged, and removed by whoever reads it: both are started again.
    (place / "out" / "results.json").unlink()
    for row in (place / "store").glob("scores-*/shards/0-of-2/*.npz"):
        row.unlink()
    [row, *_] = (place / "store").glob("matches-*/shards/1-of-2/*.npz")
    row.write_bytes(b"damaged")
    work(iter(()))
    assert tables(place / "out") == tables(plain)
    assert json.loads((place / "out" / "run.json").read_text())["settings"]["candidates"]
