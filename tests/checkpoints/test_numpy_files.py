"""NumPy's files of pickled layers: read as data, or refused in one line and nothing executed."""

import pickle
import struct

import numpy as np
import pytest

from mfvpr.checkpoints.checkpoint import read_checkpoint
from tests.checkpoints.test_checkpoint import Runs, assert_same, refused
from tests.random_checkpoints import layered, write_numpy


@pytest.fixture
def path(tmp_path):
    return tmp_path / "file.npy"


@pytest.fixture
def arrays():
    rng = np.random.default_rng(0)
    return {
        "conv1_1.weights": rng.standard_normal((4, 3, 3, 3)).astype(np.float32),
        "conv1_1.bias": rng.standard_normal(300),
        "fc8a_1.weights": np.asfortranarray(rng.standard_normal((5, 2))),
        "fc8a_1.count": np.arange(-3, 3),
    }


@pytest.mark.parametrize("protocol", range(5))
def test_every_protocol(path, arrays, protocol):
    assert_same(read_checkpoint(write_numpy(path, layered(arrays), protocol=protocol)), arrays)


def test_files_of_this_numpy_and_of_older_ones(path, arrays):
    content = pickle.dumps(np.array(layered(arrays), dtype=object), protocol=3)
    old = content.replace(b"numpy._core.multiarray", b"numpy.core.multiarray")
    assert old != content
    assert_same(read_checkpoint(write_numpy(path, old)), arrays)
    for version in ((1, 0), (2, 0)):
        with path.open("wb") as file:
            np.lib.format.write_array(file, np.array(layered(arrays), dtype=object), version)
        assert_same(read_checkpoint(path), arrays)


class Python2(pickle._Pickler):  # type: ignore
    """Writes strings as Python 2 does, where text is bytes."""

    dispatch = pickle._Pickler.dispatch.copy()  # type: ignore

    def save_string(self, value):
        content = value.encode("latin-1") if isinstance(value, str) else value
        length = len(content)
        self.write(b"U" + bytes([length]) if length < 256 else b"T" + struct.pack("<i", length))
        self.write(content)
        self.memoize(value)

    dispatch[str] = dispatch[bytes] = save_string


@pytest.mark.parametrize("protocol", [1, 2])
def test_files_of_python_2(path, arrays, protocol):
    with path.open("wb") as file:
        write_numpy(path, b"")
        file.seek(0, 2)
        Python2(file, protocol).dump(np.array(layered(arrays), dtype=object))
    assert b"U\x07conv1_1" in path.read_bytes()
    assert_same(read_checkpoint(path), arrays)


def test_layouts_of_values(path):
    grid = np.arange(24.0).reshape(2, 3, 4)
    arrays = {
        "a.big": grid.astype(">f4"),
        "a.fortran": np.asfortranarray(grid),
        "a.turned": grid.transpose(2, 0, 1),
        "a.both": np.asfortranarray(grid.astype(">f8")),
        "a.part": grid[:, ::2, 1:],
        "a.scalar": np.array(2.5),
        "a.none": np.zeros((0, 3)),
        "b.i8": np.array([-1]),
        "b.i4": np.array([2], "i4"),
        "b.i2": np.array([2], ">i2"),
        "b.i1": np.array([-3], "i1"),
        "b.u1": np.array([255], "u1"),
        "b.bool": np.array([True, False]),
    }
    loaded = read_checkpoint(write_numpy(path, layered(arrays), protocol=3))
    assert_same(loaded, {key: value.astype(value.dtype.newbyteorder("=")) for key, value in arrays.items()})


@pytest.mark.parametrize("protocol", range(5))
def test_code_is_refused_and_not_executed(path, tmp_path, protocol):
    code = {"conv": {"weights": np.zeros(3), "bias": np.array([Runs(tmp_path / "made"), 1])}}
    for content in (pickle.dumps(code, protocol), code):  # without an array, in one
        assert "asks for posix.mkdir" in refused(write_numpy(path, content, protocol=protocol))
    assert not (tmp_path / "made").exists()
    np.load(path, allow_pickle=True)
    assert (tmp_path / "made").exists()


@pytest.mark.filterwarnings("ignore:metadata on a dtype")
def test_other_types_that_numpy_writes_are_refused(path):
    for values in (
        np.array(["a", 3], dtype=object),
        np.array(["text"]),
        np.zeros(2, [("a", "f4"), ("b", "i4")]),
        np.array(["2020-01-01"], "M8[D]"),
        np.ma.zeros(3),
        np.zeros(3).view(np.recarray),
        np.float32(3),
    ):
        refused(write_numpy(path, {"a": {"b": values}}))


@pytest.mark.parametrize(
    "content", [{}, [np.zeros(3)], {"conv": {}}, {"conv": np.zeros(3)}, {"conv": {"weights": "text"}}, 3]
)
def test_other_content(path, content):
    refused(write_numpy(path, content))


@pytest.mark.parametrize("protocol", [2, 4])
def test_a_cut_file_is_refused(path, protocol):
    expected = {"conv": {"weights": np.arange(4, dtype=np.float32).reshape(2, 2), "bias": np.zeros(2)}}
    intact = write_numpy(path, expected, protocol=protocol).read_bytes()
    for length in range(len(intact)):
        path.write_bytes(intact[:length])
        refused(path)
