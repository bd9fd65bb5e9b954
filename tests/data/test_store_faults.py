"""Stores when processes are killed, files are damaged and disks are full."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mfvpr import InputError
from mfvpr.data.feature_store import forecast_bytes, open_store
from tests.data.stores import (
    ARRAYS,
    DAMAGE,
    FEATURES,
    MATCHES,
    RECIPE,
    ROOT,
    Subject,
    chunk_of,
    digests,
    features_of,
    fill,
    flip,
    matches_of,
    read_all,
    run_here,
)

# Two processes


def hold(folder: str) -> None:
    """Open a store, say so, and wait to be killed."""
    with open_store(Path(folder), RECIPE, num_images=3) as store:
        store.write({0: features_of(0)})
        print("open", flush=True)
        time.sleep(60)


def test_a_second_process_is_told_and_a_killed_one_leaves_no_lock(tmp_path):
    call = f"from tests.data.test_store_faults import *; hold({str(tmp_path / 's')!r})"
    with subprocess.Popen([sys.executable, "-c", call], cwd=ROOT, stdout=subprocess.PIPE) as holder:
        try:
            assert holder.stdout is not None
            assert holder.stdout.readline() == b"open\n"
            with pytest.raises(InputError, match=rf"s: in use by process {holder.pid}; wait until it ends"):
                fill(tmp_path / "s")
        finally:
            holder.kill()
    assert fill(tmp_path / "s") == [1, 2]


def test_the_lock_holds_within_a_process_and_ends_with_an_error(tmp_path):
    def fail():
        with open_store(tmp_path / "s", RECIPE, num_images=3):
            with pytest.raises(InputError, match=f"in use by process {os.getpid()}"):
                fill(tmp_path / "s")
            raise KeyError("of the caller")

    with pytest.raises(KeyError, match="of the caller"):
        fail()
    assert fill(tmp_path / "s") == [0, 1, 2]
    assert (tmp_path / "s" / "lock").read_text() == ""


# Damage


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("name", ARRAYS)
def test_a_damaged_image_is_told_and_extracted_anew(tmp_path, name, damage):
    folder = tmp_path / "s"
    fill(folder)
    before = digests(folder)
    DAMAGE[damage](chunk_of(folder, name))
    if name != "count":  # without its count an image is not done, and that is that
        with open_store(folder, RECIPE, num_images=3) as store:
            assert store.done.all()
            found = store.read()
            assert [next(found)[0], next(found)[0]] == [0, 2]
            with pytest.raises(InputError, match=r"s: features of 1 images are damaged.*row 1 .*; run again") as told:
                next(found)
            assert "\n" not in str(told.value)
            assert store.done.tolist() == [True, False, True]
    assert fill(folder) == [1]
    assert digests(folder) == before
    assert len(read_all(folder)) == 3


@pytest.mark.parametrize("name", ARRAYS)
def test_every_flipped_bit_is_noticed(tmp_path, name):
    folder = tmp_path / "s"
    with open_store(folder, RECIPE, num_images=1) as store:
        store.write({0: features_of(0, 3, 4)})
    path = chunk_of(folder, name, 0)
    whole = path.read_bytes()
    flag = chunk_of(folder, "count", 0)
    counted = flag.read_bytes()
    for position in range(len(whole)):
        flag.write_bytes(counted)
        path.write_bytes(whole)
        flip(path, position)
        with open_store(folder, RECIPE, num_images=1) as store:
            assert store.done.all() == (name != "count")
            if name != "count":
                with pytest.raises(InputError, match="damaged"):
                    list(store.read())


@pytest.mark.parametrize("content", [b"", b"{", b"{}", b"[]"])
@pytest.mark.parametrize("name", ARRAYS)
def test_damaged_descriptions_of_arrays_are_told(tmp_path, name, content):
    fill(tmp_path / "s")
    (tmp_path / "s" / name / "zarr.json").write_bytes(content)
    with pytest.raises(InputError, match=r"s.*: damaged.*; delete .*s.* and run again") as told:
        fill(tmp_path / "s")
    assert "\n" not in str(told.value)


@pytest.mark.parametrize("name", ARRAYS)
def test_a_missing_array_is_made_again(tmp_path, name):
    folder = tmp_path / "s"
    fill(folder)
    before = digests(folder)
    shutil.rmtree(folder / name)
    if name not in ("descriptors", "count"):
        with pytest.raises(InputError, match="features of 3 images are damaged"):
            read_all(folder)
    assert fill(folder) == [0, 1, 2]
    assert digests(folder) == before


# Kill -9

NUM_ROWS = 60
LARGER: dict[str, Subject] = {
    "features": replace(FEATURES, row_of=lambda row: features_of(row, 200, 64)),
    "matches": replace(MATCHES, row_of=lambda row: matches_of(row, (300, 0, 1, 200))),
}


def _make(subject: Subject, folder: Path, log: Path, ready: int) -> None:
    """A child process: do what is not done, noting each row, and saying so before the first is written."""
    with subject.open(folder, NUM_ROWS) as store:
        todo = np.flatnonzero(~store.done).tolist()
        for start in range(0, len(todo), 4):
            batch = {row: subject.row_of(row) for row in todo[start : start + 4]}
            with log.open("a") as file:
                file.writelines(f"{row}\n" for row in batch)
            os.write(ready, b".")
            store.write(batch)


def _child(subject: Subject, folder: Path, log: Path, delay: float | None, *, from_first_write: bool) -> int:
    """Exit status of a child that is killed after `delay` s; None = not at all."""
    reading, writing = os.pipe()
    if (pid := os.fork()) == 0:
        os.close(reading)
        _make(subject, folder, log, writing)
        os._exit(0)
    os.close(writing)
    if delay is not None:
        if from_first_write:
            os.read(reading, 1)
        time.sleep(delay)
        os.kill(pid, signal.SIGKILL)
    status = os.waitpid(pid, 0)[1]
    os.close(reading)
    return status


def _rows(folder: Path, name: str) -> set[int]:
    return {int(path.name.split(".")[1]) for path in folder.glob(f"{name}/c.*") if not path.name.endswith("__lock")}


def kill_rounds(root: str, kind: str, rounds: int) -> None:
    """Kill `rounds` processes at random times, finish their work, and print what happened.

    Forks before tensorstore starts its threads, which saves a second of imports per round.
    """
    rng, subject = np.random.default_rng(0), LARGER[kind]
    told = {"killed": 0, "torn": 0, "twice": 0, "failed": 0, "stores": 0, "different": 0}
    _child(subject, Path(root, "whole"), Path(root, "log"), None, from_first_write=False)
    expected = digests(Path(root, "whole"))
    while told["killed"] < rounds:
        folder, told["stores"] = Path(root, str(told["stores"])), told["stores"] + 1
        while len(_rows(folder, "count")) < NUM_ROWS:
            done, log = _rows(folder, "count"), Path(root, "log")
            log.write_text("")
            finish = told["killed"] == rounds
            early = rng.random() < 0.3  # while the store is made or opened
            delay = None if finish else rng.uniform(0, 0.02 if early else 0.03)
            status = _child(subject, folder, log, delay, from_first_write=not early)
            told["killed"] += status == signal.SIGKILL
            told["failed"] += status not in (0, signal.SIGKILL)
            told["twice"] += len(done.intersection(map(int, log.read_text().split())))
            leftovers = any(folder.rglob("*__lock")) or any(folder.glob(".zarr-*"))
            told["torn"] += leftovers or any(_rows(folder, name) != _rows(folder, "count") for name in subject.arrays)
        told["different"] += digests(folder) | {"lock": ""} != expected | {"lock": ""}
    print(json.dumps(told))


@pytest.mark.parametrize(("kind", "rounds", "torn"), [("features", 50, 20), ("matches", 30, 10)])
def test_killed_processes_end_in_the_same_files(tmp_path, kind, rounds, torn):
    told = json.loads(run_here(f"kill_rounds({str(tmp_path)!r}, {kind!r}, {rounds})"))
    assert told["killed"] == rounds
    assert told["torn"] >= torn  # kills in the middle of writing, as the files show
    assert (told["failed"], told["twice"], told["different"]) == (0, 0, 0)


# Disks


def _mount(folder: Path, *options: str) -> None:
    subprocess.run(["mount", "-t", "tmpfs", *options, "none", str(folder)], check=True, capture_output=True)


def full_disk(root: str) -> None:
    """A store on a disk of 5 MB, which then grows: what is told, and what is left. Prints JSON."""
    disk, told = Path(root), {}
    _mount(disk, "-o", "size=5m")

    def extract() -> list[int]:
        with open_store(disk / "s", RECIPE, num_images=12) as store:
            todo = np.flatnonzero(~store.done).tolist()
            for row in todo:
                store.write({row: features_of(row, 700, 512)})
        return todo

    for name in ("first", "second"):
        try:
            extract()
        except InputError as error:
            told[name] = str(error)
    kept = read_all(disk / "s", 12)
    told["kept"] = [row for row, found in kept.items() if (found.scores == features_of(row, 700, 512).scores).all()]
    _mount(disk, "-o", "remount,size=12m")
    told["resumed"] = extract()
    told["all"] = len(read_all(disk / "s", 12))
    (disk / "ballast").write_bytes(bytes(shutil.disk_usage(disk).free))
    told["read_when_full"] = len(read_all(disk / "s", 12))
    _mount(disk, "-o", "remount,ro")
    for name in ("s", "new"):
        try:
            read_all(disk / name, 12)
        except InputError as error:
            told[f"read-only {name}"] = str(error)
    print(json.dumps(told))


def test_a_full_disk_is_told_and_extraction_goes_on_when_it_is_not(tmp_path):
    unshare = ("unshare", "--map-root-user", "--mount")
    possible = (
        shutil.which("unshare")
        and not subprocess.run(
            [*unshare, "mount", "-t", "tmpfs", "none", str(tmp_path)], capture_output=True
        ).returncode
    )
    if not possible:
        pytest.skip("the kernel does not let this user mount a small disk")
    told = json.loads(run_here(f"full_disk({str(tmp_path)!r})", prefix=unshare))
    done = told["kept"]
    assert 5 <= len(done) <= 8
    for name in ("first", "second"):
        needed = forecast_bytes(12 - len(done), 700, 512) / 1e6
        assert told[name].startswith(f"{tmp_path}/s: expected about {needed:.1f} MB of free disk space, got 0.")
        assert told[name].endswith(" MB; free some space and run again, which goes on from here")
    assert told["resumed"] == [row for row in range(12) if row not in done]
    assert told["all"] == told["read_when_full"] == 12
    for name in ("s", "new"):
        assert f"{tmp_path}/{name}: cannot hold features (Read-only file system)" in told[f"read-only {name}"]
