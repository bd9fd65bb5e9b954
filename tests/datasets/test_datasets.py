"""Folders of images, what is no image, and queries that are database images."""

import os
import shutil

import numpy as np
import pytest
from PIL import Image

from mfvpr import InputError, datasets
from mfvpr.datasets import IndexFile, image_folder
from mfvpr.datasets.contents import contents, identical_rows
from tests.builders import fill
from tests.io.checks import one_line_error


@pytest.mark.parametrize(("name", "words"), [("no", "got nothing"), ("empty", "got none"), ("file", "a file")])
def test_missing_and_empty_folders(tmp_path, name, words):
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=words):
        image_folder(tmp_path / name)


def test_numbers_of_any_length_in_names_of_any_kind_sort_by_value(tmp_path):
    names = [f"{number}.png" for number in ("2", "10", "0010", "9" * 200, "1" + "0" * 200, "0" * 150 + "3")]
    long = "/".join(["7" * 200] * 15)  # the digits of a path are read folder by folder
    other_names = ["img2.png", "img10.png", "sub/img2.png", "a b/ü@1.png", "IMG3.JPG", "img02.png", f"{long}/1.png"]
    folder = image_folder(fill(tmp_path, [*names, *other_names]))
    assert set(folder.names) == {*names, *other_names}
    assert folder.names.index("img2.png") < folder.names.index("img10.png")
    order = [folder.names.index(names[place]) for place in (0, 5, 1, 3, 4)]
    assert order == sorted(order)


def test_linked_folders_are_followed(tmp_path):
    real = fill(tmp_path / "real", ["deep/1.png", "2.png"])
    root = fill(tmp_path / "root", ["0.png"])
    (root / "one").symlink_to(real)
    (root / "other").symlink_to(real / "deep", target_is_directory=True)  # twice by different links is no loop
    (root / "3.png").symlink_to(real / "2.png")
    assert image_folder(root).names == ("0.png", "3.png", "one/2.png", "one/deep/1.png", "other/1.png")
    (tmp_path / "entry").symlink_to(root)
    assert len(image_folder(tmp_path / "entry")) == 5


@pytest.mark.parametrize(
    ("place", "target", "words"),
    [
        ("sub/back", "..", "back: expected files and folders, got a link back to "),
        ("sub/up", "../..", "a link back to "),
        ("self", "self", "self: expected an image or a folder, got a link to nothing"),
        ("gone", "nowhere", "gone: expected an image or a folder, got a link to nothing"),
    ],
)
def test_links_in_circles_or_to_nothing_are_errors(tmp_path, place, target, words):
    root = fill(tmp_path / "root", ["sub/0.png"])
    (root / place).symlink_to(target)
    with one_line_error(words):
        image_folder(root)


def test_what_is_no_image_is_ignored(tmp_path):
    folder = fill(tmp_path, ["0.png", "._1.png", ".hidden/1.png", "a.png/2.png", "empty.png/.x.png"])
    (folder / "notes.txt").write_text("no image")
    (folder / ".#lock").symlink_to("nowhere")
    os.mkfifo(folder / "pipe")
    assert image_folder(folder).names == ("0.png", "a.png/2.png")


def test_folders_that_cannot_be_listed_are_errors(tmp_path, monkeypatch):
    root, scandir = fill(tmp_path / "root", ["0.png", "sub/1.png"]), os.scandir

    def closed(path):
        if str(path).endswith("sub"):
            raise PermissionError(13, "Permission denied", str(path))
        return scandir(path)

    monkeypatch.setattr(os, "scandir", closed)
    with pytest.raises(InputError, match=r"sub: .*Permission denied"):
        image_folder(root)


def test_names_that_are_not_utf8(tmp_path):
    folder = fill(tmp_path / "db", ["0.png"])
    (folder / "0.png").rename(folder / os.fsdecode(b"caf\xe9.png"))
    assert image_folder(folder).read(0).shape == (4, 4, 3)
    (tmp_path / "gt.csv").write_bytes(b"query,database\ncaf\xe9.png,0\n")  # as a shell writes it
    truth = datasets.folder(folder, folder, ground_truth=IndexFile(tmp_path / "gt.csv")).truth
    assert truth.place(0) == 0


# Queries that are database images


@pytest.fixture
def sequence(tmp_path):
    folder = tmp_path / "sequence"
    folder.mkdir()
    for row in range(6):
        Image.new("RGB", (4, 4), (row, 0, 0)).save(folder / f"{row}.png")
    return folder


def dataset_and_identical_rows(database, queries, ground_truth="none"):
    dataset = datasets.folder(database, queries, ground_truth=ground_truth)
    return dataset, identical_rows(contents(dataset.queries), contents(dataset.database))


def test_the_same_images_are_known_by_content(sequence, tmp_path):
    assert dataset_and_identical_rows(sequence, sequence)[1] == tuple((row,) for row in range(6))
    other = tmp_path / "other"
    other.mkdir()
    for name, source in (("b.png", "4.png"), ("a.png", "1.png")):
        shutil.copy(sequence / source, other / name)
    Image.new("RGB", (4, 4), (99, 0, 0)).save(other / "c.png")
    shutil.copy(sequence / "1.png", sequence / "5.png")  # the robot stood still
    assert dataset_and_identical_rows(sequence, other)[1] == ((1, 5), (4,), ())
    (sequence / "6.png").symlink_to("nowhere")
    assert dataset_and_identical_rows(sequence, sequence)[1][6] == ()  # files that cannot be read are not the same


def test_neighbors_are_neither_candidates_nor_correct(sequence):
    dataset, rows = dataset_and_identical_rows(sequence, sequence, "order")
    for neighbors in (0, 1):
        allowed = np.abs(np.arange(6)[:, None] - np.arange(6)) > neighbors
        reduced = dataset.only.without_neighbors(6, rows, neighbors)
        np.testing.assert_array_equal(reduced.excluded.dense(), ~allowed)
        expected = dataset.truth.positives(2).dense() & allowed
        np.testing.assert_array_equal(reduced.truth.positives(2).dense(), expected)
    assert not reduced.truth.positives(1).rows.size  # all correct images are excluded
    assert dataset_and_identical_rows(sequence, sequence)[0].only.without_neighbors(6, rows, 0).truth is None


def test_two_sequences_have_no_neighbors(sequence, tmp_path):
    (tmp_path / "other").mkdir()
    Image.new("RGB", (4, 4), (99, 0, 0)).save(tmp_path / "other" / "0.png")
    dataset, rows = dataset_and_identical_rows(sequence, tmp_path / "other")
    with pytest.raises(InputError, match=r"exclude_neighbors=2: expected .*database images"):
        dataset.only.without_neighbors(6, rows, 2)
