"""Matches of other programs: their own files, exchanged and missing pairs, hostile files."""

import os
import pickle
import sqlite3
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pytest

from mfvpr import InputError
from mfvpr.io import Images, open_features, open_matches
from mfvpr.types import Shortlist
from tests.io.checks import one_line_error

GOLDEN = np.load(Path(__file__).parents[1] / "golden/matches.npz")
QUERIES, DATABASE = ["0000.png", "0001.png"], ["0000.png", "0001.png"]
SIZE = (448, 336)
POINTS = np.float32([[10, 20], [30, 40], [50, 60]])


@pytest.fixture(scope="module")
def tools(tmp_path_factory):
    """The files that hloc, kapture, COLMAP and vismatch wrote."""
    root = tmp_path_factory.mktemp("tools")
    for name in GOLDEN:
        if name.startswith("files/"):
            path = root / name.removeprefix("files/")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(GOLDEN[name].tobytes())
    return root


def side(prefix, names, features=None):
    """Images with the names that the tools know."""
    return Images([prefix + name for name in names], size=lambda row: SIZE, features=features)


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


def test_scores_of_0_as_hlocs_sift_writes_them_count_as_1(tools):
    [matches] = open_tool(tools, "hloc").read(0, [0])
    with h5py.File(tools / "hloc/feats.h5") as file:
        assert not file["queries/0000.png/scores"][:].any()
    assert (matches.scores0 == 1).all()
    assert (matches.scores1 == 1).all()


@pytest.mark.parametrize(("tool", "missing"), [("hloc", 1), ("kapture", 1), ("colmap", 1), ("vismatch", 1)])
def test_missing_pairs_are_one_warning(tools, tool, missing):
    indices = np.array([[0, 1], [0, 1]])
    [warning] = open_tool(tools, tool).warnings(Shortlist(indices, 0.0 * indices, indices >= 0))
    assert f"{missing} of 4 pairs" in warning
    assert "queries/0001.png and database/0001.png" in warning
    indices = np.array([[-1, -1], [-1, 1]])
    with one_line_error("got none", "database/0001.png"):
        open_tool(tools, tool).warnings(Shortlist(indices, 0.0 * indices, indices >= 0))


def test_names_without_prefixes_are_identified_by_the_folders_of_the_images(tools):
    """Queries and database images have the same names; their folders tell them apart."""
    sides = [Images(QUERIES, [f"/data/set/{folder}/{name}" for name in QUERIES], size=lambda row: SIZE)
             for folder in ("queries", "database")]  # fmt: skip
    matches = open_matches(tools / "kapture", *sides).read(0, [1])[0]
    np.testing.assert_array_equal(
        matches.points0, GOLDEN["expected/kapture/queries/0000.png:database/0001.png:points0"]
    )
    with one_line_error("with their folders"):
        open_matches(tools / "kapture", Images(QUERIES), Images(DATABASE))


def write_hloc(path, pairs, **arrays):
    """hloc's file of matches, with the same arrays for each pair."""
    with h5py.File(path, "w", libver="latest") as file:
        for pair in pairs:
            for name, values in arrays.items():
                file[f"{pair}/{name}"] = values
    return path


def test_one_name_is_not_of_a_query_and_of_another_database_image(tmp_path):
    """Also with prefixes, which tell nothing apart if they are the same."""
    path = write_hloc(tmp_path / "m.h5", ["0000.png/0001.png"], keypoints0=POINTS, keypoints1=POINTS)
    size = lambda row: SIZE  # noqa: E731
    sides = [Images(QUERIES, [f"/data/{folder}/{name}" for name in QUERIES], has_prefix, size)
             for folder, has_prefix in (("queries", True), ("database", True))]  # fmt: skip
    for row in (0, 1):
        for folder in ("queries", "database"):
            (tmp_path / folder).mkdir(exist_ok=True)
            (tmp_path / folder / f"000{row}.png").write_text(folder)
    with one_line_error("one image for each entry", "0000.png"):
        open_matches(path, *sides)
    same = [side._replace(paths=sides[0].paths) for side in sides]
    assert open_matches(path, *same).contains(0, 1)


def test_a_pair_in_the_other_order_is_exchanged(tmp_path):
    path = write_hloc(tmp_path / "m.h5", ["d-1.jpg/q-1.jpg"], keypoints0=POINTS, keypoints1=POINTS + 5,
                      scores=np.float32([0.1, 0.2, 0.3]))  # fmt: skip
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


def npz_folder(tmp_path, name="q1_d1_matches.npz", **arrays):
    folder = tmp_path / "pairs"
    folder.mkdir(exist_ok=True)
    np.savez(folder / name, **arrays)
    return folder


def pair_of(folder, **options):
    [matches] = open_matches(folder, Images(["q1.jpg"]), Images(["d1.jpg"]), **options).read(0, [0])
    return matches


def test_npz_of_points(tmp_path):
    folder = npz_folder(tmp_path, points0=POINTS, points1=POINTS + 1, image_size0=[64, 64], image_size1=[96, 96])
    matches = pair_of(folder)
    np.testing.assert_array_equal(matches.points1 - matches.points0, np.ones((3, 2)))
    assert matches.image_size1.tolist() == [96, 96]
    with one_line_error("image_size"):
        pair_of(npz_folder(tmp_path, points0=POINTS, points1=POINTS))
    assert pair_of(npz_folder(tmp_path, points0=POINTS, points1=POINTS), image_size=(64, 64)).mask.all()
    for side in (0, -1, np.nan, np.inf):
        with one_line_error("size of an image"):
            pair_of(npz_folder(tmp_path, points0=POINTS, points1=POINTS, im_size=side))


def test_npz_with_names_may_have_either_order(tmp_path):
    arrays = {"points0": POINTS, "points1": POINTS + 1, "image_size0": [64, 65], "image_size1": [96, 97]}
    folder = npz_folder(tmp_path, "any name.npz", img0_path="/x/d1.jpg", img1_path="/x/q1.jpg", **arrays)
    matches = pair_of(folder)
    np.testing.assert_array_equal(matches.points1 - matches.points0, np.full((3, 2), -1))
    assert [matches.image_size0.tolist(), matches.image_size1.tolist()] == [[96, 97], [64, 65]]


def test_npz_of_superglue(tmp_path):
    """A partner for each keypoint of the first image, -1 = none."""
    arrays = {"keypoints0": POINTS, "keypoints1": POINTS[::-1] + 1, "matches": np.array([2, -1, 0]),
              "match_confidence": np.float32([0.5, 0, 0.25])}  # fmt: skip
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


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"points0": POINTS, "points1": POINTS[:2]}, "as many points"),
        ({"points0": POINTS, "points1": POINTS[:, :1]}, "points"),
        ({"points0": POINTS, "points1": POINTS * np.nan}, "finite"),
        ({"points0": POINTS, "points1": POINTS + 1000}, "image of 64 x 64"),
        ({"points0": POINTS, "points1": POINTS, "confidence": [0.1, 0.2]}, "3 confidences"),
        ({"points0": POINTS, "points1": POINTS, "confidence": [0.1, 0.2, 7]}, "0 to 1"),
        ({"points0": POINTS, "points1": POINTS, "confidence": [0.1, 0.2, np.nan]}, "finite"),
        ({"points0": POINTS}, "expected points0 and points1"),
        ({"points0": POINTS, "points1": np.array([None] * 3)}, "objects"),
        ({"points0": POINTS, "points1": POINTS, "im_size": "large"}, "im_size"),
        ({"points0": POINTS, "points1": POINTS, "image_size0": [64, 64]}, "image_size0 and image_size1"),
        ({"points0": POINTS, "points1": POINTS, "im_size": 128}, "was given"),
        ({"points0": POINTS, "points1": POINTS, "im_size": np.nan}, "was given"),
    ],
)
def test_hostile_npz(tmp_path, arrays, message):
    with one_line_error(message):
        pair_of(npz_folder(tmp_path, **arrays), image_size=(64, 64))


def test_confidences_of_all_pairs_or_of_none(tmp_path):
    """The first pair of the files decides, whichever pair is read first."""
    npz_folder(tmp_path, "q1_d1.npz", points0=POINTS, points1=POINTS, confidence=[0.5] * 3)
    folder = npz_folder(tmp_path, "q1_d2.npz", points0=POINTS, points1=POINTS)
    sides = Images(["q1.jpg"]), Images(["d1.jpg", "d2.jpg"])
    for rows in ([0, 1], [1]):
        with one_line_error("of all pairs or of none"):
            open_matches(folder, *sides, image_size=(64, 64)).read(0, rows)
    read = open_matches(folder, *sides, image_size=(64, 64), confidences=False).read(0, [0, 1])
    assert all((matches.confidence == 1).all() for matches in read)


class Command:
    def __reduce__(self):
        return os.system, ("touch executed",)


def torch_file(path, result):
    """A file of `torch.save` without tensors."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("result/data.pkl", pickle.dumps(result, protocol=2))
    return path


def test_hostile_results_of_vismatch(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "results"
    folder.mkdir()
    result = {"img0_path": Path("/x/q1.jpg"), "img1_path": Path("/y/d1.jpg"), "matched_kpts0": POINTS,
              "matched_kpts1": POINTS, "matched_confidences": None, "H": None, "im_size": 64}  # fmt: skip
    torch_file(folder / "output_0_result.torch", result)
    assert len(pair_of(folder).mask) == 3
    for key, value, message in [
        ("H", Command(), "executed"),
        ("img1_path", Path("/y/other.jpg"), "got none of their names"),
        ("matched_kpts1", [1, 2], "points"),
        ("matched_kpts1", None, "expected points0"),
        ("im_size", [64, 64, 64], "im_size"),
    ]:
        torch_file(folder / "output_0_result.torch", {**result, key: value})
        with one_line_error(message):
            pair_of(folder)
    assert not Path("executed").exists()
    (folder / "output_0_result.torch").write_bytes(b"PK\x03\x04 no archive")
    with one_line_error("cannot be read"):
        pair_of(folder)


def numbered_file(tools, tmp_path, numbers, name="matches0", **more):
    """hloc's matches of the first pair, written anew."""
    path = write_hloc(tmp_path / "matches.h5", ["queries-0000.png/database-0000.png"], **{name: numbers}, **more)
    sides = [side(prefix, names, open_features(tools / "hloc/feats.h5", [prefix + name for name in names]))
             for prefix, names in (("queries/", QUERIES), ("database/", DATABASE))]  # fmt: skip
    return open_matches(path, *sides)


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        (np.int16([-5, 0]), "int16"),
        (np.int16([0, 30_000]), "keypoints"),
        (np.arange(30_000, dtype=np.int32) % 3, "keypoints"),
        (np.float32([0, 1]), "integers"),
        (np.int16([[0, 1]]), "integers"),
    ],
)
def test_hostile_hloc(tools, tmp_path, numbers, message):
    with one_line_error(message):
        numbered_file(tools, tmp_path, numbers).read(0, [0])


@pytest.mark.parametrize("place", ["q-1.jpg", "q-1.jpg/d-1.jpg", "q-1.jpg/d-1.jpg/keypoints1"])
def test_links_to_other_files_are_not_followed(tmp_path, place):
    write_hloc(tmp_path / "other.h5", ["q-1.jpg/d-1.jpg"], keypoints0=POINTS, keypoints1=POINTS)
    path = write_hloc(tmp_path / "m.h5", ["q-0.jpg/d-1.jpg", "q-1.jpg/d-1.jpg"], keypoints0=POINTS, keypoints1=POINTS)
    with h5py.File(path, "a") as file:
        del file[place]
        file[place] = h5py.ExternalLink("other.h5", place)
    size = lambda row: SIZE  # noqa: E731
    with one_line_error("link"):
        open_matches(path, Images(["q/1.jpg"], size=size), Images(["d/1.jpg"], size=size)).read(0, [0])


def test_hloc_without_its_features_or_in_an_old_layout(tools, tmp_path):
    with one_line_error("feats"):
        open_matches(tools / "hloc/matches.h5", side("queries/", QUERIES), side("database/", DATABASE))
    path = write_hloc(tmp_path / "m.h5", ["q1.jpg_d1.jpg"], matches0=np.int16([0]))
    with one_line_error("since 2021"):
        open_matches(path, Images(["q1.jpg"]), Images(["d1.jpg"]))
    with one_line_error("matches", "feats"):
        open_matches(tools / "hloc/feats.h5", Images(["a.png"]), Images(["b.png"]))
    with one_line_error("matches", "feats"):
        numbered_file(tools, tmp_path, np.int16([0]), name="other")


def changed_database(tools, tmp_path, *statements):
    path = tmp_path / "changed.db"
    path.write_bytes((tools / "colmap.db").read_bytes())
    connection = sqlite3.connect(path)
    for statement in statements:
        connection.execute(statement)
    connection.commit()
    connection.close()
    return path


@pytest.mark.parametrize(
    ("statement", "message"),
    [
        ("DROP TABLE matches", "matches"),
        ("UPDATE matches SET rows = rows + 1", "bytes"),
        ("UPDATE matches SET cols = 3", "columns"),
        ("UPDATE matches SET data = 'text'", "columns"),
        ("UPDATE keypoints SET cols = 1", "columns"),
        ("DELETE FROM keypoints", "keypoints"),
        ("DELETE FROM cameras", "camera"),
        ("UPDATE cameras SET width = 3", "image of 3"),
        ("UPDATE cameras SET width = 'wide'", "size of an image"),
        ("UPDATE keypoints SET data = zeroblob(length(data) - 8), rows = 1", "bytes"),
    ],
)
def test_hostile_colmap(tools, tmp_path, statement, message):
    path = changed_database(tools, tmp_path, "PRAGMA foreign_keys = OFF", statement)
    with one_line_error(message):
        open_matches(path, side("queries/", QUERIES), side("database/", DATABASE)).read(0, [0, 1])


def test_colmaps_database_is_not_touched(tools, tmp_path):
    path = tmp_path / "only" / "colmap.db"
    path.parent.mkdir()
    path.write_bytes((tools / "colmap.db").read_bytes())
    before = path.stat().st_mtime_ns
    open_matches(path, side("queries/", QUERIES), side("database/", DATABASE)).read(0, [0, 1])
    assert [*path.parent.iterdir()] == [path]
    assert path.stat().st_mtime_ns == before
    (path.parent / "colmap.db-wal").write_bytes(b"changes")
    (tmp_path / "link.db").symlink_to(path)
    for name in (path, tmp_path / "link.db"):
        with one_line_error("close COLMAP"):
            open_matches(name, side("queries/", QUERIES), side("database/", DATABASE))


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("keypoints/sift/keypoints.txt", b"sift, complex64, 2", "float32"),
        ("keypoints/sift/keypoints.txt", b"", "float32"),
        ("keypoints/sift/queries/0000.png.kpt", b"12345", "bytes"),
        ("keypoints/sift/queries/0000.png.kpt", b"", "keypoints"),
        ("matches/sift/database/0000.png.overlapping/queries/0000.png.matches", b"12345", "bytes"),
        ("matches/sift/database/0000.png.overlapping/queries/0000.png.matches",
         np.float64([[0.5, 0, 1]]).tobytes(), "whole numbers"),
        ("matches/sift/database/0000.png.overlapping/queries/0000.png.matches",
         np.float64([[np.nan, 0, 1]]).tobytes(), "whole numbers"),
        ("matches/sift/loose.matches", b"", "overlapping"),
    ],
)  # fmt: skip
def test_hostile_kapture(tools, tmp_path, file, content, message):
    for path in (tools / "kapture").rglob("*"):
        copy = tmp_path / path.relative_to(tools)
        copy.parent.mkdir(parents=True, exist_ok=True)
        if path.is_file():
            copy.write_bytes(path.read_bytes())
    (tmp_path / "kapture/reconstruction" / file).write_bytes(content)
    with one_line_error(message):
        open_matches(tmp_path / "kapture", side("queries/", QUERIES), side("database/", DATABASE)).read(0, [0, 1])


def test_other_files_are_refused(tmp_path):
    (tmp_path / "matches.txt").write_text("nothing")
    (tmp_path / "empty").mkdir()
    sides = Images(["q.jpg"]), Images(["d.jpg"])
    for name, words in (("matches.txt", ".h5"), ("empty", ".npz"), ("missing.h5", "missing.h5")):
        with pytest.raises(InputError, match=words):
            open_matches(tmp_path / name, *sides)
    (tmp_path / "broken.db").write_bytes(b"no database" * 100)
    with one_line_error("COLMAP"):
        open_matches(tmp_path / "broken.db", *sides)
    with one_line_error("verified"):
        open_matches(tmp_path / "matches.h5", *sides, verified=True)
