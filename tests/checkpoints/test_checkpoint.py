"""Files of torch, and NumPy's of pickled layers: read as data, or refused in one line and nothing executed."""

import os
import pickle
import struct
import zipfile
from argparse import Namespace
from contextlib import suppress

import numpy as np
import pytest

from mfvpr.checkpoints.checkpoint import read_checkpoint
from mfvpr.utils import InputError
from tests.checkpoints.conftest import SOURCE_SHAPES
from tests.needs import ALIKED, LIGHTGLUE, needs
from tests.random_checkpoints import (
    Call,
    Global,
    View,
    Writer,
    layered,
    random_checkpoint,
    write_legacy,
    write_numpy,
    write_zip,
)

WRITERS = pytest.mark.parametrize("write", [write_zip, write_legacy])
REAL = (*(ALIKED / f"aliked-{name}.pth" for name in ("n16", "n16rot", "n32", "t16")), LIGHTGLUE)


class Runs:
    """A pickle that wants to make a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def refused(path):
    with pytest.raises(InputError) as caught:
        read_checkpoint(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    assert len(message) < len(str(path)) + 250
    return message


def refused_content(path, content):
    """Message for this content in a zip file; an old file is refused as well."""
    refused(write_legacy(path, content))
    return refused(write_zip(path, content))


def assert_same(arrays, expected):
    assert list(arrays) == list(expected)
    for key, array in expected.items():
        np.testing.assert_array_equal(arrays[key], array)
        assert (arrays[key].dtype, arrays[key].shape) == (array.dtype, array.shape)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "file.pth"


@pytest.fixture
def arrays():
    return random_checkpoint(SOURCE_SHAPES)


@pytest.mark.parametrize(
    "wrap",
    [
        lambda tensors: tensors,
        lambda tensors: {"model": tensors, "optimizer": {"lr": 1e-3, 0: [None, (True, 2**40)]}, "epoch": 3},
        lambda tensors: {"state_dict": tensors, "num_pcs": 128},
    ],
    ids=["flat", "model", "state_dict"],
)
@WRITERS
def test_layouts_of_checkpoints(path, arrays, wrap, write):
    assert_same(read_checkpoint(write(path, wrap(arrays))), arrays)


@WRITERS
def test_strided_views_of_storages(path, write):
    values = np.arange(24, dtype=np.float32)
    views = {
        "part": View(values, 2, (2, 3), (6, 2)),
        "transposed": np.arange(6.0).reshape(2, 3).T,
        "last": View(values, 23, (), ()),
        "none": View(values, 24, (0, 5), (5, 1)),
    }
    refused(write(path, views | {"ends": View(values, 3, (4,), (7,), count=25, key="9")}))
    arrays = read_checkpoint(write(path, views))
    np.testing.assert_array_equal(arrays["part"], [[2, 4, 6], [8, 10, 12]])
    np.testing.assert_array_equal(arrays["transposed"], [[0, 3], [1, 4], [2, 5]])
    assert arrays["last"] == 23
    assert arrays["none"].shape == (0, 5)


def test_both_byte_orders(path, arrays):
    assert_same(read_checkpoint(write_zip(path, arrays, order="big")), arrays)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("file/data.pkl", Writer().pickled({}))
        archive.writestr("file/byteorder", "middle")
    refused(path)


@pytest.mark.parametrize("zipped", [True, False])
def test_files_of_torch_are_read_as_torch_reads_them(torch, path, zipped):
    grid = torch.arange(24.0).reshape(2, 3, 4)
    tensors = {
        "plain": grid,
        "turned": grid.permute(2, 0, 1),
        "part": grid[1:, ::2, 1:],
        "scalar": torch.tensor(7),
        "same": grid,
        "parameter": torch.nn.Parameter(torch.randn(3, dtype=torch.float64)),
        "empty": torch.zeros(0, 3),
        "int": torch.tensor([-1], dtype=torch.int32),
        "bool": torch.tensor([True, False]),
        "int16": grid.short(),
        "int8": torch.tensor(-3, dtype=torch.int8),
        "uint8": torch.tensor([255], dtype=torch.uint8),
    }
    network = torch.nn.Sequential(torch.nn.Conv2d(3, 4, 3), torch.nn.BatchNorm2d(4))
    for content in (tensors, network.state_dict(), {"state_dict": network.state_dict(), "lr": [0.1, None]}):
        torch.save(content, path, _use_new_zipfile_serialization=zipped)
        theirs = torch.load(path, weights_only=True)
        theirs = theirs.get("state_dict", theirs)
        assert_same(read_checkpoint(path), {key: tensor.detach().numpy() for key, tensor in theirs.items()})


@needs(ALIKED, LIGHTGLUE)
@pytest.mark.parametrize("path", REAL, ids=lambda path: path.stem)
def test_real_files_are_read_as_torch_reads_them(torch, path):
    theirs = torch.load(path, map_location="cpu", weights_only=True)
    assert_same(read_checkpoint(path), {key: tensor.numpy() for key, tensor in theirs.items()})


@pytest.mark.parametrize("zipped", [True, False])
def test_other_tensors_of_torch_are_refused(torch, path, zipped):
    plain = torch.zeros(2)
    for tensor, words in (
        (plain.half(), "torch.HalfStorage"),
        (plain.to(torch.float8_e4m3fn), "torch._utils._rebuild_tensor_v3"),
        (torch.empty(2, device="meta"), "torch._utils._rebuild_meta_tensor_no_storage"),
        (torch.nn.Linear(2, 2), "torch.nn.modules.linear.Linear"),
    ):
        torch.save({"a": tensor}, path, _use_new_zipfile_serialization=zipped)
        assert words in refused(path)


@pytest.mark.parametrize("zipped", [True, False])
def test_notes_of_a_training_are_left_unread(torch, path, zipped):
    """As the public training code of D2-Net writes them, which torch's own safe reader refuses."""
    network = torch.nn.Linear(2, 3)
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
    network(torch.ones(1, 2)).sum().backward()
    optimizer.step()
    losses = [np.mean([0.5, 0.25]), np.float32(0.1)]
    notes = {"args": Namespace(lr=1e-3, gpu=None, dataset=("a", 2)), "epoch_idx": 9, "train_loss_history": losses}
    content = notes | {"model": network.state_dict(), "optimizer": optimizer.state_dict()}
    torch.save(content, path, _use_new_zipfile_serialization=zipped)
    assert_same(read_checkpoint(path), {key: tensor.numpy() for key, tensor in network.state_dict().items()})


def test_code_is_refused_and_not_executed(path, tmp_path):
    marker = tmp_path / "made"
    for content in (
        Call(Global("os", "mkdir"), (str(marker),)),
        {"a": np.zeros(3), "b": Call(Global("builtins", "exec"), (f"import os; os.mkdir({str(marker)!r})",))},
        {"a": View(np.zeros(3), module="os")},
    ):
        refused_content(path, content)
    assert not marker.exists()


@pytest.mark.parametrize("protocol", range(1, pickle.HIGHEST_PROTOCOL + 1))
def test_plain_pickles_are_refused_and_not_executed(path, tmp_path, protocol):
    path.write_bytes(b"\x80\x01" * (protocol < 2) + pickle.dumps(Runs(tmp_path / "made"), protocol))
    assert "nothing was executed" in refused(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.write(__file__, "file/data/0")
        archive.writestr("file/data.pkl", pickle.dumps({"model": {"weight": Runs(tmp_path / "made")}}, protocol))
    assert "nothing was executed" in refused(path)
    assert not (tmp_path / "made").exists()


@pytest.mark.parametrize(
    "view",
    [
        {"offset": 1},
        {"shape": (7,), "strides": (1,)},
        {"shape": (2, 2), "strides": (1, 5)},
        {"shape": (3,), "strides": (-1,)},
        {"count": 7},
    ],
    ids=str,
)
@WRITERS
def test_views_that_are_no_part_of_their_storage_are_refused(path, write, view):
    refused(write(path, {"a": View(np.zeros(6, np.float32), **view)}))


def test_damage_is_refused_wherever_it_is(path):
    """In every third byte of a small file: what is read in spite of it is what was written."""
    expected = {"a": np.arange(5, dtype=np.float32)}
    intact = write_zip(path, expected).read_bytes()
    for place in range(0, len(intact), 3):
        path.write_bytes(intact[:place] + bytes([intact[place] ^ 16]) + intact[place + 1 :])
        with suppress(InputError):
            assert_same(read_checkpoint(path), expected)
    for length in range(1, len(intact), 7):
        path.write_bytes(intact[:length])
        refused(path)


def test_zip_files_with_other_entries(path, arrays, tmp_path):
    write_zip(path, arrays)
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("../outside", "text")
        archive.writestr("/absolute", "text")
    assert_same(read_checkpoint(path), arrays)
    assert list(tmp_path.iterdir()) == [path]
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("other/data.pkl", "")
    assert "got another zip file" in refused(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("hello.txt", "hello")
    assert "got another zip file" in refused(path)
    assert "uncompressed" in refused(write_zip(path, arrays, compression=zipfile.ZIP_DEFLATED))


def test_what_is_no_checkpoint(path, tmp_path):
    assert "got nothing" in refused(path)
    assert "got a folder" in refused(tmp_path)
    path.write_bytes(b"")
    assert "got an empty file" in refused(path)
    path.write_text("<!DOCTYPE html><title>Virus scan warning</title>")
    assert "got a text file" in refused(path)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(100))
    assert "got another" in refused(path)
    os.mkfifo(tmp_path / "pipe")
    assert "got a pipe" in refused(tmp_path / "pipe")


def test_other_content(path):
    assert "expected tensors by name, got list" in refused_content(path, [np.zeros(3)])
    assert "expected tensors by name, got dict" in refused_content(path, {"state_dict": {}})
    assert "got str at note" in refused_content(path, {"a": np.zeros(3), "note": "text"})
    assert "asks for os.system" in refused_content(path, {"a": Global("os", "system")})


@pytest.fixture
def layers():
    rng = np.random.default_rng(0)
    return {
        "conv1_1.weights": rng.standard_normal((4, 3, 3, 3)).astype(np.float32),
        "conv1_1.bias": rng.standard_normal(300),
        "fc8a_1.weights": np.asfortranarray(rng.standard_normal((5, 2))),
        "fc8a_1.count": np.arange(-3, 3),
    }


@pytest.mark.parametrize("protocol", range(5))
def test_every_protocol(path, layers, protocol):
    assert_same(read_checkpoint(write_numpy(path, layered(layers), protocol=protocol)), layers)


def test_files_of_this_numpy_and_of_older_ones(path, layers):
    content = pickle.dumps(np.array(layered(layers), dtype=object), protocol=3)
    old = content.replace(b"numpy._core.multiarray", b"numpy.core.multiarray")
    assert old != content
    assert_same(read_checkpoint(write_numpy(path, old)), layers)
    for version in ((1, 0), (2, 0)):
        with path.open("wb") as file:
            np.lib.format.write_array(file, np.array(layered(layers), dtype=object), version)
        assert_same(read_checkpoint(path), layers)


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
def test_files_of_python_2(path, layers, protocol):
    with path.open("wb") as file:
        write_numpy(path, b"")
        file.seek(0, 2)
        Python2(file, protocol).dump(np.array(layered(layers), dtype=object))
    assert b"U\x07conv1_1" in path.read_bytes()
    assert_same(read_checkpoint(path), layers)


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
def test_code_in_files_of_numpy_is_refused(path, tmp_path, protocol):
    code = {"conv": {"weights": np.zeros(3), "bias": np.array([Runs(tmp_path / "made"), 1])}}
    for content in (pickle.dumps(code, protocol), code):  # without an array, in one
        assert "asks for posix.mkdir" in refused(write_numpy(path, content, protocol=protocol))
    assert not (tmp_path / "made").exists()
    np.load(path, allow_pickle=True)
    assert (tmp_path / "made").exists()


@pytest.mark.parametrize(
    "content", [{}, [np.zeros(3)], {"conv": {}}, {"conv": np.zeros(3)}, {"conv": {"weights": "text"}}, 3]
)
def test_other_content_of_numpy(path, content):
    refused(write_numpy(path, content))


@pytest.mark.parametrize("protocol", [2, 4])
def test_a_cut_file_is_refused(path, protocol):
    expected = {"conv": {"weights": np.arange(4, dtype=np.float32).reshape(2, 2), "bias": np.zeros(2)}}
    intact = write_numpy(path, expected, protocol=protocol).read_bytes()
    for length in range(len(intact)):
        path.write_bytes(intact[:length])
        refused(path)
