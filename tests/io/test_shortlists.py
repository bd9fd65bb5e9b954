"""Shortlists: pairs of hloc and kapture, predictions in npz and of VPR-methods-evaluation, results of To-Match."""

import os
import pickle
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mfvpr import InputError, Shortlist
from mfvpr.io import Images, open_matches, read_shortlist, write_shortlist
from tests.io.checks import one_line_error
from tests.io.match_files import POINTS, pair_of
from tests.needs import needs

QUERIES = ["q/1.jpg", "q/2.jpg", "q/3.jpg"]
DATABASE = ["d/1.jpg", "d/2.jpg", "d/3.jpg", "d/4.jpg"]
HLOC = ["q/1.jpg d/2.jpg", "q/1.jpg d/1.jpg", "q/3.jpg d/3.jpg"]
EXPECTED = [[1, 0], [-1, -1], [2, -1]]


def shortlist_of(indices, scores=1.0):
    """Candidates and their scores; rows of -1 are none."""
    indices = np.array(indices)
    return Shortlist(indices=indices, scores=np.full(indices.shape, scores), mask=indices >= 0)


def read(tmp_path, text, queries=QUERIES, database=DATABASE, **settings):
    path = tmp_path / "pairs.txt"
    path.write_text(text, encoding="utf-8", newline="")
    return read_shortlist(path, queries, database, **settings)


@pytest.mark.parametrize("text", ["\n".join(HLOC), "\r\n".join(HLOC) + "\r\n\r\n", "\ufeff" + "\n\n".join(HLOC)])
def test_pairs_of_hloc(tmp_path, text):
    """Without scores, the places in the list tell: C, C - 1, ..."""
    shortlist = read(tmp_path, text)
    assert shortlist.indices.tolist() == EXPECTED
    assert shortlist.scores.tolist() == [[2, 1], [0, 0], [2, 0]]
    assert shortlist.mask.tolist() == [[True, True], [False, False], [True, False]]
    assert (shortlist.indices.dtype, shortlist.scores.dtype, shortlist.mask.dtype) == (np.int32, np.float32, bool)


def test_pairs_of_kapture_and_of_patch_netvlad(tmp_path):
    """Patch-NetVLAD writes full paths without scores."""
    lines = ["# kapture format: 1.0", "# query_image, map_image, score"]
    scored = ["q/1.jpg, d/2.jpg, 0.75", "q/3.jpg, d/my place.jpg, -1e-3", "q/1.jpg,d/4.jpg,0.5"]
    shortlist = read(tmp_path, "\n".join(lines + scored), database=[*DATABASE[:2], "d/my place.jpg", "d/4.jpg"])
    assert shortlist.indices.tolist() == [[1, 3], [-1, -1], [2, -1]]
    np.testing.assert_array_equal(shortlist.scores, np.float32([[0.75, 0.5], [0, 0], [-1e-3, 0]]))
    full_paths = ["/data/set/q/1.jpg, /data/set/d/2.jpg", "/data/set/q/1.jpg, /data/set/d/1.jpg\n"]
    shortlist = read(tmp_path, "\n".join(lines + full_paths))
    assert shortlist.indices.tolist() == [[1, 0], [-1, -1], [-1, -1]]


def write_predictions(folder, number, query, predictions, positives=()):
    """A file of VPR-methods-evaluation; it has no positives if the data set has no labels."""
    parts = ["Query path:", f"{query}\n", "Predictions paths:", "\n".join(predictions) + "\n"]
    parts += ["Positives paths:", "\n".join(positives) + "\n"] if positives else []
    (folder / f"{number:03d}.txt").write_text("\n".join(parts))


@pytest.mark.parametrize("positives", [(), ("/set/d/4.jpg",)])
def test_predictions_of_vpr_methods_evaluation(tmp_path, positives):
    """Only wrongly predicted queries may have a file."""
    write_predictions(tmp_path, 2, "/set/q/3.jpg", ["/set/d/3.jpg"], positives)
    write_predictions(tmp_path, 0, "/set/q/1.jpg", ["/set/d/2.jpg", "/set/d/1.jpg"], positives)
    (tmp_path / "000.jpg").write_bytes(b"a picture of the predictions")
    assert read_shortlist(tmp_path, QUERIES, DATABASE).indices.tolist() == EXPECTED


PREDICTIONS = "Query path:\nq/1.jpg\n\nPredictions paths:\n"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([], "expected text files of predictions, one for each query, got none"),
        (["q/1.jpg d/1.jpg\n"], r"000\.txt: expected one path below 'Query path:'"),
        ([PREDICTIONS], "one or more below 'Predictions paths:'"),
        ([PREDICTIONS + "d/1.jpg\n"] * 2, r"expected another query than in 000\.txt"),
        ([PREDICTIONS + "d/9.jpg\n"], r"'d/9\.jpg', which none of the 4 has"),
        ("q/1.jpg d/9.jpg", r"database image, got 'd/9\.jpg'"),
        ("q/1.jpg d/1.jpg\nd/1.jpg q/1.jpg", r"query image, got 'd/1\.jpg'"),
        ("q/1.jpg", "line 1: expected 'query database'"),
        ("q/1.jpg d/1.jpg 0.5", "line 1: expected 'query database'"),
        ("q/1.jpg, d/1.jpg, 1_0", "line 1: expected 'query database'"),
        ("q/1.jpg, d/1.jpg, 0.5\nq/2.jpg, d/2.jpg", "expected scores of all pairs or of none"),
        ("q/1.jpg, d/1.jpg, 0.5\nq/1.jpg, d/2.jpg, 0.6", r"q/1\.jpg: .*scores.* descend"),
        ("q/1.jpg, d/1.jpg, nan", r"q/1\.jpg: expected finite scores"),
        ("# nothing but a comment", "3 queries, got none"),
        ({}, r"predictions \[3, K\].* got float64\[0\]"),
        ({"predictions": np.zeros((3, 2))}, r"got float64\[3, 2\]"),
        ({"predictions": [[0, 1], [4, 0], [0, 1]]}, "rows from 0 to 3 or -1"),
        ({"predictions": [[0, -2], [0, 0], [0, 1]]}, "rows from 0 to 3 or -1"),
        ({"predictions": [[0], [1], [0]], "scores": [["a"], ["b"], ["c"]]}, r"as many scores, got .*<U1"),
        ({"predictions": [[0, 1]] * 3, "scores": [[1.0, 2]] * 3}, r"q/1\.jpg: expected .* scores that descend"),
        ({"predictions": np.full((3, 3), -1)}, "got none at all"),
        ({"predictions": np.array([[{}], [1], [2]], object)}, "cannot be read"),
    ],
)
def test_what_is_no_shortlist(tmp_path, content, message):
    """Files of a folder, a text file of pairs, or arrays."""
    path = tmp_path / (
        "pairs.npz" if isinstance(content, dict) else "pairs.txt" if isinstance(content, str) else "preds"
    )
    if isinstance(content, dict):
        np.savez(path, **content)
    elif isinstance(content, str):
        path.write_text(content)
    else:
        path.mkdir()
        for number, text in enumerate(content):
            (path / f"{number:03d}.txt").write_text(text)
    with one_line_error(message, path.name):
        read_shortlist(path, QUERIES, DATABASE)


def test_as_many_candidates_as_asked_for(tmp_path):
    pairs = "q/1.jpg d/2.jpg\nq/1.jpg d/1.jpg\nq/2.jpg d/1.jpg"
    shortlist = read(tmp_path, pairs, num_candidates=1)
    assert shortlist.indices.tolist() == [[1], [0], [-1]]
    assert shortlist.scores.tolist() == [[1], [1], [0]]
    shortlist = read(tmp_path, pairs, num_candidates=3)
    assert shortlist.indices.tolist() == [[1, 0, -1], [0, -1, -1], [-1, -1, -1]]
    assert shortlist.scores.tolist() == [[3, 2, 0], [3, 0, 0], [0, 0, 0]]
    with pytest.raises(InputError, match="num_candidates=0: expected at least 1"):
        read(tmp_path, pairs, num_candidates=0)


def test_a_candidate_twice_counts_where_it_comes_first(tmp_path):
    shortlist = read(tmp_path, "q/1.jpg d/2.jpg\nq/1.jpg d/1.jpg\nq/1.jpg d/2.jpg")
    assert shortlist.indices.tolist() == [[1, 0], [-1, -1], [-1, -1]]
    scored = read(tmp_path, "q/1.jpg, d/2.jpg, 0.75\nq/1.jpg, d/1.jpg, 0.5\nq/1.jpg, d/2.jpg, 0.25")
    assert scored.scores.tolist() == [[0.75, 0.5], [0, 0], [0, 0]]
    np.savez(tmp_path / "p.npz", predictions=[[1, -1, 1, 0], [-1, -1, -1, -1], [0, 2, 2, 0]])
    shortlist = read_shortlist(tmp_path / "p.npz", QUERIES, DATABASE)
    assert shortlist.indices.tolist() == [[1, 0], [-1, -1], [0, 2]]


def shortlists():
    """Candidates of 3 queries among 4 images, in any order, some with none."""
    rows = st.lists(st.lists(st.integers(0, 3), unique=True, max_size=4), min_size=3, max_size=3).filter(any)
    return st.tuples(rows, st.integers(0, 2**32 - 1))


@pytest.mark.parametrize("file, layout", [("p.txt", "hloc"), ("p.txt", "kapture"), ("p.npz", "hloc"), ("p", "preds")])
@given(shortlists())
def test_written_and_read(tmp_path_factory, file, layout, drawn):
    rows, seed = drawn
    depth = max(map(len, rows))
    indices = np.array([row + [-1] * (depth - len(row)) for row in rows], np.int32)
    scores = -np.sort(-np.random.default_rng(seed).normal(size=indices.shape).astype(np.float32) * 1e-3)
    mask = indices >= 0
    path = tmp_path_factory.mktemp("p") / file
    write_shortlist(path, shortlist_of(indices, np.where(mask, scores, np.nan)), QUERIES, DATABASE, layout=layout)
    shortlist = read_shortlist(path, QUERIES, DATABASE)
    np.testing.assert_array_equal(shortlist.indices, indices)
    np.testing.assert_array_equal(shortlist.mask, mask)
    ranks = np.where(mask, depth - np.arange(depth), 0)
    expected = ranks if (file, layout) in (("p.txt", "hloc"), ("p", "preds")) else np.where(mask, scores, 0)
    np.testing.assert_array_equal(shortlist.scores, expected)
    assert [child.name for child in path.parent.iterdir()] == [file]


@pytest.mark.parametrize("positives", [None, [[2, 3], [], []]])
def test_to_match_reads_what_is_written(tmp_path, positives):
    """Its own reading: the query in line 2, predictions from line 5 to the next empty line, numbers as file names."""
    shortlist = shortlist_of([[1, 0], [-1, -1], [2, -1]])
    write_shortlist(tmp_path / "preds", shortlist, QUERIES, DATABASE, layout="preds", positives=positives)
    texts = {int(path.stem): path.read_text().splitlines() for path in (tmp_path / "preds").glob("*.txt")}
    predictions = {number: (lines[1], lines[4 : lines.index("", 4)]) for number, lines in texts.items()}
    expected = {0: ("q/1.jpg", ["d/2.jpg", "d/1.jpg"]), 2: ("q/3.jpg", ["d/3.jpg"])}
    assert predictions == expected
    listed = [] if positives is None else ["Positives paths:", "d/3.jpg", "d/4.jpg", ""]
    assert texts[0][7:] == listed
    assert texts[2][6:] == listed[::3]


def test_what_cannot_be_written(tmp_path):
    shortlist, path = shortlist_of([[3]]), tmp_path / "p.txt"
    for names, message in (
        ((QUERIES, DATABASE), "1 queries, got 3"),
        ((QUERIES[:1], DATABASE[:3]), "rows below 3, got 3"),
        *(((["a\nb"], DATABASE), "names that fit"), ((["#a"], DATABASE), "names that fit")),
    ):
        with pytest.raises(InputError, match=message):
            write_shortlist(path, shortlist, *names)
    wrong, ascending = (shortlist_of([[0, 1]], [[0.5, score]]) for score in (np.nan, 0.7))
    for shortlist, file in ((wrong, "p.txt"), (ascending, "p.txt"), (ascending, "p.npz")):
        with pytest.raises(InputError, match=r"q/1\.jpg: expected finite scores that descend"):
            write_shortlist(tmp_path / file, shortlist, QUERIES[:1], DATABASE, layout="kapture")
    assert not list(tmp_path.iterdir())
    write_shortlist(path, ascending, QUERIES[:1], DATABASE)
    assert read_shortlist(path, QUERIES[:1], DATABASE).scores.tolist() == [[2, 1]]
    with pytest.raises(InputError, match="expected a new file"):
        write_shortlist(tmp_path, ascending, QUERIES[:1], DATABASE, layout="preds")


# Results of To-Match and vismatch


def result(num_inliers):
    """Result of an image matcher for one pair; a pair with few matches has no homography and empty arrays."""
    points = np.arange(2.0 * num_inliers).reshape(num_inliers, 2)
    return {
        "num_inliers": num_inliers,
        "H": np.eye(3) if num_inliers > 3 else None,
        "all_desc0": None,
        "matched_kpts0": points,
        "matched_kpts1": points + 2,
        "matched_confidences": None,
        "inlier_kpts0": points[1:],
        "inlier_kpts1": points[1:] + 2,
    }


def write_results(path, content, compression=zipfile.ZIP_STORED):
    """A file as `torch.save` writes it without tensors: a pickle of protocol 2 in a zip file."""
    with zipfile.ZipFile(path, "w", compression) as archive:
        archive.writestr(f"{path.stem}/data.pkl", pickle.dumps(content, protocol=2))
        archive.writestr(f"{path.stem}/byteorder", "little")


@pytest.fixture
def preds(tmp_path):
    """Two queries, the first with the predictions 4, 3, 2, 1, the second with 1 and 2."""
    for number, rows in enumerate([(3, 2, 1, 0), (0, 1)]):
        write_predictions(tmp_path, number, f"/set/{QUERIES[number]}", [f"/set/{DATABASE[row]}" for row in rows])
    return tmp_path


@pytest.mark.parametrize("writer", [write_results, pytest.param("torch", marks=needs("torch"))])
def test_candidates_are_in_the_order_of_their_inliers(preds, writer):
    """Equal numbers stay in the order of retrieval, and predictions that were not matched are no candidates."""
    for number, counts in enumerate([(0, 7, 7), (2, 90)]):
        path, results = preds / f"{number:03d}.torch", [result(count) for count in counts]
        if writer == "torch":
            import torch

            torch.save(results, path)
        else:
            write_results(path, results)
    shortlist = read_shortlist(preds, QUERIES, DATABASE)
    assert shortlist.indices.tolist() == [[2, 1, 3], [1, 0, -1], [-1, -1, -1]]
    assert shortlist.scores.tolist() == [[7, 7, 0], [90, 2, 0], [0, 0, 0]]


def test_matches_of_predictions(preds):
    """A result for each prediction, in their order; predictions beyond the results were not matched."""
    write_results(preds / "000.torch", [result(3), result(0), result(5)])
    sides = Images(QUERIES[:2]), Images(DATABASE)
    files = open_matches(preds, *sides, image_size=(512, 512))
    assert [files.contains(0, row) for row in range(4)] == [False, True, True, True]
    assert not files.contains(1, 0)
    read = files.read(0, [3, 1, 0, 2])
    assert [None if each is None else len(each.mask) for each in read] == [3, 5, None, 0]
    np.testing.assert_array_equal(read[1].points1 - read[1].points0, np.full((5, 2), 2.0))
    assert read[1].image_size0.tolist() == [512, 512]
    verified = open_matches(preds, *sides, image_size=(512, 512), verified=True).read(0, [1])
    assert len(verified[0].mask) == 4
    with one_line_error("image_size"):
        open_matches(preds, *sides).read(0, [3])


class Command:
    def __reduce__(self):
        return os.system, ("touch executed",)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ([], "expected num_inliers of each prediction"),
        ([result(1)] * 5, "for each prediction in the text file, got 5 results"),
        ([result(1), {"H": None}], "expected num_inliers of each prediction"),
        ([result(1) | {"num_inliers": -1}], "a whole number from 0"),
        ({"num_inliers": 3}, "expected a list of results"),
        ([3], "expected a dictionary of To-Match"),
        ([Command()], "nothing was executed"),
    ],
)
def test_other_content_is_one_line(preds, monkeypatch, content, words):
    monkeypatch.chdir(preds)
    write_results(preds / "000.torch", content)
    with one_line_error(None, "000.torch", words):
        read_shortlist(preds, QUERIES, DATABASE)
    assert not (preds / "executed").exists()


def test_damaged_and_missing_files_are_one_line(preds):
    path = preds / "000.torch"
    write_results(path, [result(5)] * 4, zipfile.ZIP_DEFLATED)
    compressed = path.read_bytes()
    write_results(path, [result(5)] * 4)
    with one_line_error("expected scores of all pairs or of none"):
        read_shortlist(preds, QUERIES, DATABASE)  # the second query has no results
    whole = path.read_bytes()
    for content in (b"", compressed, whole[: len(whole) // 2], whole.replace(b"num_inliers", b"num_inlierz", 1)):
        path.write_bytes(content)
        with one_line_error(None, "000.torch"):
            read_shortlist(preds, QUERIES, DATABASE)


def test_results_of_vismatch(tmp_path):
    names = {"img0_path": Path("/x/q1.jpg"), "img1_path": Path("/y/d1.jpg")}
    content = names | {"matched_kpts0": POINTS, "matched_kpts1": POINTS, "H": None, "im_size": 64}
    path = tmp_path / "output_0_result.torch"
    write_results(path, content)
    assert len(pair_of(tmp_path).mask) == 3
    for key, value, message in [
        ("H", Command(), "nothing was executed"),
        ("img1_path", Path("/y/other.jpg"), "got none of their names"),
        ("matched_kpts1", [1, 2], "points"),
        ("im_size", [64, 64, 64], "im_size"),
    ]:
        write_results(path, {**content, key: value})
        with one_line_error(message):
            pair_of(tmp_path)
