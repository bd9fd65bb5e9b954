"""Shortlists: pairs of hloc and kapture, predictions in npz."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mfvpr import InputError, Ranking, Shortlist
from mfvpr.io import read_shortlist, reranked_shortlist, write_shortlist
from tests.io.checks import one_line_error

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
    folder.mkdir(exist_ok=True)
    parts = ["Query path:", f"{query}\n", "Predictions paths:", "\n".join(predictions) + "\n"]
    parts += ["Positives paths:", "\n".join(positives) + "\n"] if positives else []
    (folder / f"{number:03d}.txt").write_text("\n".join(parts))
    return folder


@pytest.mark.parametrize("positives", [(), ("/set/d/4.jpg",)])
def test_predictions_of_vpr_methods_evaluation(tmp_path, positives):
    """Only wrongly predicted queries may have a file."""
    write_predictions(tmp_path / "preds", 2, "/set/q/3.jpg", ["/set/d/3.jpg"], positives)
    folder = write_predictions(tmp_path / "preds", 0, "/set/q/1.jpg", ["/set/d/2.jpg", "/set/d/1.jpg"], positives)
    (folder / "000.jpg").write_bytes(b"a picture of the predictions")
    assert read_shortlist(folder, QUERIES, DATABASE).indices.tolist() == EXPECTED


@pytest.mark.parametrize(
    ("texts", "words"),
    [
        ([], "expected text files of predictions, one for each query, got none"),
        (["q/1.jpg d/1.jpg\n"], "000.txt: expected one path below 'Query path:'"),
        (["Query path:\nq/1.jpg\n\nPredictions paths:\n"], "one or more below 'Predictions paths:'"),
        (["Query path:\nq/1.jpg\n\nPredictions paths:\nd/1.jpg\n"] * 2, "expected another query than in 000.txt"),
        (["Query path:\nq/1.jpg\n\nPredictions paths:\nd/9.jpg\n"], "'d/9.jpg', which none of the 4 has"),
    ],
)
def test_other_folders_are_one_line(tmp_path, texts, words):
    for number, text in enumerate(texts):
        (tmp_path / f"{number:03d}.txt").write_text(text)
    with one_line_error(None, words):
        read_shortlist(tmp_path, QUERIES, DATABASE)


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


@pytest.mark.parametrize(
    "text, message",
    [
        ("q/1.jpg d/9.jpg", r"database image, got 'd/9\.jpg'"),
        ("q/1.jpg d/1.jpg\nd/1.jpg q/1.jpg", r"query image, got 'd/1\.jpg'"),
        ("q/1.jpg", "line 1: expected 'query database'"),
        ("q/1.jpg d/1.jpg 0.5", "line 1: expected 'query database'"),
        ("q/1.jpg, d/1.jpg, 1_0", "line 1: expected 'query database'"),
        ("q/1.jpg, d/1.jpg, 0.5\nq/2.jpg, d/2.jpg", "expected scores of all pairs or of none"),
        ("q/1.jpg, d/1.jpg, 0.5\nq/1.jpg, d/2.jpg, 0.6", r"q/1\.jpg: .*scores.* descend"),
        ("q/1.jpg, d/1.jpg, nan", r"q/1\.jpg: expected finite scores"),
        ("# nothing but a comment", "3 queries, got none"),
        ("", "got none at all"),
        ("x" * 500, r"got 'x{40}\.\.\. \(500 characters\)'"),
    ],
)
def test_lines_that_are_no_pairs(tmp_path, text, message):
    with one_line_error(message, "pairs.txt"):
        read(tmp_path, text)


@pytest.mark.parametrize(
    "arrays, message",
    [
        ({}, r"predictions \[2, K\].* got float64\[0\]"),
        ({"predictions": np.zeros((2, 2))}, r"got float64\[2, 2\]"),
        ({"predictions": [[0, 1], [4, 0]]}, "0 to 3, .*-1 .*got 0 to 4"),
        ({"predictions": [[0, -2], [0, 0]]}, "got -2 to 0"),
        ({"predictions": [[0], [1]], "scores": [["a"], ["b"]]}, r"scores .*got <U1"),
        ({"predictions": [[0, 1], [1, 0]], "scores": [[1.0, 2], [1, 2]]}, r"q/1\.jpg: expected scores that descend"),
        ({"predictions": [[0, 1], [1, 0]], "scores": [[1.0, np.nan], [1, 2]]}, "expected finite scores"),
        ({"predictions": np.full((2, 3), -1)}, "got none at all"),
        ({"predictions": np.array([[{}], [1]], object)}, "cannot be read"),
    ],
)
def test_predictions_that_cannot_be_used(tmp_path, arrays, message):
    np.savez(tmp_path / "p.npz", **arrays)
    with one_line_error(message, "p.npz"):
        read_shortlist(tmp_path / "p.npz", QUERIES[:2], DATABASE)


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


def test_a_ranking_is_written_as_a_shortlist(tmp_path):
    shortlist = shortlist_of([[3, 1, 0], [2, -1, -1]])
    ranking = Ranking(order=np.array([[2, 0, 1], [0, 1, 2]]), scores=np.float32([[5, 3, 9], [1, 0, 0]]))
    write_shortlist(tmp_path / "p.npz", reranked_shortlist(shortlist, ranking), QUERIES[:2], DATABASE)
    with np.load(tmp_path / "p.npz") as arrays:
        assert arrays["predictions"].tolist() == [[0, 3, 1], [2, -1, -1]]
        assert arrays["scores"].tolist() == [[9, 5, 3], [1, 0, 0]]
        assert (arrays["predictions"].dtype, arrays["scores"].dtype) == (np.int32, np.float32)


def test_what_cannot_be_written(tmp_path):
    shortlist, path = shortlist_of([[3]]), tmp_path / "p.txt"
    for names, message in (
        ((QUERIES, DATABASE), "1 queries, got 3"),
        ((QUERIES[:1], DATABASE[:3]), "rows below 3, got 3"),
        *(((["a\nb"], DATABASE), "names that fit"), ((["a b"], DATABASE), "names that fit")),
        *(((["#a"], DATABASE), "names that fit"), ((["a "], DATABASE), "names that fit")),
    ):
        with pytest.raises(InputError, match=message):
            write_shortlist(path, shortlist, *names)
    with pytest.raises(InputError, match=r"layout='csv': .*hloc, kapture"):
        write_shortlist(path, shortlist, QUERIES[:1], DATABASE, layout="csv")  # type: ignore[arg-type]
    wrong, ascending = (shortlist_of([[0, 1]], [[0.5, score]]) for score in (np.nan, 0.7))
    for shortlist, message in ((wrong, "finite scores"), (ascending, "scores that descend")):
        for file, layout in (("p.txt", "kapture"), ("p.npz", "hloc")):
            with pytest.raises(InputError, match=rf"q/1\.jpg: expected {message}"):
                write_shortlist(tmp_path / file, shortlist, QUERIES[:1], DATABASE, layout=layout)
    assert not list(tmp_path.iterdir())
    write_shortlist(path, ascending, QUERIES[:1], DATABASE)
    assert read_shortlist(path, QUERIES[:1], DATABASE).scores.tolist() == [[2, 1]]
    with pytest.raises(InputError, match="expected a new file"):
        write_shortlist(tmp_path, ascending, QUERIES[:1], DATABASE, layout="preds")
