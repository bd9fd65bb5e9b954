"""The filter and scores on the devices of several processes: two of four devices each, beside one process."""

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest

import mfvpr
from mfvpr.datasets import Positives
from mfvpr.evaluation.distributed import all_devices, retrieve_on_mesh, score_on_mesh
from mfvpr.utils import InputError
from tests.builders import make_matches, unit
from tests.experiments.test_shards_program import tables
from tests.programs import ROOT, run, small

pytestmark = pytest.mark.optimized

FLAGS = {"XLA_FLAGS": "--xla_force_host_platform_device_count=4", "PYTHONPATH": str(ROOT)}
CANDIDATES = 9


def retrieval():
    """203 rows on 8 devices, equal ones on several, some that are no numbers, some that are left out."""
    rng = np.random.default_rng(0)
    database, queries = unit(rng.normal(size=(203, 16))), unit(rng.normal(size=(12, 16)))
    database[[5, 60, 190]] = queries[0]
    database[[77, 202]], queries[3] = np.nan, np.inf
    excluded = Positives.from_rows([range(query, 203, 7) for query in range(12)], 203)
    return queries, database, excluded


def eight_queries():
    """Matches [8, 4, ...] of eight queries and four candidates."""
    rng = np.random.default_rng(1)
    points = rng.uniform(0, 48, (32, 2, 20, 2))
    pairs = [make_matches(*pair, scores0=rng.uniform(size=20), scores1=rng.uniform(size=20)) for pair in points]
    return jax.tree.map(lambda *fields: np.reshape(np.stack(fields), (8, 4, *np.shape(fields[0]))), *pairs)


def take(tree, rows):
    return jax.tree.map(lambda field: field[rows], tree)


def work(mesh, queries):
    """Results of a process by name."""
    results = {}
    for name, left_out in (("all", None), ("some", retrieval()[2])):
        shortlist = retrieve_on_mesh(*retrieval()[:2], num_candidates=CANDIDATES, mesh=mesh, excluded=left_out)
        results |= {
            f"{name} indices": shortlist.indices,
            f"{name} scores": shortlist.scores,
            f"{name} mask": shortlist.mask,
        }
    matches = take(eight_queries(), queries)
    return results | {"scores": score_on_mesh(mfvpr.HistogramOfShifts(), matches, mesh=mesh)}


def process(address, index, out):
    jax.distributed.initialize(address, 2, int(index))
    assert (jax.device_count(), jax.local_device_count()) == (8, 4)
    np.savez(out, **work(all_devices(), slice(4 * int(index), 4 * int(index) + 4)))


def free_address():
    with socket.socket() as connection:
        connection.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{connection.getsockname()[1]}"


@pytest.mark.slow
def test_two_processes_of_four_devices_find_what_one_finds(tmp_path):
    address = free_address()
    code = "import sys; from tests.evaluation.test_distributed import process; process(*sys.argv[1:])"
    started = [
        subprocess.Popen([sys.executable, "-c", code, address, str(index), f"{tmp_path}/{index}.npz"], cwd=ROOT,
                         env=os.environ | FLAGS) for index in (0, 1)
    ]  # fmt: skip
    assert [task.wait(120) for task in started] == [0, 0]
    first, second = (np.load(tmp_path / f"{index}.npz") for index in (0, 1))
    queries, database, excluded = retrieval()
    for name, mask in (("all", None), ("some", ~excluded.dense())):
        alone = mfvpr.retrieve(queries, database, num_candidates=CANDIDATES, mask=mask)
        for results in (first, second):
            np.testing.assert_array_equal(results[f"{name} indices"], alone.indices)
            np.testing.assert_array_equal(results[f"{name} mask"], alone.mask)
            np.testing.assert_allclose(results[f"{name} scores"], alone.scores, atol=1e-6)
    assert first["all indices"][0, :3].tolist() == [5, 60, 190]  # of equal ones, on three devices, the first row
    matches = eight_queries()
    for query in range(8):
        alone = mfvpr.score_candidates(mfvpr.HistogramOfShifts(), take(matches, query))
        for results in (first, second):
            np.testing.assert_array_equal(results["scores"][query], alone)


def test_one_device_is_a_mesh(tmp_path):
    results = work(all_devices(jax.devices()[:1]), slice(None))
    alone = mfvpr.retrieve(*retrieval()[:2], num_candidates=CANDIDATES)
    np.testing.assert_array_equal(results["all indices"], alone.indices)
    np.testing.assert_array_equal(results["all scores"], alone.scores)
    assert results["scores"].shape == (8, 4)


def test_what_cannot_be_spread():
    with pytest.raises(InputError, match="expected a scorer that runs on devices"):
        score_on_mesh(mfvpr.OpenCvHomography(), eight_queries(), mesh=all_devices())
    with pytest.raises(ValueError, match="expected matches"):
        score_on_mesh(mfvpr.MatchCount(), take(eight_queries(), 0), mesh=all_devices())


@pytest.mark.slow
def test_a_task_that_dies_ends_the_others_and_all_go_on(tmp_path):
    settings = (*(setting for setting in small(tmp_path / "data") if not setting.startswith("store=")), "figures=0")
    expected = tmp_path / "plain"
    assert run(*settings, f"store={tmp_path}/plain-store", f"out={expected}").returncode == 0

    def tasks():
        folders = (f"store={tmp_path}/store", f"out={tmp_path}/out", f"coordinator={free_address()}")
        return [
            subprocess.Popen(
                [sys.executable, "-m", "experiments.evaluate", *settings, *folders, f"shard={index}/2"], cwd=ROOT,
                env=os.environ | FLAGS, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                start_new_session=True,
            )
            for index in (0, 1)
        ]  # fmt: skip

    first, second = tasks()
    lock = tmp_path / "out" / "shards" / "1-of-2" / "lock"
    while not lock.exists() or not lock.read_text():
        time.sleep(0.02)
    os.killpg(second.pid, signal.SIGKILL)
    start = time.monotonic()
    _, error = first.communicate()
    assert time.monotonic() - start < 60
    assert first.returncode == 75
    line = error.strip().splitlines()[-1]
    assert line.startswith("error: shard=0/2: another task has ended")
    assert "start all tasks again" in line
    assert "Terminating process" in Path(line.partition("(see ")[2].partition(")")[0]).read_text()
    second.communicate()
    again = tasks()
    outputs = [task.communicate() for task in again]
    assert [task.returncode for task in again] == [0, 0], outputs
    assert tables(tmp_path / "out") == tables(expected)
    # One has nothing left to do but what all do together.
    (tmp_path / "out" / "results.json").unlink()
    for path in (tmp_path / "store").glob("scores-*/shards/1-of-2/*.npz"):
        path.unlink()
    again = tasks()
    outputs = [task.communicate(timeout=200) for task in again]
    assert [task.returncode for task in again] == [0, 0], outputs
    assert tables(tmp_path / "out") == tables(expected)
