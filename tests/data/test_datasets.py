"""Folders and ground truth of every kind, right and wrong."""

import json

import numpy as np
import pytest
from PIL import Image

from mfvpr import InputError
from mfvpr.data.datasets import fingerprint, folder_dataset, image_folder
from mfvpr.data.files import replacing, write_text


def fill(folder, names):
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (4, 4)).save(path)
    return folder


@pytest.fixture
def folders(tmp_path):
    return fill(tmp_path / "db", ["0.png", "1.png", "2.png"]), fill(tmp_path / "q", ["a.png", "b.png"])


def test_names_are_relative_in_natural_order_and_kept_apart(tmp_path):
    fill(tmp_path, ["._img10.png", "sub/.hidden.jpg"])
    names = ["img10.png", "img2.png", "sub/img2.png", "a b/ü@1.png", "IMG3.JPG", "img02.png"]
    fill(tmp_path, names)
    (tmp_path / "notes.txt").write_text("no image")
    folder = image_folder(tmp_path)
    assert set(folder.names) == set(names)
    order = [folder.names.index(name) for name in ("img2.png", "img10.png")]
    assert order == sorted(order)
    assert all(path.is_file() for path in folder.paths)


def test_order(folders):
    database, queries = folders
    with pytest.raises(InputError, match="got 2 and 3"):
        folder_dataset(database, queries)
    truth = folder_dataset(database, database).truth
    np.testing.assert_array_equal(truth.positives(0), np.eye(3, dtype=bool))
    assert truth.positives(1).sum() == 7
    assert folder_dataset(database, queries, ground_truth="none").truth is None


@pytest.mark.parametrize(
    "text",
    [
        "query,database\na.png,2.png\nb.png,\na.png,0.png\n",
        "Reference,Live\n2,0\n,1\n0,0\n",
        "database,extra,query\n2.png,x,a.png\n,x,b.png\n0,x,a.png\n",
        "\ufeffquery,database\r\n0,2\r\n1,\r\n0,0\r\n",
    ],
)
def test_csv(folders, tmp_path, text):
    write_text(tmp_path / "gt.csv", text)
    truth = folder_dataset(*folders, ground_truth="index", index_file=tmp_path / "gt.csv").truth
    np.testing.assert_array_equal(truth.positives(0), [[True, False, True], [False, False, False]])


def test_json_and_npz(folders, tmp_path):
    write_text(tmp_path / "gt.json", json.dumps([[0, [2, 0]], [1, []]]))
    np.savez(tmp_path / "gt.npz", query=np.array([0, 1, 0]), database=np.array(["2", "", "0.png"]))
    for name in ("gt.json", "gt.npz"):
        truth = folder_dataset(*folders, ground_truth="index", index_file=tmp_path / name).truth
        np.testing.assert_array_equal(truth.positives(0), [[True, False, True], [False, False, False]])
    np.savez(tmp_path / "utm.npz", utmQ=np.array([[0, 0], [50, 0]]), utmDb=np.array([[0, 25], [0, 26], [50, 1]]))
    truth = folder_dataset(*folders, ground_truth="index", index_file=tmp_path / "utm.npz").truth
    np.testing.assert_array_equal(truth.positives(25), [[True, False, False], [False, False, True]])


def test_utm_reads_the_file_name_only(tmp_path):
    database = fill(tmp_path / "at@home@1@" / "db", ["@0500000.00@4400000.00@.png", "x/@0500030.00@4400000.00@y@.png"])
    queries = fill(tmp_path / "at@home@1@" / "q", ["@0500010.00@4400000.00@@@@.png"])
    truth = folder_dataset(database, queries, ground_truth="utm").truth
    assert truth.unit == "m"
    np.testing.assert_array_equal(truth.positives(15), [[True, False]])
    np.testing.assert_array_equal(truth.positives(25), [[True, True]])


def bad_npz(path):
    np.savez(path, query=np.array([{"a": 1}], dtype=object), database=np.array([0]))


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("missing.csv", None, "got nothing"),
        ("gt.txt", "x", "named .csv, .npz or .json"),
        ("gt.csv", "", "no header"),
        ("gt.csv", "a,b\n0,0\n", "got a,b"),
        ("gt.csv", "query,database\n0,0\n", "all 2 queries, got it for 1; the first without is b.png"),
        (
            "gt.csv",
            "query,database\n0,0\n1,3\n",
            "pair 2: expected the name of a database image or a number from 0 to 2",
        ),
        ("gt.csv", "query,database\n0,0\n1,-1\n", "got '-1'"),
        ("gt.csv", "query,database\n0,0\nzz.png,0\n", "got 'zz.png'"),
        ("gt.json", "[[0", "cannot be read as .json"),
        ("gt.npz", "no archive", "cannot be read as .npz"),
        ("gt.npz", bad_npz, "Python objects, which are never loaded"),
        ("gt.json", '{"00": 1, "11": 1}', "expected [[query, [database, ...]], ...]"),
        ("gt.json", '[[0, "12"], [1, "0"]]', "expected [[query, [database, ...]], ...]"),
        (
            "gt.npz",
            lambda p: np.savez(p, utmQ=np.full((2, 2), np.nan), utmDb=np.zeros((3, 2))),
            "utmQ: expected finite",
        ),
        ("gt.npz", lambda p: np.savez(p, utmQ=np.zeros(()), utmDb=np.zeros((3, 2))), "utmQ: expected finite"),
        ("gt.npz", lambda p: np.savez(p, query=np.arange(2), database=np.arange(3)), "of one length"),
        ("gt.npz", lambda p: np.savez(p, other=np.zeros(2)), "got other"),
        ("gt.npz", lambda p: np.savez(p, utmQ=np.zeros((5, 2)), utmDb=np.zeros((3, 2))), "expected 2 query positions"),
    ],
)
def test_wrong_index_files_are_named_in_one_line(folders, tmp_path, name, content, words):
    path = tmp_path / name
    if callable(content):
        content(path)
    elif content is not None:
        path.write_text(content)
    with pytest.raises(InputError) as caught:
        folder_dataset(*folders, ground_truth="index", index_file=path)
    assert words in str(caught.value)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["plain.png", "@a@b@.png", "@1.png", "@nan@1@.png", "@inf@1@.png"])
def test_names_without_coordinates_are_named(tmp_path, name):
    folder = fill(tmp_path / "db", [name])
    with pytest.raises(InputError, match=r"easting"):
        folder_dataset(folder, folder, ground_truth="utm")


def test_missing_and_empty_folders(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("")
    for path, words in (
        (tmp_path / "no", "got nothing"),
        (tmp_path / "empty", "found none"),
        (tmp_path / "file", "a file"),
    ):
        with pytest.raises(InputError, match=words):
            image_folder(path)
    with pytest.raises(InputError, match=r"set dataset\.index_file"):
        folder_dataset(fill(tmp_path / "a", ["0.png"]), tmp_path / "a", ground_truth="index")


def test_fingerprint_follows_names_contents_and_order(tmp_path):
    one, two = fill(tmp_path / "1", ["a.png", "b.png"]), fill(tmp_path / "2", ["a.png", "b.png"])
    same = fingerprint(image_folder(one)), fingerprint(image_folder(two))
    assert same[0] == same[1]
    (two / "b.png").rename(two / "c.png")
    assert fingerprint(image_folder(two)) != same[0]
    (one / "b.png").write_bytes(b"other")
    assert fingerprint(image_folder(one)) != same[0]


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path):
    path = tmp_path / "deep" / "x.txt"
    write_text(path, "old")

    def interrupted():
        with replacing(path) as temporary:
            temporary.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert path.read_text() == "old"
    assert [p.name for p in path.parent.iterdir()] == ["x.txt"]
