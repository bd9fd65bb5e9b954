"""Matches of other programs: their own files, exchanged and missing pairs, names; what cannot be used is one line."""

import shutil
import sqlite3
from contextlib import closing

import h5py
import numpy as np
import pytest

from mfvpr.core.types import Shortlist
from mfvpr.io import Images, containers, open_features, open_matches
from tests.io.checks import one_line_error
from tests.io.match_files import DATABASE, GOLDEN, POINTS, QUERIES, SIZE, npz_folder, pair_of, side, write_hloc

SUPERGLUE = {"keypoints0": POINTS, "keypoints1": POINTS[::-1] + 1, "matches": np.array([2, -1, 0])}


def tool_sides(tools=None):
    """Images with prefixes as in the tools' files; with hloc's features if `tools` is given."""
    sides = []
    for prefix, names in (("queries/", QUERIES), ("database/", DATABASE)):
        features = tools and open_features(tools / "hloc/feats.h5", [prefix + name for name in names])
        sides.append(side(prefix, names, features))
    return sides


def open_tool(tools, tool):
    """The matches of a tool."""
    if tool == "hloc":
        return open_matches(tools / "hloc/matches.h5", *tool_sides(tools))
    path = tools / {"verified": "colmap.db", "colmap": "colmap.db", "kapture": "kapture"}.get(tool, "vismatch")
    return open_matches(path, *tool_sides(), verified=tool in ("verified", "inliers"))


@pytest.mark.parametrize("tool", ["hloc", "kapture", "colmap", "verified", "vismatch", "inliers"])
def test_the_files_of_each_tool_are_read_as_its_library_reads_them(tools, tool):
    files, num_matches = open_tool(tools, tool), 0
    for query, name in enumerate(QUERIES):
        read = files.read(query, [0, 1])
        for candidate, matches in zip(DATABASE, read, strict=True):
            key = f"expected/{tool}/queries/{name}:database/{candidate}"
            if f"{key}:points0" not in GOLDEN:
                assert matches is None or not len(matches.mask)  # COLMAP's library stores empty pairs
                continue
            np.testing.assert_array_equal(matches.points0, GOLDEN[f"{key}:points0"])
            np.testing.assert_array_equal(matches.points1, GOLDEN[f"{key}:points1"])
            confidence = GOLDEN.get(f"{key}:confidence", 1)
            np.testing.assert_array_equal(matches.confidence, np.broadcast_to(confidence, len(matches.mask)))
            assert matches.mask.all()
            assert matches.image_size0.tolist() == ([512, 512] if tool in ("vismatch", "inliers") else [*SIZE])
            num_matches += len(matches.mask)
    assert num_matches > 3


def test_distances_are_those_of_hlocs_descriptors(tools):
    [matches, _] = open_tool(tools, "hloc").read(0, [0, 1])
    with h5py.File(tools / "hloc/feats.h5") as file:
        descriptors = [file[f"{name}/0000.png/descriptors"][:].T.astype(float) for name in ("queries", "database")]
        counts = [len(values) for values in descriptors]
    differences = descriptors[0][matches.index0] - descriptors[1][matches.index1]
    np.testing.assert_allclose(matches.distance, np.sqrt((differences**2).sum(1)), atol=2e-3)
    assert [int(matches.count0), int(matches.count1)] == counts
    assert matches.distance.min() > 0


@pytest.mark.parametrize("tool", ["hloc", "kapture", "colmap", "vismatch"])
def test_missing_pairs_are_one_warning(tools, tool):
    indices = np.array([[0, 1], [0, 1]])
    [warning] = open_tool(tools, tool).warnings(Shortlist(indices, 0.0 * indices, indices >= 0))
    assert "1 of 4 pairs" in warning
    assert "queries/0001.png and database/0001.png" in warning
    indices = np.array([[-1, -1], [-1, 1]])
    with one_line_error("got none", "database/0001.png"):
        open_tool(tools, tool).warnings(Shortlist(indices, 0.0 * indices, indices >= 0))


def test_of_both_orders_of_a_pair_that_of_query_and_database_counts(tmp_path):
    for first, second, count in (("d1.jpg", "q1.jpg", 1), ("q1.jpg", "d1.jpg", 2)):
        arrays = {"points0": POINTS, "points1": POINTS + count, "img0_path": first, "img1_path": second}
        folder = npz_folder(tmp_path, f"{count}.npz", image_size0=[64, 65], image_size1=[96, 97], **arrays)
        matches = pair_of(folder)
        np.testing.assert_array_equal(matches.points1 - matches.points0, np.full((3, 2), -1 if count == 1 else 2))
        assert matches.image_size0.tolist() == ([96, 97] if count == 1 else [64, 65])


def test_names_without_prefixes_are_identified_by_the_folders_of_the_images(tools):
    """Queries and database images have the same names; their folders tell them apart."""
    sides = [
        Images(QUERIES, [f"/data/set/{folder}/{name}" for name in QUERIES], size=lambda row: SIZE)
        for folder in ("queries", "database")
    ]
    matches = open_matches(tools / "kapture", *sides).read(0, [1])[0]
    np.testing.assert_array_equal(
        matches.points0, GOLDEN["expected/kapture/queries/0000.png:database/0001.png:points0"]
    )
    with one_line_error("with their folders"):
        open_matches(tools / "kapture", Images(QUERIES), Images(DATABASE))


def test_one_name_is_not_of_a_query_and_of_another_database_image(tmp_path):
    """Also with prefixes, which tell nothing apart if they are the same."""
    path = write_hloc(tmp_path / "m.h5", ["0000.png/0001.png"], keypoints0=POINTS, keypoints1=POINTS)
    sides = [
        Images(QUERIES, [f"/data/{folder}/{name}" for name in QUERIES], True, lambda row: SIZE)
        for folder in ("queries", "database")
    ]
    with one_line_error("one image for each entry", "0000.png"):
        open_matches(path, *sides)
    same = [side._replace(paths=sides[0].paths) for side in sides]
    assert open_matches(path, *same).contains(0, 1)


def test_a_pair_in_the_other_order_is_exchanged(tmp_path):
    path = write_hloc(
        tmp_path / "m.h5",
        ["d-1.jpg/q-1.jpg"],
        keypoints0=POINTS,
        keypoints1=POINTS + 5,
        scores=np.float32([0.1, 0.2, 0.3]),
    )
    sizes = [(100, 80), (120, 90)]
    sides = [Images([name], size=lambda row, size=size: size) for name, size in zip(("q/1.jpg", "d/1.jpg"), sizes)]  # noqa: B905
    [matches] = open_matches(path, *sides).read(0, [0])
    np.testing.assert_array_equal(matches.points0, POINTS + 5)
    np.testing.assert_array_equal(matches.points1, POINTS)
    np.testing.assert_array_equal(matches.confidence, np.float32([0.1, 0.2, 0.3]))
    assert [matches.image_size0.tolist(), matches.image_size1.tolist()] == [[100, 80], [120, 90]]


def test_dashes_in_names_are_told_from_folders_or_refused(tmp_path):
    path = write_hloc(tmp_path / "m.h5", ["q-a-1.jpg/d-1.jpg"], keypoints0=POINTS, keypoints1=POINTS)
    for name in ("q/a/1.jpg", "q/a-1.jpg"):
        assert open_matches(path, Images([name]), Images(["d/1.jpg"])).contains(0, 0)
    with one_line_error("different names"):
        open_matches(path, Images(["q/a/1.jpg", "q/a-1.jpg"]), Images(["d/1.jpg"]))


def test_npz_of_points(tmp_path):
    folder = npz_folder(tmp_path, points0=POINTS, points1=POINTS + 1, image_size0=[64, 64], image_size1=[96, 96])
    matches = pair_of(folder)
    np.testing.assert_array_equal(matches.points1 - matches.points0, np.ones((3, 2)))
    assert matches.image_size1.tolist() == [96, 96]
    assert pair_of(npz_folder(tmp_path, points0=POINTS, points1=POINTS), image_size=(64, 64)).mask.all()
    for size in ({}, {"im_size": 0}, {"im_size": np.nan}):
        with one_line_error("size of an image, .* set image_size="):
            pair_of(npz_folder(tmp_path, points0=POINTS, points1=POINTS, **size))


def test_npz_of_superglue(tmp_path):
    """A partner for each keypoint of the first image, -1 = none."""
    arrays = SUPERGLUE | {"match_confidence": np.float32([0.5, 0, 0.25])}
    matches = pair_of(npz_folder(tmp_path, **arrays), image_size=(640, 480))
    np.testing.assert_array_equal(matches.points0, POINTS[[0, 2]])
    np.testing.assert_array_equal(matches.points1, POINTS[[0, 2]] + 1)
    np.testing.assert_array_equal(matches.confidence, np.float32([0.5, 0.25]))


def test_names_of_files_with_several_readings_are_refused(tmp_path):
    folder = npz_folder(tmp_path, "a_b_c.npz", points0=POINTS, points1=POINTS)
    with one_line_error("one pair of images, got several"):
        open_matches(folder, Images(["a.jpg", "a_b.jpg"]), Images(["b_c.jpg", "c.jpg"]))


def test_files_by_stems_have_the_query_first(tmp_path):
    """Queries and database images with the same names: 1_2 is query 1 with database image 2, and nothing else."""
    folder = npz_folder(tmp_path, "1_2_matches.npz", points0=POINTS, points1=POINTS + 2)
    files = open_matches(folder, Images(["1.jpg", "2.jpg"]), Images(["1.jpg", "2.jpg"]), image_size=(64, 64))
    assert [[files.contains(query, row) for row in (0, 1)] for query in (0, 1)] == [[False, True], [False, False]]


def test_confidences_of_all_pairs_or_of_none(tmp_path):
    npz_folder(tmp_path, "q1_d1.npz", points0=POINTS, points1=POINTS, confidence=[0.5] * 3)
    folder = npz_folder(tmp_path, "q1_d2.npz", points0=POINTS, points1=POINTS)
    sides = Images(["q1.jpg"]), Images(["d1.jpg", "d2.jpg"])
    with one_line_error("expected confidences of all pairs or none, got some"):
        open_matches(folder, *sides, image_size=(64, 64)).read(0, [0, 1])
    read = open_matches(folder, *sides, image_size=(64, 64), confidences=False).read(0, [0, 1])
    assert all((matches.confidence == 1).all() for matches in read)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"points0": POINTS, "points1": POINTS[:2]}, "as many points"),
        ({"points0": POINTS, "points1": POINTS * np.nan}, "finite"),
        ({"points0": POINTS, "points1": POINTS + 1000}, "image of 64 x 64"),
        ({"points0": POINTS, "points1": POINTS, "confidence": [0.1, 0.2]}, "3 confidences"),
        ({"points0": POINTS, "points1": POINTS, "confidence": [0.1, 0.2, 7]}, "0 to 1"),
        ({"points0": POINTS}, "expected points0 and points1"),
        ({"points0": POINTS, "points1": np.array([None] * 3)}, "cannot be read"),
        ({"points0": POINTS, "points1": POINTS, "im_size": "large"}, "im_size"),
        ({"points0": POINTS, "points1": POINTS, "image_size0": [64, 64]}, "image_size0 and image_size1"),
        ({"points0": POINTS, "points1": POINTS, "im_size": 128}, "the argument image_size="),
        (SUPERGLUE | {"match_confidence": [0.5, 0.5]}, r"expected matches \[N\]"),
        *(
            (SUPERGLUE | {"matches": each}, "expected matches")
            for each in ([0, 1], [3, -1, 0], [-2, 0, 1], [[2], [-1], [0]])
        ),
    ],
)
def test_arrays_that_are_no_matches(tmp_path, arrays, message):
    with one_line_error(message):
        pair_of(npz_folder(tmp_path, **arrays), image_size=(64, 64))


@pytest.mark.parametrize(
    ("numbers", "message"),
    [(np.int16([-5, 0]), "int16"), (np.int16([0, 30_000]), "keypoints"), (np.float32([0, 1]), "integers")],
)
def test_numbers_that_are_no_keypoints(tools, tmp_path, numbers, message):
    path = write_hloc(tmp_path / "matches.h5", ["queries-0000.png/database-0000.png"], matches0=numbers)
    with one_line_error(message):
        open_matches(path, *tool_sides(tools)).read(0, [0])


def changed_database(tools, tmp_path, *statements):
    path = shutil.copy(tools / "colmap.db", tmp_path / "changed.db")
    with closing(sqlite3.connect(path)) as connection:
        connection.executescript(";".join(statements))
    return path


@pytest.mark.parametrize(
    ("statement", "message"),
    [
        ("DROP TABLE matches", "matches"),
        ("UPDATE matches SET rows = rows + 1", "cannot be read"),
        ("UPDATE keypoints SET cols = 1", "2 or more columns"),
        ("DELETE FROM keypoints", "keypoints"),
        ("UPDATE cameras SET width = 'wide'", "size of an image"),
    ],
)
def test_other_databases_than_colmaps(tools, tmp_path, statement, message):
    path = changed_database(tools, tmp_path, "PRAGMA foreign_keys = OFF", statement)
    with one_line_error(message):
        open_matches(path, *tool_sides()).read(0, [0, 1])


def test_pairs_of_images_that_left_colmaps_database_cost_no_others(tools, tmp_path):
    pair = 998 * (2**31 - 1) + 999
    path = changed_database(tools, tmp_path, f"INSERT INTO matches VALUES ({pair}, 0, 2, NULL)")
    assert len(open_matches(path, *tool_sides()).read(0, [0])[0].mask)


def test_colmaps_database_is_not_touched(tools, tmp_path):
    path = tmp_path / "only" / "colmap.db"
    path.parent.mkdir()
    path.write_bytes((tools / "colmap.db").read_bytes())
    before = path.stat().st_mtime_ns
    open_matches(path, *tool_sides()).read(0, [0, 1])
    assert [*path.parent.iterdir()] == [path]
    assert path.stat().st_mtime_ns == before
    (path.parent / "colmap.db-wal").write_bytes(b"changes")
    (tmp_path / "link.db").symlink_to(path)
    for name in (path, tmp_path / "link.db"):
        with one_line_error("close COLMAP"):
            open_matches(name, *tool_sides())


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("keypoints/sift/keypoints.txt", b"sift, complex64, 2", "float32"),
        ("keypoints/sift/queries/0000.png.kpt", b"12345", "cannot be read"),
        ("matches/sift/database/0000.png.overlapping/queries/0000.png.matches", np.ones(3) / 2, "whole numbers"),
    ],
)
def test_other_files_than_kaptures(tools, tmp_path, file, content, message):
    shutil.copytree(tools / "kapture", tmp_path / "kapture")
    (tmp_path / "kapture/reconstruction" / file).write_bytes(content)
    with one_line_error(message):
        open_matches(tmp_path / "kapture", *tool_sides()).read(0, [0, 1])


def test_an_array_that_grows_without_limit_is_not_read(tmp_path, monkeypatch):
    monkeypatch.setattr(containers, "MAX_INFLATED", 1 << 20)
    points = np.zeros((200_000, 2), np.float32)
    np.savez_compressed(tmp_path / "q1_d1.npz", points0=points, points1=points)
    with one_line_error("at most 1 GiB", "q1_d1.npz"):
        pair_of(tmp_path, image_size=SIZE)


def test_other_files_are_refused(tools, tmp_path):
    (tmp_path / "matches.txt").write_text("nothing")
    (tmp_path / "empty").mkdir()
    (tmp_path / "broken.db").write_bytes(b"no database" * 100)
    old = write_hloc(tmp_path / "old.h5", ["q1.jpg_d1.jpg"], matches0=np.int16([0]))
    hloc, sides = tools / "hloc/matches.h5", (Images(["q.jpg"]), Images(["d.jpg"]))
    for path, options, words in (
        (tmp_path / "matches.txt", {}, ".h5"),
        (tmp_path / "empty", {}, ".npz"),
        (tmp_path / "missing.h5", {}, "missing.h5"),
        (tmp_path / "broken.db", {}, "COLMAP"),
        (old, {}, "since 2021"),
        (tools / "hloc/feats.h5", {}, "not feats"),
        (hloc, {}, "give hloc's feats*.h5"),
        (hloc, {"verified": True}, "verified"),
    ):
        with one_line_error(None, words):
            open_matches(path, *sides, **options)
