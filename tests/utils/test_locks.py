"""Locks of files and folders."""

import fcntl
import os
import threading

import pytest

from mfvpr.utils.locks import lock, lock_folder


def refuse(_):
    raise KeyError("in use")


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
