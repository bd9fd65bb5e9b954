"""Names from elsewhere stay in their folder; locks of folders."""

import fcntl
import os
import threading

import pytest

from mfvpr.utils.files import lock_folder, path_inside
from tests.io.checks import one_line_error


@pytest.fixture
def root(tmp_path):
    folder = tmp_path / "images"
    (folder / "a").mkdir(parents=True)
    (folder / "a/0.png").touch()
    (tmp_path / "secret").touch()
    (folder / "in").symlink_to("a/0.png")
    (folder / "out").symlink_to("../secret")
    (folder / "up").symlink_to(tmp_path)
    return folder


def test_files_of_a_folder(root, monkeypatch):
    assert path_inside(root, "a/0.png") == path_inside(root, "in") == root / "a/0.png"
    assert path_inside(root, "a/no such..png") == root / "a/no such..png"
    assert path_inside(root, str(root / "a/0.png")) == root / "a/0.png"
    (root.parent / "link").symlink_to(root)
    assert path_inside(root.parent / "link", "in") == root / "a/0.png"  # where the folder itself is, its owner knows
    monkeypatch.chdir(root)
    assert path_inside(root.relative_to(root), "in") == root / "a/0.png"


@pytest.mark.parametrize("name", ["/etc/passwd", "../secret", "a/../../secret", "out", "up/secret", "a\0b"])
def test_names_that_lead_elsewhere(root, name):
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


def test_without_an_error_it_waits(tmp_path):
    order = []

    def wait_for_it():
        with lock_folder(tmp_path, None):
            order.append("second")

    other = threading.Thread(target=wait_for_it)
    with lock_folder(tmp_path, None):
        other.start()
        other.join(timeout=0.2)
        order.append("first")
    other.join(timeout=30)
    assert order == ["first", "second"]
