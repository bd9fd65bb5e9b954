"""Stores when processes are killed, files are damaged and disks are full."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from mfvpr import InputError
from mfvpr.storage.disk import lock_store
from mfvpr.storage.features import forecast_bytes, open_store
from tests.io.checks import one_line_error
from tests.small_disks import UNSHARE, mount, need_small_disks
from tests.storage.synthetic_features import (
    DAMAGE,
    FEATURES,
    MATCHES,
    RECIPE,
    ROOT,
    Subject,
    digests,
    features_of,
    file_of,
    fill,
    matches_of,
    of_both_kinds,
    read_all,
    run_here,
)

pytestmark = pytest.mark.thorough

# Two processes


def hold(folder: str) -> None:
    """Open a store, say so, and wait to be killed."""
    with open_store(Path(folder), RECIPE, num_images=3) as store:
        store.write({0: features_of(0)})
        print("open", flush=True)
        time.sleep(60)


@pytest.fixture
def holder(tmp_path):
    """A process that has the store `s` open, in which one row is done."""
    call = f"from tests.storage.test_faults import *; hold({str(tmp_path / 's')!r})"
    with subprocess.Popen([sys.executable, "-c", call], cwd=ROOT, stdout=subprocess.PIPE) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == b"open\n"
            yield process
        finally:
            process.kill()


def test_a_second_process_is_refused_and_a_killed_one_leaves_no_lock(tmp_path, holder):
    with pytest.raises(InputError, match=rf"s: in use by process {holder.pid}\b"):
        fill(tmp_path / "s")
    holder.kill()
    holder.wait()
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


@of_both_kinds
def test_a_complete_store_is_read_by_any_number_at_the_same_time(tmp_path, subject):
    fill(tmp_path / "s", subject=subject)
    with subject.open(tmp_path / "s", 3) as first, subject.open(tmp_path / "s", 3) as second:
        assert first.done.all()
        assert [row for row, _ in second.read()] == [row for row, _ in first.read()] == [0, 1, 2]
        if subject is FEATURES:
            assert run_here(f"print(*read_all(Path({str(tmp_path / 's')!r})))").split() == ["0", "1", "2"]


def test_a_store_is_read_while_another_process_writes_it(tmp_path, request):
    """The rows of that process are done for whoever opens the store again, or enters it."""
    before = open_store(tmp_path / "s", RECIPE, num_images=3)
    holder = request.getfixturevalue("holder")
    store = open_store(tmp_path / "s", RECIPE, num_images=3)
    assert store.counts.tolist() == [40, -1, -1]
    [(row, features)] = store.read()
    assert row == 0
    np.testing.assert_array_equal(features.keypoints, features_of(0).keypoints)
    with pytest.raises(ValueError, match="row 1 is not done"):
        list(store.read([1]))
    with pytest.raises(ValueError, match="write `with store:`"):
        store.write({1: features_of(1)})
    assert not before.done.any()
    holder.kill()
    holder.wait()
    with before:
        assert before.done.tolist() == [True, False, False]


def test_rows_that_are_written_during_the_wait_for_the_lock_are_done(tmp_path):
    with ExitStack() as stack:
        holder = stack.enter_context(open_store(tmp_path / "s", RECIPE, num_images=3))

        def finish(_):
            holder.write({1: features_of(1)})
            stack.close()

        lock = partial(lock_store, waiting=finish)
        with open_store(tmp_path / "s", RECIPE, num_images=3, lock=lock) as store:
            assert store.done.tolist() == [False, True, False]


def test_a_complete_store_is_not_written(tmp_path):
    fill(tmp_path / "s")
    DAMAGE["empty"](file_of(tmp_path / "s"))
    with open_store(tmp_path / "s", RECIPE, num_images=3) as store:
        with pytest.raises(InputError, match="damaged"):
            list(store.read())
        with pytest.raises(ValueError, match="read only, or was complete"):
            store.write({1: features_of(1)})
    assert fill(tmp_path / "s") == [1]


# Damage


@pytest.mark.parametrize("damage", DAMAGE)
@of_both_kinds
def test_a_damaged_row_is_named_and_made_anew(tmp_path, subject, damage):
    folder, words = tmp_path / "s", subject.kind
    fill(folder, subject=subject)
    before = digests(folder)
    with subject.open(folder, 3) as store:
        for row in (1, 2):
            DAMAGE[damage](file_of(folder, row))
        assert store.done.all()
        rows = store.read()
        assert next(rows)[0] == 0
        expected = rf"s: {words.content} of 2 {words.rows} are damaged.*row 1 \(1-.*\); run again, which {words.remake}"
        with one_line_error(expected):
            next(rows)
        assert store.done.tolist() == [True, False, False]
    assert fill(folder, subject=subject) == [1, 2]
    assert digests(folder) == before
    assert len(read_all(folder, subject=subject)) == 3


def test_a_row_of_another_store_is_noticed(tmp_path):
    fill(tmp_path / "s")
    with open_store(tmp_path / "t", {**RECIPE, "weights": None}, num_images=3) as other:
        other.write({row: features_of(row) for row in range(3)})
    shutil.copy(file_of(tmp_path / "t"), file_of(tmp_path / "s"))
    with pytest.raises(InputError, match=r"of 1 images are damaged.*row 1"):
        read_all(tmp_path / "s")
    assert fill(tmp_path / "s") == [1]


def test_a_damaged_row_of_a_half_done_store_stops_nobody_from_going_on(tmp_path):
    with open_store(tmp_path / "s", RECIPE, num_images=3) as store:
        store.write({0: features_of(0)})
    DAMAGE["half"](file_of(tmp_path / "s", 0))
    assert fill(tmp_path / "s") == [1, 2]
    with pytest.raises(InputError, match="the first in row 0"):
        read_all(tmp_path / "s")
    assert fill(tmp_path / "s") == [0]


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


def _rows(folder: Path) -> set[int]:
    return {int(path.name.partition("-")[0]) for path in folder.glob("[0-9]*.npz")}


def kill_rounds(root: str, kind: str, rounds: int) -> None:
    """Kill `rounds` processes at random times, finish their work, and print what happened.

    Forks, which saves a second of imports per round.
    """
    rng, subject = np.random.default_rng(0), LARGER[kind]
    counts = {"killed": 0, "torn": 0, "twice": 0, "failed": 0, "stores": 0, "different": 0}
    _child(subject, Path(root, "whole"), Path(root, "log"), None, from_first_write=False)
    expected = digests(Path(root, "whole"))
    while counts["killed"] < rounds:
        folder, counts["stores"] = Path(root, str(counts["stores"])), counts["stores"] + 1
        while len(_rows(folder)) < NUM_ROWS:
            done, log = _rows(folder), Path(root, "log")
            log.write_text("")
            finish = counts["killed"] == rounds
            early = rng.random() < 0.3  # while the store is made or opened
            delay = None if finish else rng.uniform(0, 0.02 if early else 0.03)
            status = _child(subject, folder, log, delay, from_first_write=not early)
            counts["killed"] += status == signal.SIGKILL
            counts["failed"] += status not in (0, signal.SIGKILL)
            counts["twice"] += len(done.intersection(map(int, log.read_text().split())))
            counts["torn"] += any(folder.glob(".*"))
            for name, digest in digests(folder).items():  # what is there is whole, at any moment
                counts["different"] += not name.startswith(".") and digest != expected[name]
        whole = {name: digest for name, digest in digests(folder).items() if not name.startswith(".")}
        counts["different"] += whole != expected  # torn files are hidden, and go when they are old
    print(json.dumps(counts))


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "rounds"), [("features", 50), ("matches", 30)])
def test_killed_processes_end_in_the_same_files(tmp_path, kind, rounds):
    counts = json.loads(run_here(f"kill_rounds({str(tmp_path)!r}, {kind!r}, {rounds})"))
    assert counts["killed"] == rounds
    assert counts["torn"] > 0  # kills in the middle of writing, as the files show
    assert (counts["failed"], counts["twice"], counts["different"]) == (0, 0, 0)


# Disks


def full_disk(root: str) -> None:
    """Fill a store on a disk of 5 MB, which then grows. Prints messages and rows as JSON."""
    disk = Path(root)
    mount(disk, "-o", "size=5m")

    def extract() -> list[int]:
        with open_store(disk / "s", RECIPE, num_images=12) as store:
            todo = np.flatnonzero(~store.done).tolist()
            for row in todo:
                store.write({row: features_of(row, 700, 512)})
        return todo

    def message_of(call: Callable[..., object], *arguments: object) -> str:
        with pytest.raises(InputError) as error:
            call(*arguments)
        return str(error.value)

    report: dict[str, object] = {"first": message_of(extract), "second": message_of(extract)}
    report["done"] = [
        row for row, features in read_all(disk / "s", 12).items()
        if (features.scores == features_of(row, 700, 512).scores).all()
    ]  # fmt: skip
    mount(disk, "-o", "remount,size=12m")
    report["resumed"] = extract()
    report["all"] = len(read_all(disk / "s", 12))
    (disk / "ballast").write_bytes(bytes(shutil.disk_usage(disk).free))
    report["read_when_full"] = len(read_all(disk / "s", 12))
    mount(disk, "-o", "remount,ro")
    report["read_when_read_only"] = len(read_all(disk / "s", 12))
    report["new"] = message_of(read_all, disk / "new", 12)
    mount(disk, "-o", "remount,rw")
    DAMAGE["flipped"](file_of(disk / "s", 3))
    mount(disk, "-o", "remount,ro")
    report["damaged"] = message_of(read_all, disk / "s", 12)
    print(json.dumps(report))


def test_a_full_disk_is_named_and_extraction_goes_on_when_it_is_not(tmp_path):
    need_small_disks(tmp_path)
    report = json.loads(run_here(f"full_disk({str(tmp_path)!r})", prefix=UNSHARE))
    done = report["done"]
    assert 5 <= len(done) <= 8
    for name in ("first", "second"):
        needed = forecast_bytes(1, 700, 512) / 1e6  # of the row that was being written
        assert report[name].startswith(f"{tmp_path}/s: expected about {needed:.1f} MB of free disk space, got 0.")
        assert "MB; free some space" in report[name]
    assert report["resumed"] == [row for row in range(12) if row not in done]
    assert report["all"] == report["read_when_full"] == report["read_when_read_only"] == 12
    assert f"{tmp_path}/new: cannot hold features (Read-only file system)" in report["new"]
    assert "row 3 (3-700.npz); " in report["damaged"]
