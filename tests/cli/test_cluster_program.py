"""Clusters as programs: interrupted, killed, and started by a Slurm that is imitated."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.cli.test_shards_program import evaluate, plain, settings, tables  # noqa: F401
from tests.programs import ROOT

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


def start(*arguments):
    """Start an evaluation in a process group of its own, as a terminal does."""
    return subprocess.Popen(
        [sys.executable, "-m", "experiments.evaluate", *map(str, arguments)], cwd=ROOT, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip


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


def test_ctrl_c_leaves_no_worker_and_the_next_run_goes_on(settings, plain, evaluate, tmp_path):
    process = start(*settings, f"cache={tmp_path}/store", "cluster=local", "cluster.workers=3")
    wait_until(lambda: any(tmp_path.rglob("*-*.npz")))
    os.killpg(process.pid, signal.SIGINT)
    _, stderr = process.communicate(timeout=60)
    assert process.returncode == 130
    assert stderr.splitlines()[-1].startswith("interrupted")
    assert "Traceback" not in stderr
    wait_until(lambda: not processes(process.pid))
    stored = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*-*.npz")}
    code, stdout, stderr = evaluate("cluster=local", "cluster.workers=3", f"out={tmp_path}/out")
    assert code == 0
    assert "cluster: 3 workers at tcp://127.0.0.1:" in stderr
    assert tables(tmp_path / "out") == tables(plain)
    assert stored.items() <= {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*-*.npz")}.items()


def test_slurm_starts_the_workers_and_ends_them(settings, plain, evaluate, tmp_path, monkeypatch):
    commands = tmp_path / "bin"
    for name, script in (("sbatch", SBATCH), ("scancel", SCANCEL)):
        commands.mkdir(exist_ok=True)
        (commands / name).write_text(script.replace("ROOT", str(tmp_path)))
        (commands / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{commands}:{os.environ['PATH']}")
    options = "--partition=gpu --mem=1G"
    code, _, stderr = evaluate("cluster=slurm", "cluster.workers=2", f"cluster.options={options}", f"out={tmp_path}/out")
    assert code == 0, stderr
    assert "cluster: waiting for the first of 2 workers, job 12345 of Slurm\ncluster: " in stderr
    assert tables(tmp_path / "out") == tables(plain)
    assert options in (tmp_path / "options").read_text()
    assert (tmp_path / "ended").read_text() == "12345\n"
    group = (tmp_path / "group").read_text().strip()
    wait_until(lambda: not processes(group))
