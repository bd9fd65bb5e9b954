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
from tests.random_checkpoints import Global, layered, random_checkpoint, write_legacy, write_numpy, write_zip

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


def test_both_byte_orders(path, arrays):
    assert_same(read_checkpoint(write_zip(path, arrays, order="big")), arrays)


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


@pytest.mark.parametrize("protocol", range(1, pickle.HIGHEST_PROTOCOL + 1))
def test_code_is_refused_and_not_executed(path, tmp_path, protocol):
    code = Runs(tmp_path / "made")
    for write in (write_zip, write_legacy):
        assert "nothing was executed" in refused(write(path, {"a": np.zeros(3), "b": code}))
    path.write_bytes(b"\x80\x01" * (protocol < 2) + pickle.dumps(code, protocol))
    assert "nothing was executed" in refused(path)
    layers = {"conv": {"weights": np.zeros(3), "bias": np.array([code, 1])}}
    for content in (pickle.dumps(layers, protocol), layers):  # without an array, in one
        assert "nothing was executed" in refused(write_numpy(path, content, protocol=protocol))
    assert not (tmp_path / "made").exists()
    np.load(path, allow_pickle=True)
    assert (tmp_path / "made").exists()


def test_damage_is_refused_wherever_it_is(path):
    """In every third byte of a small file: what is read in spite of it is what was written."""
    expected = {"a": np.arange(5, dtype=np.float32)}
    intact = write_zip(path, expected).read_bytes()
    for place in range(0, len(intact), 3):
        path.write_bytes(intact[:place] + bytes([intact[place] ^ 16]) + intact[place + 1 :])
        with suppress(InputError):
            assert_same(read_checkpoint(path), expected)
    for write in (write_zip, write_legacy, lambda path, arrays: write_numpy(path, {"conv": arrays})):
        intact = write(path, expected).read_bytes()
        for length in range(1, len(intact), 7):
            path.write_bytes(intact[:length])
            refused(path)


def test_what_is_no_checkpoint(path, tmp_path, arrays):
    assert "got nothing" in refused(path)
    assert "got a folder" in refused(tmp_path)
    for content, words in (
        (b"", "got an empty or text file"),
        (b"<!DOCTYPE html><title>Virus scan warning</title>", "got an empty or text file"),
        (b"\x89PNG\r\n\x1a\n" + bytes(100), "got another"),
    ):
        path.write_bytes(content)
        assert words in refused(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("hello.txt", "hello")
    assert "got another zip file" in refused(path)
    assert "uncompressed" in refused(write_zip(path, arrays, compression=zipfile.ZIP_DEFLATED))


@WRITERS
@pytest.mark.parametrize(
    ("content", "words"),
    [
        ([np.zeros(3)], "expected tensors by name, got list"),
        ({"state_dict": {}}, "expected tensors by name, got "),
        ({"a": np.zeros(3), "note": "text"}, "got str at note"),
        ({"a": Global("os", "system")}, "asks for os.system"),
    ],
    ids=["list", "empty", "note", "global"],
)
def test_other_content(path, write, content, words):
    assert words in refused(write(path, content))


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
def test_every_protocol_of_numpy(path, layers, protocol):
    content = pickle.dumps(np.array(layered(layers), dtype=object), protocol=protocol)
    assert_same(read_checkpoint(write_numpy(path, content)), layers)
    old = content.replace(b"numpy._core.multiarray", b"numpy.core.multiarray")
    if protocol < 4:  # where the name's length is not stored
        assert_same(read_checkpoint(write_numpy(path, old)), layers)


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
        "a.part": grid[:, ::2, 1:],
        "a.scalar": np.array(2.5),
        "a.none": np.zeros((0, 3)),
        "b.i2": np.array([2], ">i2"),
        "b.u1": np.array([255], "u1"),
        "b.bool": np.array([True, False]),
    }
    loaded = read_checkpoint(write_numpy(path, layered(arrays), protocol=3))
    assert_same(loaded, {key: value.astype(value.dtype.newbyteorder("=")) for key, value in arrays.items()})


@pytest.mark.parametrize(
    "content", [{}, [np.zeros(3)], {"conv": {}}, {"conv": np.zeros(3)}, {"conv": {"weights": "text"}}, 3]
)
def test_other_content_of_numpy(path, content):
    refused(write_numpy(path, content))
