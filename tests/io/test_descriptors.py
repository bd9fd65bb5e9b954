"""Global descriptors: rows in the data set's order, whatever the file's."""

import glob
import os
from pathlib import Path

import numpy as np
import pytest

from mfvpr import InputError
from mfvpr.datasets import image_folder
from mfvpr.io import read_global_descriptors, write_global_descriptors
from tests.builders import unit
from tests.io.checks import one_line_error
from tests.io.other_programs import append_hloc

NAMES = ["image2.jpg", "sub/image 1.jpg", "image10.jpg"]  # Python sorts 10 before 2; no row stays, and none swap


@pytest.fixture
def descriptors():
    return unit(np.random.default_rng(0).normal(size=(3, 8)))


def test_npy_is_in_sorted_order(tmp_path, descriptors):
    np.save(tmp_path / "g.npy", descriptors)  # of image10, image2, sub/image 1
    np.savez(tmp_path / "g.npz", descriptors=descriptors)
    for file in ("g.npy", "g.npz"):
        np.testing.assert_array_equal(read_global_descriptors(tmp_path / file, NAMES), descriptors[[1, 2, 0]])
    np.save(tmp_path / "g.npy", descriptors * 3)
    scaled = read_global_descriptors(tmp_path / "g.npy", NAMES, lengths="normalize")
    np.testing.assert_allclose(scaled, descriptors[[1, 2, 0]], atol=1e-6)


def test_rows_of_vpr_methods_evaluation(tmp_path):
    """Its rows are in the order of the sorted paths, with a folder given with or without a slash at its end."""
    names = ["a/b.jpg", "a.b.jpg", "a b/1.jpg", "a-1/x.PNG", "B/2.jpeg", "b/10.jpg", "b/2.jpg", "é.jpg", "10.jpg"]
    for name in names:
        (tmp_path / "set" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "set" / name).touch()
    folder = image_folder(tmp_path / "set")
    vectors = unit(np.random.default_rng(0).normal(size=(len(names), 8)))
    for root in (str(folder.root), f"{folder.root}/"):
        paths = [Path(path) for path in sorted(glob.glob(f"{root}/**/*", recursive=True)) if os.path.isfile(path)]
        np.save(tmp_path / "database_descriptors.npy", vectors[[folder.paths.index(path) for path in paths]])
        read = read_global_descriptors(tmp_path / "database_descriptors.npy", folder.names)
        np.testing.assert_array_equal(read, vectors)
    with one_line_error(r"expected descriptors \[8, D\] of the images, got \[9, 8\]"):
        read_global_descriptors(tmp_path / "database_descriptors.npy", folder.names[1:])


def test_npz_with_names(tmp_path, descriptors):
    foreign = ["/data/sub/image 1.jpg", "other.jpg", "/data/image10.jpg", "/data/image2.jpg"]
    np.savez(tmp_path / "g.npz", names=foreign, descriptors=np.r_[descriptors, descriptors[:1]][[1, 3, 2, 0]])
    np.testing.assert_array_equal(read_global_descriptors(tmp_path / "g.npz", NAMES), descriptors[[0, 1, 2]])


def test_hloc(tmp_path, descriptors):
    """As hloc writes global features: float16, with the size of the image, and other images."""
    path = tmp_path / "global-feats-netvlad.h5"
    for name, vector in zip([*NAMES[::-1], "z"], [*descriptors[::-1], descriptors[0]], strict=True):
        append_hloc(path, name, {"global_descriptor": vector.astype(np.float16), "image_size": np.array([640, 480])})
    vectors = read_global_descriptors(path, NAMES)
    assert vectors.dtype == np.float32
    np.testing.assert_allclose(vectors, descriptors, atol=5e-4)
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1, atol=1.2e-6)


@pytest.mark.parametrize("suffix", ["npy", "npz", "h5", "hdf5"])
@pytest.mark.parametrize("half", [False, True])
def test_written_and_read(tmp_path, descriptors, suffix, half):
    path = tmp_path / "new" / f"g.{suffix}"
    write_global_descriptors(path, NAMES, descriptors, half=half)
    vectors = read_global_descriptors(path, NAMES, lengths="keep")
    expected = descriptors.astype(np.float16).astype(np.float32) if half else descriptors
    np.testing.assert_array_equal(vectors, expected)
    assert [file.name for file in path.parent.iterdir()] == [path.name]
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(InputError, match=rf"g\.{suffix}: "):
        read_global_descriptors(path, NAMES)


@pytest.mark.parametrize(
    "file, arrays, message",
    [
        ("g.npy", np.ones((2, 8)), r"descriptors \[3, D\].* got \[2, 8\]"),
        ("g.npy", np.ones((3, 8), int), "floating-point .*got int64"),
        ("g.npy", np.full((3, 4), 1.5), r"g\.npy: .*unit length, got length 3 "),
        ("g.npy", np.array([[{}]], object), "cannot be read"),
        ("g.npz", {"names": NAMES}, r"expected names as text \[M\] and descriptors"),
        ("g.npz", {"descriptors": np.ones((3, 8)), "names": ["a", "a", "b"]}, "expected different names, got a twice"),
        ("g.npz", {"descriptors": np.ones((3, 8)), "names": [*NAMES[:2], "x"]}, r"first without is image10\.jpg"),
        ("g.csv", None, r"expected a file named \.npy, \.npz, \.h5, \.hdf5, got \.csv"),
        ("g.h5", {name: np.ones(8 + place) for place, name in enumerate(NAMES)}, r"one D, got \[\(8,\), \(9,\)"),
    ],
)
def test_what_is_refused(tmp_path, file, arrays, message):
    path = tmp_path / file
    if arrays is None:
        path.write_text("")
    elif file == "g.h5":
        for name, vector in arrays.items():
            append_hloc(path, name, {"global_descriptor": vector})
    elif isinstance(arrays, dict):
        np.savez(path, **arrays)
    else:
        np.save(path, arrays)
    with one_line_error(message, file):
        read_global_descriptors(path, NAMES)
