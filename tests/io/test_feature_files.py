"""Features that are written: read back the same, as other programs expect them."""

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mfvpr import InputError
from mfvpr.io import open_features, write_features
from tests.io.other_programs import NAMES, assert_equal, feature

PATHS = ["feats.h5", "feats.hdf5", "feats.npz", "feats"]


@pytest.mark.parametrize("file", PATHS)
@pytest.mark.parametrize("half", [False, True])
def test_written_and_read(tmp_path, file, half):
    written = [feature(seed, count=seed * 8) for seed in range(3)]
    write_features(tmp_path / file, NAMES, enumerate(written), half=half)
    source = open_features(tmp_path / file, NAMES, lengths="keep" if half else "unit")
    assert source.counts.tolist() == [0, 8, 16]
    for row, features in source.read():
        kind = np.float16 if half else np.float32
        values = {name: getattr(written[row], name).astype(kind) for name in ("keypoints", "descriptors", "scores")}
        assert_equal(features, type(features)(**(vars(written[row]) | values)))
    if file != "feats":
        assert [path.name for path in tmp_path.iterdir()] == [file]


def test_hloc_reads_what_is_written(tmp_path):
    written = feature(0)
    write_features(tmp_path / "f.h5", ["a/b.jpg"], [(0, written)], half=True)
    with h5py.File(tmp_path / "f.h5", "r", libver="latest") as file:
        group = file["a/b.jpg"]
        assert {name: (data.dtype.name, data.shape) for name, data in group.items()} == {
            "keypoints": ("float16", (30, 2)),
            "descriptors": ("float16", (16, 30)),
            "scores": ("float16", (30,)),
            "image_size": ("int64", (2,)),
        }
        np.testing.assert_array_equal(group["descriptors"], written.descriptors.T.astype(np.float16))
        assert group["image_size"][()].tolist() == [640, 480]


names = st.text(st.characters(exclude_categories=["Cc"], exclude_characters="/\\"), min_size=1, max_size=8).filter(
    lambda text: text.strip(".") == text
)


@settings(max_examples=20)
@given(st.lists(names, min_size=1, max_size=3, unique=True))
def test_any_name(tmp_path_factory, drawn):
    folder, written = tmp_path_factory.mktemp("names"), feature(0, count=3)
    paths = [f"sub/{name}" for name in drawn]
    for file in ("f.h5", "f.npz"):
        write_features(folder / file, paths, [(row, written) for row in range(len(paths))])
        assert open_features(folder / file, paths).counts.tolist() == [3] * len(paths)


@pytest.mark.parametrize("file", PATHS)
def test_a_failure_leaves_no_unfinished_file(tmp_path, file):
    def broken():
        yield 0, feature(9)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_features(tmp_path / file, NAMES, broken())
    left = [path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file()]
    assert left == ([f"{file}/{NAMES[0]}.npz"] if file == "feats" else [])


def test_what_cannot_be_written(tmp_path):
    written = feature(0)
    loud = type(written)(**(vars(written) | {"scores": written.scores * 1e6}))
    with pytest.raises(InputError, match=r"a\.jpg: scores: .*float16"):
        write_features(tmp_path / "f.h5", ["a.jpg"], [(0, loud)], half=True)
    for name in ("../a.jpg", "/a.jpg", ""):
        with pytest.raises(InputError, match="expected a path below the folder of images"):
            write_features(tmp_path / "f", [name], [(0, written)])
    assert not list(tmp_path.iterdir())
