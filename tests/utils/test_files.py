"""Names from elsewhere stay in their folder."""

import pytest

from mfvpr.utils.files import path_inside
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
    (folder / "around").symlink_to("around")
    return folder


def test_files_of_a_folder(root, monkeypatch):
    assert path_inside(root, "a/0.png") == path_inside(root, "in") == root / "a/0.png"
    assert path_inside(root, "a/no such..png") == root / "a/no such..png"
    assert path_inside(root, str(root / "a/0.png")) == root / "a/0.png"
    (root.parent / "link").symlink_to(root)
    assert path_inside(root.parent / "link", "in") == root / "a/0.png"  # where the folder itself is, its owner knows
    monkeypatch.chdir(root)
    assert path_inside(root.relative_to(root), "in") == root / "a/0.png"


@pytest.mark.parametrize("name", ["/etc/passwd", "../secret", "a/../../secret", "a/../a/0.png", "out", "up/secret",
                                  "around", "a\0b", "../\n", "x" * 5000 + "/.."])  # fmt: skip
def test_names_that_lead_elsewhere(root, name):
    with one_line_error("expected the name of a file below"):
        path_inside(root, name)
