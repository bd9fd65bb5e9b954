"""Ground truth of every kind, and its faults."""

import json
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mfvpr import InputError, datasets
from mfvpr.datasets import AllowedTruth, FrameTruth, IndexFile, LabelFiles, Positives, RadiusTruth, radius_positives
from mfvpr.datasets.ground_truth import threshold_words
from mfvpr.utils.files import write_text
from tests import oracles
from tests.builders import fill
from tests.io.checks import one_line_error
from tests.shapes import unchecked_shapes


@pytest.fixture
def folders(tmp_path):
    return fill(tmp_path / "db", ["0.png", "1.png", "2.png"]), fill(tmp_path / "q", ["a.png", "b.png"])


def test_order(folders):
    database, queries = folders
    with pytest.raises(InputError, match=r"ground_truth=order: .*queries .*database images, got 2 and 3"):
        datasets.folder(database, queries, ground_truth="order")
    truth = datasets.folder(database, database, ground_truth="order").truth
    np.testing.assert_array_equal(truth.positives(0).dense(), np.eye(3, dtype=bool))
    assert truth.positives(1).counts.sum() == 7
    for unknown in ("none", None):
        assert datasets.folder(database, queries, ground_truth=unknown).truth is None


@pytest.mark.parametrize(
    ("suffix", "content"),
    [
        ("csv", "query,database\na.png,2.png\nb.png,\na.png,0.png\n"),
        ("csv", "Reference,Live\n02,0\n,1\n0,0\n"),
        ("csv", "database,extra,query\n2.png,x,a.png\n,x,b.png\n0,x,a.png\n"),
        ("csv", "\ufeffquery,database\r\n0,2\r\n1,\r\n0,0\r\n"),
        ("json", json.dumps([[0, [2, 0]], [1, []]])),
        ("npz", {"query": np.array([0, 1, 0]), "database": np.array(["2", "", "0.png"])}),
        ("npz", {"utmQ": np.array([[0, 0], [60, 0]]), "utmDb": np.array([[0, 25], [0, 26], [25, 0]]), "other": None}),
    ],
)
def test_pairs_or_positions_of_a_file(folders, tmp_path, suffix, content):
    path = tmp_path / f"gt.{suffix}"
    np.savez(path, **content) if suffix == "npz" else write_text(path, content)
    truth = datasets.folder(*folders, ground_truth=IndexFile(path)).truth
    np.testing.assert_array_equal(truth.positives(25).dense(), [[True, False, True], [False, False, False]])
    if "utmQ" in content:
        with one_line_error(f"{path}: expected pairs of images, got positions"):
            datasets.folder(*folders, ground_truth="none", among=path)
    else:
        excluded = datasets.folder(*folders, ground_truth="none", among=path).only.excluded
        np.testing.assert_array_equal(~excluded.dense(), truth.positives(0).dense())


def test_utm_reads_the_file_name_only(tmp_path):
    database = fill(tmp_path / "at@home@1@" / "db", ["@0500000.00@4400000.00@.png", "x/@0500030.00@4400000.00@y@.png"])
    queries = fill(tmp_path / "at@home@1@" / "q", ["@0500010.00@4400000.00@@@@.png"])
    truth = datasets.folder(database, queries, ground_truth="utm").truth
    assert truth.unit == "m"
    np.testing.assert_array_equal(truth.positives(15).dense(), [[True, False]])
    np.testing.assert_array_equal(truth.positives(25).dense(), [[True, True]])


@pytest.mark.parametrize("kind", ["names", "index", 5])
def test_ground_truth_must_be_chosen_even_if_counts_agree(folders, kind):
    with one_line_error(r"order \(.*index \(.*utm \(.*label \(.*none \("):
        datasets.folder(folders[0], folders[0], ground_truth=kind)


def test_an_index_file_says_all_that_is_right_unless_neighbors_count(folders, tmp_path):
    write_text(tmp_path / "gt.csv", "query,database\na.png,2.png\nb.png,\n")
    exact, widened = (
        datasets.folder(*folders, ground_truth=IndexFile(tmp_path / "gt.csv", is_widened)).truth
        for is_widened in (False, True)
    )
    for tolerance in (0, 1, 5):
        np.testing.assert_array_equal(exact.positives(tolerance).dense(), [[False, False, True], [False] * 3])
    np.testing.assert_array_equal(widened.positives(1).dense(), [[False, True, True], [False] * 3])
    assert exact.thresholds(tolerances=[5, 1, 2, 1], radius=25.0) == [0]
    assert widened.thresholds(tolerances=[5, 1, 2, 1], radius=25.0) == [1, 2, 5]
    assert (exact.place(0), exact.place(1), widened.place(0), widened.place(1)) == (2, None, 2, None)
    assert [threshold_words(truth.unit, 2) for truth in (exact, widened)] == ["", " ±2"]


def labels(tmp_path, database, queries):
    write_text(tmp_path / "db.csv", "name,label\n" + database)
    write_text(tmp_path / "q.csv", "name,label\n" + queries)
    return LabelFiles(tmp_path / "q.csv", tmp_path / "db.csv")


def test_labels(folders, tmp_path):
    files = labels(tmp_path, "2.png, hall\n0.png,kitchen\n1.png,hall \n", "b.png,attic\na.png,hall\n")
    truth = datasets.folder(*folders, ground_truth=files).truth
    np.testing.assert_array_equal(truth.positives(5).dense(), [[False, True, True], [False, False, False]])
    assert (truth.place(0), truth.place(1)) == (1, None)
    assert truth.thresholds(tolerances=[1, 2], radius=25.0) == [0]
    truth = datasets.folder(
        *folders, ground_truth=labels(tmp_path, "0.png,\n1.png,\n2.png,x\n", "a.png,\nb.png,x\n")
    ).truth
    np.testing.assert_array_equal(truth.positives(0).dense(), [[False, False, False], [False, False, True]])


@pytest.mark.parametrize(
    ("database", "words"),
    [
        ("0.png,x\n1.png,x\n", "of all 3 images, got 2; the first without is 2.png"),
        ("0.png,x\n1.png,x\n0.png,x\n2.png,x\n", "entry 3: expected the path of one image, each once, got '0.png'"),
        ("0.png,x\n1.png,x\n2.png,x\n9.png,x\n", "entry 4: expected the path of one image, each once, got '9.png'"),
    ],
)
def test_wrong_labels_are_errors_of_one_line(folders, tmp_path, database, words):
    files = labels(tmp_path, database, "a.png,x\nb.png,x\n")
    with one_line_error(None, words, str(tmp_path / "db.csv")):
        datasets.folder(*folders, ground_truth=files)


def test_a_name_in_two_folders_needs_its_path(tmp_path):
    both = fill(tmp_path / "both", ["left/0.png", "right/0.png"])
    with pytest.raises(InputError, match="expected the path of one image"):
        datasets.folder(both, both, ground_truth=labels(tmp_path, "0.png,x\n", "left/0.png,x\nright/0.png,y\n"))
    full = "left/0.png,x\nright/0.png,y\n"
    truth = datasets.folder(both, both, ground_truth=labels(tmp_path, full, full)).truth
    np.testing.assert_array_equal(truth.positives(0).dense(), np.eye(2, dtype=bool))


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 3.0, 25.0, 1e6]))
def test_a_radius_is_a_loop_over_all_pairs(seed, radius):
    rng = np.random.default_rng(seed)
    queries, database = (rng.uniform(0, 100, (count, 2)) for count in (rng.integers(300), rng.integers(20)))
    database[: len(queries) // 2] = queries[: len(database)][: len(queries) // 2]  # some at distance 0
    truth = RadiusTruth(queries, database)
    np.testing.assert_array_equal(truth.positives(radius).dense(), oracles.radius_positives(queries, database, radius))


@pytest.mark.parametrize("dtype", ["u1", "i1", "u4", "i8", "u8", "f4"])
def test_positions_of_any_numbers_do_not_wrap_around(dtype):
    queries, database = np.array([[3, 100]], dtype), np.array([[103, 0], [3, 99], [0, 104]], dtype)
    truth = RadiusTruth(queries, database)
    np.testing.assert_array_equal(truth.distance(0), [np.hypot(100, 100), 1, 5])
    assert truth.positives(5).of(0).tolist() == [1, 2]
    np.testing.assert_array_equal(radius_positives(queries, database, radius=5), [[False, True, True]])


@pytest.mark.parametrize("first", [np.nan, np.inf, 1e10, "a", 1j, True])
def test_positions_without_a_meaning_are_errors(first):
    place, xy = np.zeros((1, 2)), [[first, first]]
    with unchecked_shapes():
        for call in (lambda: RadiusTruth(np.array(xy), place), lambda: radius_positives(np.array(xy), place)):
            with pytest.raises(InputError, match=r"query_xy: expected positions \[1, 2\] .*, got .*; remove images"):
                call()
        with pytest.raises(InputError, match=r"database_xy: expected positions \[1, 2\] .*, got float64\[1, 3\]"):
            RadiusTruth(place, np.zeros((1, 3)))


def test_memory_grows_with_the_positives_not_with_all_pairs():
    xy = np.stack([10.0 * np.arange(50_000), np.zeros(50_000)], axis=1)
    tracemalloc.start()
    positives = RadiusTruth(xy, xy).positives(25.0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    np.testing.assert_array_equal(positives.counts, [3, 4, *[5] * 49_996, 4, 3])
    assert positives.of(1500).tolist() == [1498, 1499, 1500, 1501, 1502]  # of the second block
    assert peak < 2**26  # as float64, all distances would take 20 GB


@pytest.mark.parametrize("row", [-1, 3])
def test_frames_beyond_the_database_are_errors(row):
    got = f"{min(row, 0)} to {max(row, 0)}"
    with pytest.raises(InputError, match=f"rows: expected rows of a database of 3 images, got {got}"):
        FrameTruth(((0,), (), (row,)), 3)


@pytest.mark.parametrize("tolerance", [0, 1, 4, 10**6])
def test_frames_are_a_loop_over_all_pairs(tolerance):
    truth = FrameTruth(((3, 7), (), (0,), (9,), (7, 3, 7, 4), (0, 0)), 10)  # a place that is named twice counts once
    for query, rows in enumerate(truth.rows):
        expected = [any(abs(row - place) <= tolerance for place in rows) for row in range(10)]
        np.testing.assert_array_equal(truth.positives(tolerance).dense()[query], expected)
        np.testing.assert_array_equal(truth.distance(query) <= tolerance, expected)


def test_excluded_images_are_not_correct():
    excluded = np.array([[False, True, True, False], [True, False, False, False]])
    truth = AllowedTruth(FrameTruth(((1,), (0,)), 4), Positives(excluded))
    np.testing.assert_array_equal(truth.positives(1).dense(), [[True] + [False] * 3, [False, True, False, False]])
    np.testing.assert_array_equal(truth.shows_place(1).dense(), [[True] * 3 + [False], [True, True, False, False]])
    assert not truth.positives(0).rows.size
    np.testing.assert_array_equal(truth.shows_place(0).dense(), excluded)  # more than the tolerance alone
    assert (truth.place(0), truth.place(1), truth.unit) == (0, 1, "frames")
    assert AllowedTruth(truth, Positives(np.ones_like(excluded))).place(0) is None


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("missing.csv", None, "got nothing"),
        ("gt.csv", f"query,database\n0,0\n1,{5000 * '1'}\n", "(5000 characters)'"),
        ("gt.txt", "x", "named .csv, .npz, .json"),
        ("gt.csv", "", "no header"),
        ("gt.csv", "query,database\n0,0\n", "of all 2 images, got 1; the first without is b.png"),
        ("gt.csv", "query,database\n0,0\n1,3\n", "a number from 0 to 2, got '3'"),
        ("gt.csv", "query,database\n0,0\nzz.png,0\n", "got 'zz.png'"),
        ("gt.csv", "query,database,query\n0,0,1\n1,1,0\n", "got query,database,query"),
        ("gt.json", '{"00": 1, "11": 1}', "expected [[query, [database, ...]], ...]"),
        ("gt.json", '[[0, "12"], [1, "0"]]', "expected [[query, [database, ...]], ...]"),
        ("gt.npz", "no archive", "cannot be read"),
        ("gt.npz", {"query": np.array([{"a": 1}], object), "database": np.array([0])}, "Object arrays"),
        (
            "gt.npz",
            {"utmQ": np.full((2, 2), np.nan), "utmDb": np.zeros((3, 2))},
            "at most 1e+09 m, got float64[2, 2] up to nan",
        ),
        ("gt.npz", {"utmQ": np.zeros(()), "utmDb": np.zeros((3, 2))}, "utmQ: expected positions [2, 2]"),
        ("gt.npz", {"query": np.arange(2), "database": np.arange(3)}, "cannot be read"),
        ("gt.npz", {"other": np.zeros(2)}, "got neither"),
    ],
)
def test_wrong_index_files_are_errors_of_one_line(folders, tmp_path, name, content, words):
    path = tmp_path / name
    if isinstance(content, dict):
        np.savez(path, **content)
    elif content is not None:
        path.write_text(content)
    with one_line_error(None, words, str(path)):
        datasets.folder(*folders, ground_truth=IndexFile(path))


@pytest.mark.parametrize("name", ["plain.png", "@a@b@.png", "@1.png", "@nan@1@.png", "@5@-1e10@.png", "@1_0@5@.png"])
def test_names_without_coordinates_are_errors(tmp_path, name):
    folder = fill(tmp_path / "db", [name])
    with pytest.raises(InputError, match=r"easting|positions in names: expected"):
        datasets.folder(folder, folder, ground_truth="utm")
