"""Locks between processes, and between blocks of one."""

import fcntl
import os
import subprocess
import sys
import threading

import pytest

from mfvpr.utils.locks import lock, lock_folder

HOLD = ("import fcntl, os, sys\n"
        "handle = os.open(sys.argv[1], os.O_RDONLY)\n"
        "fcntl.flock(handle, fcntl.LOCK_EX); print('held', flush=True); sys.stdin.read()")  # fmt: skip


def refuse(_):
    raise KeyError("in use")


def hold(path):
    """A process that holds a path's lock as earlier versions do."""
    process = subprocess.Popen([sys.executable, "-c", HOLD, path], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stdout.readline() == b"held\n"
    return process


def test_a_folder_is_held_by_one_block_and_left_empty(tmp_path):
    with lock_folder(tmp_path, KeyError("in use")):
        with pytest.raises(KeyError, match="in use"), lock_folder(tmp_path, KeyError("in use")):
            pass
        handle = os.open(tmp_path, os.O_RDONLY)
        with pytest.raises(BlockingIOError):
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.close(handle)
    with lock_folder(tmp_path, KeyError("in use")):
        assert list(tmp_path.iterdir()) == []


def test_a_lock_ends_with_its_process(tmp_path):
    with hold(tmp_path) as process:
        with pytest.raises(KeyError, match="in use"), lock_folder(tmp_path, KeyError("in use")):
            pass
        process.kill()
        process.wait()
        with lock_folder(tmp_path, KeyError("in use")):
            pass


def test_a_conflict_without_an_error_waits(tmp_path):
    order, flags = [], os.O_RDWR | os.O_CREAT

    def wait_for_it():
        with lock(tmp_path / "lock", flags, lambda _: (order.append("waits"), waits.set())):
            order.append("second")

    waits, other = threading.Event(), threading.Thread(target=wait_for_it)
    with lock(tmp_path / "lock", flags, refuse):
        other.start()
        assert waits.wait(timeout=30)
        order.append("first")
    other.join(timeout=30)
    assert order == ["waits", "first", "second"]
