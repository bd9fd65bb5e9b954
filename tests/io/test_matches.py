"""Matches of other programs: their own files, exchanged and missing pairs, names."""

import h5py
import numpy as np
import pytest

from mfvpr.core.types import Shortlist
from mfvpr.io import Images, open_features, open_matches
from tests.io.checks import one_line_error
from tests.io.match_files import DATABASE, GOLDEN, POINTS, QUERIES, SIZE, npz_folder, pair_of, side, write_hloc


def open_tool(tools, tool):
    """The matches of a tool, with prefixes as in its files."""
    if tool != "hloc":
        path = tools / {"verified": "colmap.db", "colmap": "colmap.db", "kapture": "kapture"}.get(tool, "vismatch")
        sides = side("queries/", QUERIES), side("database/", DATABASE)
        return open_matches(path, *sides, verified=tool in ("verified", "inliers"))
    sides = []
    for prefix, names in (("queries/", QUERIES), ("database/", DATABASE)):
        features = open_features(tools / "hloc/feats.h5", [prefix + name for name in names])
        sides.append(side(prefix, names, features))
    return open_matches(tools / "hloc/matches.h5", *sides)


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


@pytest.mark.parametrize(("tool", "missing"), [("hloc", 1), ("kapture", 1), ("colmap", 1), ("vismatch", 1)])
def test_missing_pairs_are_one_warning(tools, tool, missing):
    indices = np.array([[0, 1], [0, 1]])
    [warning] = open_tool(tools, tool).warnings(Shortlist(indices, 0.0 * indices, indices >= 0))
    assert f"{missing} of 4 pairs" in warning
    assert "queries/0001.png and database/0001.png" in warning
    indices = np.array([[-1, -1], [-1, 1]])
    with one_line_error("got none", "database/0001.png"):
        open_tool(tools, tool).warnings(Shortlist(indices, 0.0 * indices, indices >= 0))


def test_of_both_orders_of_a_pair_that_of_query_and_database_counts(tmp_path):
    for place, (first, second) in enumerate((("d1.jpg", "q1.jpg"), ("q1.jpg", "d1.jpg"))):
        names = {"img0_path": first, "img1_path": second}
        npz_folder(tmp_path, f"{place}.npz", points0=POINTS + place, points1=POINTS + 2, **names)
    matches = pair_of(tmp_path / "pairs", image_size=SIZE)
    np.testing.assert_array_equal(matches.points0, POINTS + 1)
    np.testing.assert_array_equal(matches.points1, POINTS + 2)


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
    size = lambda row: SIZE  # noqa: E731
    sides = [
        Images(QUERIES, [f"/data/{folder}/{name}" for name in QUERIES], has_prefix, size)
        for folder, has_prefix in (("queries", True), ("database", True))
    ]
    for row in (0, 1):
        for folder in ("queries", "database"):
            (tmp_path / folder).mkdir(exist_ok=True)
            (tmp_path / folder / f"000{row}.png").write_text(folder)
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
    size = lambda row: SIZE  # noqa: E731
    for name in ("q/a/1.jpg", "q/a-1.jpg"):
        assert open_matches(path, Images([name], size=size), Images(["d/1.jpg"], size=size)).contains(0, 0)
    with one_line_error("different names"):
        open_matches(path, Images(["q/a/1.jpg", "q/a-1.jpg"], size=size), Images(["d/1.jpg"], size=size))


def test_npz_of_points(tmp_path):
    folder = npz_folder(tmp_path, points0=POINTS, points1=POINTS + 1, image_size0=[64, 64], image_size1=[96, 96])
    matches = pair_of(folder)
    np.testing.assert_array_equal(matches.points1 - matches.points0, np.ones((3, 2)))
    assert matches.image_size1.tolist() == [96, 96]
    with one_line_error("image_size"):
        pair_of(npz_folder(tmp_path, points0=POINTS, points1=POINTS))
    assert pair_of(npz_folder(tmp_path, points0=POINTS, points1=POINTS), image_size=(64, 64)).mask.all()
    for length in (0, -1, np.nan, np.inf):
        with one_line_error("size of an image"):
            pair_of(npz_folder(tmp_path, points0=POINTS, points1=POINTS, im_size=length))


def test_npz_with_names_may_have_either_order(tmp_path):
    arrays = {"points0": POINTS, "points1": POINTS + 1, "image_size0": [64, 65], "image_size1": [96, 97]}
    folder = npz_folder(tmp_path, "any name.npz", img0_path="/x/d1.jpg", img1_path="/x/q1.jpg", **arrays)
    matches = pair_of(folder)
    np.testing.assert_array_equal(matches.points1 - matches.points0, np.full((3, 2), -1))
    assert [matches.image_size0.tolist(), matches.image_size1.tolist()] == [[96, 97], [64, 65]]


def test_npz_of_superglue(tmp_path):
    """A partner for each keypoint of the first image, -1 = none."""
    arrays = {
        "keypoints0": POINTS,
        "keypoints1": POINTS[::-1] + 1,
        "matches": np.array([2, -1, 0]),
        "match_confidence": np.float32([0.5, 0, 0.25]),
    }
    matches = pair_of(npz_folder(tmp_path, **arrays), image_size=(640, 480))
    np.testing.assert_array_equal(matches.points0, POINTS[[0, 2]])
    np.testing.assert_array_equal(matches.points1, POINTS[[0, 2]] + 1)
    np.testing.assert_array_equal(matches.confidence, np.float32([0.5, 0.25]))
    for numbers in ([3, -1, 0], [-2, 0, 1]):
        with one_line_error("-1 to 2"):
            pair_of(npz_folder(tmp_path, **{**arrays, "matches": np.array(numbers)}), image_size=(640, 480))


def test_names_of_files_with_several_readings_are_refused(tmp_path):
    folder = npz_folder(tmp_path, "a_b_c.npz", points0=POINTS, points1=POINTS)
    with one_line_error("several ways"):
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
    with one_line_error("of all pairs or of none"):
        open_matches(folder, *sides, image_size=(64, 64)).read(0, [0, 1])
    read = open_matches(folder, *sides, image_size=(64, 64), confidences=False).read(0, [0, 1])
    assert all((matches.confidence == 1).all() for matches in read)
