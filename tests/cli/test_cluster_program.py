"""Clusters as programs: interrupted, killed, and started by a Slurm that is imitated."""

import os
import signal
import subprocess
import sys
import time
from functools import partial

import pytest

from tests.cli.test_shards_program import evaluate, plain, settings, tables  # noqa: F401
from tests.programs import ROOT

pytestmark = pytest.mark.slow

# Commands of Slurm: `sbatch` starts the script of --wrap for each number of --array, in one group; `scancel` ends it.
SBATCH = """#!/bin/sh
for argument; do
    case $argument in --wrap=*) script=${argument#--wrap=};; --array=1-*) number=${argument#--array=1-};; esac
done
echo "$@" > {root}/options
setsid sh -c 'for _ in $(seq '$number'); do (SLURM_CPUS_PER_TASK=1 sh -c "$0" > /dev/null 2>&1 &); done' "$script"
echo "1234;cluster"
"""


def start(*arguments):
    """Start an evaluation in a process group of its own, as a terminal does."""
    return subprocess.Popen(
        [sys.executable, "-m", "experiments.evaluate", *map(str, arguments)], cwd=ROOT, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip


def processes(text):
    """Command lines of all processes of this machine that hold a text."""
    lines = subprocess.run(["ps", "-eo", "pid,args"], capture_output=True, text=True).stdout.splitlines()
    return [line for line in lines if text in line]


def test_ctrl_c_leaves_no_worker_and_the_next_run_goes_on(settings, plain, evaluate, tmp_path):
    process = start(*settings, f"cache={tmp_path}/store", "cluster=local", "cluster.workers=3")
    lines = []
    while not any(tmp_path.rglob("*-*.npz")):
        time.sleep(0.1)
        assert process.poll() is None
    os.killpg(process.pid, signal.SIGINT)
    _, stderr = process.communicate(timeout=60)
    print(stderr)
    assert process.returncode == 130
    assert stderr.splitlines()[-1].startswith("interrupted")
    assert "Traceback" not in stderr
    with pytest.raises(ProcessLookupError):
        os.killpg(process.pid, 0)
    stored = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*-*.npz")}
    code, stdout, stderr = evaluate("cluster=local", "cluster.workers=3", f"out={tmp_path}/out")
    print(stderr)
    assert code == 0
    assert "cluster: 3 workers at tcp://127.0.0.1:" in stderr
    assert tables(tmp_path / "out") == tables(plain)
    assert stored.items() <= {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*-*.npz")}.items()
