"""Database and queries of one sequence: no query is its own candidate."""

import shutil

import numpy as np
import pytest
from PIL import Image

from mfvpr import InputError, datasets
from mfvpr.datasets.contents import contents, own_rows


@pytest.fixture
def sequence(tmp_path):
    folder = tmp_path / "sequence"
    folder.mkdir()
    for row in range(6):
        Image.new("RGB", (4, 4), (row, 0, 0)).save(folder / f"{row}.png")
    return folder


def dataset_and_own_rows(database, queries, ground_truth="none"):
    dataset = datasets.folder(database, queries, ground_truth=ground_truth)
    return dataset, own_rows(contents(dataset.queries), contents(dataset.database))


def test_the_same_images_are_known_by_content(sequence, tmp_path):
    assert dataset_and_own_rows(sequence, sequence)[1] == tuple((row,) for row in range(6))
    other = tmp_path / "other"
    other.mkdir()
    for name, source in (("b.png", "4.png"), ("a.png", "1.png")):
        shutil.copy(sequence / source, other / name)
    Image.new("RGB", (4, 4), (99, 0, 0)).save(other / "c.png")
    shutil.copy(sequence / "1.png", sequence / "5.png")  # the robot stood still
    assert dataset_and_own_rows(sequence, other)[1] == ((1, 5), (4,), ())
    (sequence / "6.png").symlink_to("nowhere")
    assert dataset_and_own_rows(sequence, sequence)[1][6] == ()  # files that cannot be read are not the same


def test_neighbors_are_neither_candidates_nor_correct(sequence):
    dataset, rows = dataset_and_own_rows(sequence, sequence, "order")
    for neighbors in (0, 1):
        allowed = np.abs(np.arange(6)[:, None] - np.arange(6)) > neighbors
        reduced = dataset.only.without_neighbors(6, rows, neighbors)
        np.testing.assert_array_equal(reduced.excluded.dense(), ~allowed)
        expected = dataset.truth.positives(2).dense() & allowed
        np.testing.assert_array_equal(reduced.truth.positives(2).dense(), expected)
    assert not reduced.truth.positives(1).rows.size  # all correct images are excluded
    assert dataset_and_own_rows(sequence, sequence)[0].only.without_neighbors(6, rows, 0).truth is None


def test_two_sequences_have_no_neighbors(sequence, tmp_path):
    (tmp_path / "other").mkdir()
    Image.new("RGB", (4, 4), (99, 0, 0)).save(tmp_path / "other" / "0.png")
    dataset, rows = dataset_and_own_rows(sequence, tmp_path / "other")
    with pytest.raises(InputError, match=r"exclude_neighbors=2: expected .*database images"):
        dataset.only.without_neighbors(6, rows, 2)
