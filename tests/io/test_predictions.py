"""Results of To-Match: predictions of VPR-methods-evaluation, re-ranked by the number of inliers."""

import os
import pickle
import zipfile

import numpy as np
import pytest

from mfvpr.io import Images, open_matches, read_shortlist
from tests.io.checks import one_line_error
from tests.needs import needs

QUERIES = ["q/1.jpg", "q/2.jpg"]
DATABASE = [f"d/{row}.jpg" for row in range(4)]


def result(num_inliers):
    """Result of an image matcher for one pair; a pair with few matches has no homography and empty arrays."""
    keypoints = np.ones((num_inliers, 2), np.float32)
    homography = np.eye(3) if num_inliers > 3 else None
    return {
        "num_inliers": num_inliers,
        "H": homography,
        "all_kpts0": np.arange(6.0).reshape(3, 2),
        "all_desc0": None,
        "matched_confidences": np.ones(3, np.float32),
        "inlier_kpts0": keypoints,
    }


def write_results(path, content, compression=zipfile.ZIP_STORED):
    """A file as `torch.save` writes it without tensors: a pickle of protocol 2 in a zip file."""
    with zipfile.ZipFile(path, "w", compression) as archive:
        archive.writestr(f"{path.stem}/data.pkl", pickle.dumps(content, protocol=2))
        archive.writestr(f"{path.stem}/byteorder", "little")
        archive.writestr(f"{path.stem}/version", "3\n")


@pytest.fixture
def folder(tmp_path):
    """Two queries, the first with the predictions 3, 2, 1, 0, the second with 0 and 1."""
    for number, rows in enumerate([(3, 2, 1, 0), (0, 1)]):
        names = "\n".join(f"/set/{DATABASE[row]}" for row in rows)
        text = f"Query path:\n/set/{QUERIES[number]}\n\nPredictions paths:\n{names}\n\nPositives paths:\n\n"
        (tmp_path / f"{number:03d}.txt").write_text(text)
    return tmp_path


def test_candidates_are_in_the_order_of_their_inliers(folder):
    """Equal numbers stay in the order of retrieval, and predictions that were not matched are no candidates."""
    write_results(folder / "000.torch", [result(count) for count in (0, 7, 7)])
    write_results(folder / "001.torch", [result(2), result(90)])
    shortlist = read_shortlist(folder, QUERIES, DATABASE)
    assert shortlist.indices.tolist() == [[2, 1, 3], [1, 0, -1]]
    assert shortlist.scores.tolist() == [[7, 7, 0], [90, 2, 0]]


@needs("torch")
def test_torch_writes_the_same(folder):
    import torch

    torch.save([result(count) for count in (0, 7, 7)], folder / "000.torch")
    torch.save([result(2), result(90)], folder / "001.torch")
    assert read_shortlist(folder, QUERIES, DATABASE).indices.tolist() == [[2, 1, 3], [1, 0, -1]]


def matched(count, shift):
    points = np.arange(2.0 * count).reshape(count, 2)
    return result(count) | {
        "matched_kpts0": points,
        "matched_kpts1": points + shift,
        "matched_confidences": None,
        "inlier_kpts0": points[1:],
        "inlier_kpts1": points[1:] + shift,
    }


def test_matches_of_predictions(folder):
    """A result for each prediction, in their order; predictions beyond the results were not matched."""
    write_results(folder / "000.torch", [matched(3, 1.0), matched(0, 1.0), matched(5, 2.0)])
    sides = Images(QUERIES), Images(DATABASE)
    files = open_matches(folder, *sides, image_size=(512, 512))
    assert [files.contains(0, row) for row in range(4)] == [False, True, True, True]
    assert not files.contains(1, 0)
    read = files.read(0, [3, 1, 0, 2])
    assert [None if each is None else len(each.mask) for each in read] == [3, 5, None, 0]
    np.testing.assert_array_equal(read[1].points1 - read[1].points0, np.full((5, 2), 2.0))
    assert read[1].image_size0.tolist() == [512, 512]
    verified = open_matches(folder, *sides, image_size=(512, 512), verified=True).read(0, [1])
    assert len(verified[0].mask) == 4
    with one_line_error("image_size"):
        open_matches(folder, *sides).read(0, [3])
    write_results(folder / "000.torch", [matched(3, 1.0)] * 5)
    with one_line_error("at most 4, got 5 results"):
        open_matches(folder, *sides)


class Malicious:
    def __reduce__(self):
        return os.system, ("touch executed",)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ([], "expected num_inliers of each prediction"),
        ([result(1)] * 5, "at most 4, got 5 results"),
        ([result(1), {"H": None}], "expected num_inliers of each prediction"),
        ([result(1) | {"num_inliers": -1}], "a whole number from 0"),
        ([result(1) | {"num_inliers": 10**400}], "a whole number from 0"),
        ({"num_inliers": 3}, "expected a list of results"),
        ([3], "expected a dictionary of To-Match"),
        ([Malicious()], "nothing was executed"),
    ],
)
def test_other_content_is_one_line(folder, monkeypatch, content, words):
    monkeypatch.chdir(folder)
    write_results(folder / "000.torch", content)
    with one_line_error(None, "000.torch", words):
        read_shortlist(folder, QUERIES, DATABASE)
    assert not (folder / "executed").exists()


def test_damaged_and_missing_files_are_one_line(folder):
    write_results(folder / "000.torch", [result(5)] * 4, zipfile.ZIP_DEFLATED)
    with one_line_error(None, "000.torch", "uncompressed"):
        read_shortlist(folder, QUERIES, DATABASE)
    write_results(folder / "000.torch", [result(5)] * 4)
    with one_line_error("expected scores of all pairs or of none"):
        read_shortlist(folder, QUERIES, DATABASE)  # the second query has no results
    whole = (folder / "000.torch").read_bytes()
    for part in (b"", whole[: len(whole) // 2], whole.replace(b"num_inliers", b"num_inlierz", 1)):
        (folder / "000.torch").write_bytes(part)
        with one_line_error(None, "000.torch"):
            read_shortlist(folder, QUERIES, DATABASE)
