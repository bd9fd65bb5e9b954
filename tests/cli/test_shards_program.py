"""Shards and clusters as programs: results are those of one machine, whoever is killed."""

import json
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest

from tests.programs import ROOT, run, small

pytestmark = pytest.mark.slow

# Commands of Slurm: `sbatch` starts the script as often as the array says, in a group; `scancel` ends the group.
SBATCH = """#!/bin/sh
echo "$@" > ROOT/options
for argument; do
    case $argument in --wrap=*) script=${argument#--wrap=};; --array=1-*) number=${argument#--array=1-};; esac
done
export script number
setsid sh -c 'echo $$ > ROOT/group; for _ in $(seq $number); do sh -c "$script" & done; wait' > /dev/null 2>&1 &
echo "12345;cluster"
"""
SCANCEL = """#!/bin/sh
echo $1 > ROOT/ended
kill -- -$(cat ROOT/group)
"""


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


def processes(group):
    """Processes of a group that have not ended."""
    columns = [path.read_text().rpartition(")")[2].split() for path in Path("/proc").glob("[0-9]*/stat")]
    return [state for state, _, number, *_ in columns if number == str(group) and state != "Z"]


def wait_until(holds):
    """Wait for up to a minute."""
    end = time.monotonic() + 60
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.1)


def start(settings, place, *more):
    """Start an evaluation in a process group of its own, as a terminal does."""
    command = [sys.executable, "-m", "experiments.evaluate", *settings, f"cache={place}/store", *more]
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "start_new_session": True}
    return subprocess.Popen(command, cwd=ROOT, **options)


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
    delays, shards = iter([3, 5, 7, 4]), ["0/2", "1/2"]
    while shards:
        tasks = {shard: start(settings, tmp_path, f"shard={shard}") for shard in shards}
        if (delay := next(delays, None)) is not None:
            time.sleep(delay)
            for task in tasks.values():
                task.send_signal(signal.SIGKILL)
        lines = {shard: task.communicate()[0] for shard, task in tasks.items()}
        shards = [shard for shard in shards if "are done" not in lines[shard]]
    assert run(*settings, f"cache={tmp_path}/store", f"out={tmp_path}/out").returncode == 0
    assert tables(tmp_path / "out") == tables(plain)


def test_ctrl_c_leaves_no_worker_and_the_next_run_goes_on(settings, plain, evaluate, tmp_path):
    process = start(settings, tmp_path, "cluster=local", "cluster.workers=3")
    wait_until(lambda: any(tmp_path.rglob("[0-9a-f]*.npz")))
    os.killpg(process.pid, signal.SIGINT)
    _, stderr = process.communicate(timeout=60)
    assert process.returncode == 130
    assert stderr.splitlines()[-1].startswith("interrupted")
    assert "Traceback" not in stderr
    wait_until(lambda: not processes(process.pid))
    stored = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("[0-9a-f]*.npz")}
    code, _, stderr = evaluate("cluster=local", "cluster.workers=3", f"out={tmp_path}/out")
    assert code == 0
    assert "cluster: 3 workers at tls://127.0.0.1:" in stderr
    assert tables(tmp_path / "out") == tables(plain)
    assert stored.items() <= {path: path.stat().st_mtime_ns for path in tmp_path.rglob("[0-9a-f]*.npz")}.items()


def test_slurm_starts_the_workers_and_ends_them(settings, plain, evaluate, tmp_path, monkeypatch):
    commands = tmp_path / "bin"
    for name, script in (("sbatch", SBATCH), ("scancel", SCANCEL)):
        commands.mkdir(exist_ok=True)
        (commands / name).write_text(script.replace("ROOT", str(tmp_path)))
        (commands / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{commands}:{os.environ['PATH']}")
    options = "--partition=gpu --mem=1G"
    cluster = "cluster=slurm", "cluster.workers=2", f"cluster.options={options}"
    code, _, stderr = evaluate(*cluster, f"out={tmp_path}/out")
    assert code == 0, stderr
    assert "cluster: 0 workers at tls://" in stderr
    assert tables(tmp_path / "out") == tables(plain)
    assert options in (tmp_path / "options").read_text()
    assert (tmp_path / "ended").read_text() == "12345\n"
    group = (tmp_path / "group").read_text().strip()
    wait_until(lambda: not processes(group))
