"""Files of matches that are damaged, of another layout, or malicious."""

import os
import pickle
import shutil
import sqlite3
import zipfile
from contextlib import closing
from pathlib import Path

import h5py
import numpy as np
import pytest

from mfvpr import InputError
from mfvpr.io import Images, containers, open_features, open_matches
from tests.io.checks import one_line_error
from tests.io.match_files import DATABASE, POINTS, QUERIES, SIZE, npz_folder, pair_of, side, write_hloc

SUPERGLUE = {"keypoints0": POINTS, "keypoints1": POINTS, "matches": [0, -1, 2]}


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
        ({"points0": 3.0, "points1": 3.0, "confidence": 1.0}, r"points \(x, y\)"),
        (SUPERGLUE | {"match_confidence": [0.5, 0.5]}, r"match_confidence \[N\]"),
        (SUPERGLUE | {"matches": [0, 1]}, r"matches \[N\]"),
        (SUPERGLUE | {"keypoints0": [0, 1, 2]}, r"points \(x, y\)"),
    ],
)
def test_hostile_npz(tmp_path, arrays, message):
    with one_line_error(message):
        pair_of(npz_folder(tmp_path, **arrays), image_size=(64, 64))


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
    result = {
        "img0_path": Path("/x/q1.jpg"),
        "img1_path": Path("/y/d1.jpg"),
        "matched_kpts0": POINTS,
        "matched_kpts1": POINTS,
        "matched_confidences": None,
        "H": None,
        "im_size": 64,
    }
    torch_file(folder / "output_0_result.torch", result)
    assert len(pair_of(folder).mask) == 3
    for key, value, message in [
        ("H", Command(), "executed"),
        ("img1_path", Path("/y/other.jpg"), "got none of their names"),
        ("matched_kpts1", [1, 2], "points"),
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
    sides = [
        side(prefix, names, open_features(tools / "hloc/feats.h5", [prefix + name for name in names]))
        for prefix, names in (("queries/", QUERIES), ("database/", DATABASE))
    ]
    return open_matches(path, *sides)


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        (np.int16([-5, 0]), "int16"),
        (np.int16([0, 30_000]), "keypoints"),
        (np.float32([0, 1]), "integers"),
    ],
)
def test_hostile_hloc(tools, tmp_path, numbers, message):
    with one_line_error(message):
        numbered_file(tools, tmp_path, numbers).read(0, [0])


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
def test_hostile_colmap(tools, tmp_path, statement, message):
    path = changed_database(tools, tmp_path, "PRAGMA foreign_keys = OFF", statement)
    with one_line_error(message):
        open_matches(path, side("queries/", QUERIES), side("database/", DATABASE)).read(0, [0, 1])


def test_pairs_of_images_that_left_colmaps_database_cost_no_others(tools, tmp_path):
    pair = 998 * (2**31 - 1) + 999
    path = changed_database(tools, tmp_path, f"INSERT INTO matches VALUES ({pair}, 0, 2, NULL)")
    sides = side("queries/", QUERIES), side("database/", DATABASE)
    changed, whole = (open_matches(each, *sides).read(0, [0, 1]) for each in (path, tools / "colmap.db"))
    for one, other in zip(changed, whole, strict=True):
        np.testing.assert_array_equal(one.points0, other.points0)


@pytest.mark.parametrize("file", ["pairs/q1_d1.npz", "m.h5"])
def test_an_array_that_grows_without_limit_is_not_read(tmp_path, monkeypatch, file):
    monkeypatch.setattr(containers, "MAX_INFLATED", 1 << 20)
    (tmp_path / "pairs").mkdir()
    for count, grows in ((100, False), (200_000, True)):
        points = np.zeros((count, 2), np.float32)
        if file == "m.h5":
            with h5py.File(tmp_path / file, "w") as content:
                for name in ("keypoints0", "keypoints1"):
                    content.create_dataset(f"q1.jpg/d1.jpg/{name}", data=points, compression="gzip")
        else:
            np.savez_compressed(tmp_path / file, points0=points, points1=points)
        path = tmp_path / file if file == "m.h5" else tmp_path / "pairs"
        if not grows:
            assert len(pair_of(path, image_size=SIZE).mask) == count
            continue
        with one_line_error("at most 1 GiB", file):
            pair_of(path, image_size=SIZE)


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
        ("keypoints/sift/queries/0000.png.kpt", b"12345", "cannot be read"),
        ("keypoints/sift/queries/0000.png.kpt", b"", "keypoints"),
        (
            "matches/sift/database/0000.png.overlapping/queries/0000.png.matches",
            np.float64([[0.5, 0, 1]]).tobytes(),
            "whole numbers",
        ),
    ],
)
def test_hostile_kapture(tools, tmp_path, file, content, message):
    shutil.copytree(tools / "kapture", tmp_path / "kapture")
    (tmp_path / "kapture/reconstruction" / file).write_bytes(content)
    with one_line_error(message):
        open_matches(tmp_path / "kapture", side("queries/", QUERIES), side("database/", DATABASE)).read(0, [0, 1])


def test_other_files_are_refused(tools, tmp_path):
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
        open_matches(tools / "hloc/matches.h5", *sides, verified=True)
