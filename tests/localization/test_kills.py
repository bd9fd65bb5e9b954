"""A map's file when processes are killed, read while one adds, find flipped bytes, or fill the disk."""

import os
import random
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from mfvpr import InputError
from mfvpr.storage.cache_files import round_as_stored
from mfvpr.storage.maps import FILE, Entry, MapFile
from tests.io.checks import one_line_error
from tests.programs import ROOT
from tests.small_disks import UNSHARE, mount, need_small_disks
from tests.storage.synthetic_features import assert_same, features_of, run_here

pytestmark = pytest.mark.thorough


def image_of(row):
    return features_of(row), Entry(str(row), {"row": row}, np.full(8, row, np.float32))


def add(folder, number, log=None):
    """Add rows until the map has so many, and write a line for each."""
    file = MapFile(folder)
    for row in range(len([*file.entries(0)]), number):
        file.write({}, [image_of(row)])
        if log is not None:
            os.write(log, b".\n")


def assert_whole(folder, least):
    file = MapFile(folder)
    entries = [entry for entry, _, _ in file.entries(0)]
    assert len(entries) >= least
    for row, features in file.features(range(len(entries))):
        name, place, vector = image_of(row)[1]
        assert entries[row][:2] == (name, place)
        np.testing.assert_array_equal(entries[row].vector, vector)
        assert_same(features, round_as_stored(features_of(row)))
    return len(entries)


def kill_rounds(folder, rounds):
    """Kill processes that add; forks, to save imports. A row counts when its line was written."""
    folder, rng, number, before = Path(folder), random.Random(0), 0, 0
    for _ in range(rounds):
        reading, writing = os.pipe()
        if (child := os.fork()) == 0:
            try:
                add(folder, 10**6, writing)
            finally:
                os._exit(1)
        os.close(writing)
        number += len(os.read(reading, 2)) // 2
        time.sleep(rng.uniform(0, 0.05))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        with os.fdopen(reading, "rb") as lines:
            number += lines.read().count(b"\n")
        assert number > before
        before = number = assert_whole(folder, number)


@pytest.mark.slow
def test_killed_while_adding_it_has_whole_rows_and_loses_none(tmp_path):
    run_here(__name__, f"kill_rounds({str(tmp_path / 'map')!r}, 40)")


@pytest.mark.slow
def test_readers_see_whole_rows_in_order_while_one_adds(tmp_path):
    folder = tmp_path / "map"
    add(folder, 1)
    code = f"from tests.localization.test_kills import *; add(Path({str(folder)!r}), 200)"
    reader = f"""
from tests.localization.test_kills import *
file, seen = MapFile(Path({str(folder)!r})), 0
while seen < 200:
    for entry, count, _ in file.entries(seen):
        assert (entry.name, count) == (str(seen), 40)
        seen += 1
    for row, features in file.features([seen - 1]):
        np.testing.assert_array_equal(features.keypoints, features_of(row).keypoints)
"""
    commands = [[sys.executable, "-c", f"from pathlib import Path\n{text}"] for text in (code, *[reader] * 4)]
    running = [subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True) for command in commands]
    assert [process.communicate(timeout=120)[1] for process in running] == [""] * 5
    assert assert_whole(folder, 200) == 200


@pytest.mark.parametrize("part", ["entries", "features", "system"])
def test_flipped_bytes_are_named(tmp_path, part):
    file = MapFile(tmp_path)
    file.write({"system": b"v" * 100}, [image_of(0), image_of(1)])
    del file
    path = tmp_path / FILE
    content = path.read_bytes()
    marks = {
        "entries": np.full(8, 1, np.float32).tobytes(),
        "features": features_of(1).keypoints.tobytes(),
        "system": b"v" * 100,
    }
    assert content.count(marks[part]) == 1
    damaged = bytearray(content)
    damaged[content.index(marks[part]) + 5] ^= 4
    path.write_bytes(damaged)
    file = MapFile(tmp_path)
    read = {
        "entries": lambda: [*file.entries(0)],
        "features": lambda: [*file.features([0, 1])],
        "system": lambda: file.part("system"),
    }
    with pytest.raises(InputError, match=r"map\.sqlite: (row 1|the system) is damaged") as error:
        read[part]()
    assert "\n" not in str(error.value)


def test_a_file_of_something_else_is_one_line(tmp_path):
    (tmp_path / FILE).write_bytes(b"no database " * 1000)
    with pytest.raises(InputError, match=r"map\.sqlite: cannot be used \(file is not a database\)"):
        MapFile(tmp_path).part("system")


@pytest.mark.parametrize(("change", "words"), [
    *((f"PRAGMA user_version = {other}", f"expected format 4, got {other}. Build the map again") for other in (3, 5)),
    ("DELETE FROM entries WHERE row = 1", "row 1 is damaged"),  # else later rows would be other images
])  # fmt: skip
def test_another_format_and_a_row_that_was_removed_are_named(tmp_path, change, words):
    MapFile(tmp_path).write({}, [image_of(row) for row in range(3)])
    with closing(sqlite3.connect(tmp_path / FILE)) as database, database:
        database.execute(change)
    with one_line_error(rf"map\.sqlite: {words}"):
        [*MapFile(tmp_path).entries(0)]


def test_a_map_that_may_only_be_read(tmp_path):
    MapFile(tmp_path).write({}, [image_of(0)])
    os.chmod(tmp_path, 0o500)
    try:
        assert assert_whole(tmp_path, 1) == 1
    finally:
        os.chmod(tmp_path, 0o700)


def fill(disk):
    """Add rows until the disk is full, and go on when it has grown."""
    disk = Path(disk)
    mount(disk, "-o", "size=600k")
    with pytest.raises(InputError, match=f"^{disk}/map/map.sqlite: the disk is full; free some space [^\\n]*$"):
        add(disk / "map", 1000)
    number = assert_whole(disk / "map", 2)
    mount(disk, "-o", "remount,size=20m")
    add(disk / "map", number + 40)
    assert assert_whole(disk / "map", 0) == number + 40


def test_on_a_full_disk_rows_stay_and_adding_goes_on(tmp_path):
    need_small_disks(tmp_path)
    run_here(__name__, f"fill({str(tmp_path)!r})", prefix=UNSHARE)
