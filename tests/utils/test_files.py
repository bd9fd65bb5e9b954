"""Names from elsewhere stay in their folder; locks of folders."""

import fcntl
import os

import pytest

from mfvpr.utils.files import lock_folder, path_inside
from tests.io.checks import one_line_error


def test_names_stay_in_their_folder(tmp_path):
    root = tmp_path / "images"
    (root / "a").mkdir(parents=True)
    (root / "a/0.png").touch()
    (root / "in").symlink_to("a/0.png")
    (root / "up").symlink_to(tmp_path)
    assert path_inside(root, "a/0.png") == path_inside(root, "in") == root / "a/0.png"
    for name in ("/etc/passwd", "../secret", "a/../../secret", "up/secret", "a\0b"):
        with one_line_error("expected the name of a file below"):
            path_inside(root, name)


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
