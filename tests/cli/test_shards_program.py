"""Shards as programs: each fills the store, and a run without shards writes the results of one machine."""

import json
import signal
import subprocess
import sys
import time
from functools import partial

import pytest

from tests.programs import ROOT, run, small

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def settings(tmp_path_factory):
    return (*(setting for setting in small(tmp_path_factory.mktemp("data")) if "cache=" not in setting), "figures=0")


@pytest.fixture(scope="module")
def plain(settings, tmp_path_factory):
    place = tmp_path_factory.mktemp("plain")
    assert run(*settings, f"cache={place}/store", f"out={place}/out").returncode == 0
    return place / "out"


@pytest.fixture
def evaluate(call, settings, tmp_path):
    return partial(call, "evaluate", *settings, f"cache={tmp_path}/store")


def tables(place):
    """Every file of results, without times and folders."""
    names = ("top_predictions", "table", "gains", "failures", "predictions", "shifts", "confidence", "differences")
    return {name: (place / f"{name}.csv").read_bytes() for name in names}


def test_shards_in_any_order_and_a_plain_run_leave_the_results_of_one(evaluate, plain, tmp_path):
    out = f"out={tmp_path}/out"
    code, stdout, _ = evaluate("shard=2/3", out)
    assert code == 0
    assert stdout.splitlines()[-1].startswith("shard 2/3: its images are described, those of shards 0, 1 are not")
    assert "start it again" in evaluate("shard=0/3")[1]
    for shard in ("1/3", "2/3", "0/3"):  # the last that describes images goes on
        code, stdout, _ = evaluate(f"shard={shard}", out)
        assert (code, stdout.splitlines()[-1][:31]) == (0, f"shard {shard}: its images and queri")
    assert not (tmp_path / "out").exists()
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "store").rglob("*.npz")}
    assert evaluate(out)[0] == 0
    assert before == {path: path.stat().st_mtime_ns for path in (tmp_path / "store").rglob("*.npz")}
    content, expected = (json.loads((folder / "results.json").read_text()) for folder in (tmp_path / "out", plain))
    assert [row | {"seconds": 0} for row in content] == [row | {"seconds": 0} for row in expected]
    assert tables(tmp_path / "out") == tables(plain)


def test_a_plain_run_computes_the_parts_of_missing_shards(evaluate, plain, tmp_path):
    assert evaluate("shard=1/3")[0] == 0
    assert evaluate(f"out={tmp_path}/out")[0] == 0
    assert tables(tmp_path / "out") == tables(plain)


def test_killed_shards_go_on(settings, plain, tmp_path):
    """Shards are killed at many moments, side by side."""

    def start(shard):
        command = [sys.executable, "-m", "experiments.evaluate", *settings, f"cache={tmp_path}/store", f"shard={shard}"]
        return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)

    delays, shards = iter([3, 5, 7, 4]), ["0/2", "1/2"]
    while shards:
        tasks = {shard: start(shard) for shard in shards}
        if (delay := next(delays, None)) is not None:
            time.sleep(delay)
            for task in tasks.values():
                task.send_signal(signal.SIGKILL)
        lines = {shard: task.communicate()[0] for shard, task in tasks.items()}
        shards = [shard for shard in shards if "are done" not in lines[shard]]
    assert run(*settings, f"cache={tmp_path}/store", f"out={tmp_path}/out").returncode == 0
    assert tables(tmp_path / "out") == tables(plain)
