"""torch's files: read as data, or refused in one line and nothing executed."""

import os
import pickle
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from mfvpr.errors import InputError
from mfvpr.weights.checkpoint import read_checkpoint
from tests.checkpoints import ALIKED, random_checkpoint, read_zip
from tests.weights.conftest import SOURCE_SHAPES

ROOT = Path(__file__).parent.parent.parent


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
    assert "weights_only" not in message
    return message


@pytest.fixture
def checkpoint(torch, tmp_path):
    """Writes a checkpoint of the small network: its values, and what holds them."""

    def write(wrap=lambda tensors: tensors, name="file.pth", **options):
        arrays = random_checkpoint(SOURCE_SHAPES)
        path = tmp_path / name
        torch.save(wrap({key: torch.from_numpy(array) for key, array in arrays.items()}), path, **options)
        return path, arrays

    return write


@pytest.mark.parametrize(
    "wrap",
    [
        lambda tensors: tensors,
        lambda tensors: {"model": tensors, "optimizer": {"lr": 1e-3}, "epoch": 3},
        lambda tensors: {"state_dict": tensors, "num_pcs": 128},
    ],
    ids=["flat", "model", "state_dict"],
)
@pytest.mark.parametrize("zipped", [True, False])
def test_layouts_of_checkpoints(checkpoint, wrap, zipped):
    path, arrays = checkpoint(wrap, _use_new_zipfile_serialization=zipped)
    found = read_checkpoint(path)
    assert list(found) == list(arrays)
    for key, array in arrays.items():
        np.testing.assert_array_equal(found[key], array)
        assert found[key].dtype == array.dtype


def test_types_of_tensors(torch, tmp_path):
    tensors = {
        "half": torch.arange(6, dtype=torch.float16).reshape(2, 3).T,
        "bfloat": torch.tensor([1.5, -2.0], dtype=torch.bfloat16),
        "double": torch.nn.Parameter(torch.zeros(3, dtype=torch.float64)),
    }
    torch.save(tensors, tmp_path / "file.pth")
    found = read_checkpoint(tmp_path / "file.pth")
    np.testing.assert_array_equal(found["half"], np.arange(6, dtype=np.float16).reshape(2, 3).T)
    np.testing.assert_array_equal(found["bfloat"], np.float32([1.5, -2]))
    assert found["double"].dtype == np.float64


@pytest.mark.parametrize("zipped", [True, False])
def test_code_in_a_pickle_is_refused_and_not_executed(torch, tmp_path, zipped):
    path, made = tmp_path / "evil.pth", tmp_path / "made"
    torch.save({"model": {"weight": Runs(made)}}, path, _use_new_zipfile_serialization=zipped)
    before = path.read_bytes()
    assert f"it asks for {os.mkdir.__module__}.mkdir; nothing was executed" in refused(path)
    assert not made.exists()
    assert path.read_bytes() == before


def test_plain_pickles_are_refused_and_not_executed(torch, tmp_path):
    path, made = tmp_path / "evil.pth", tmp_path / "made"
    path.write_bytes(pickle.dumps(Runs(made)))
    assert "nothing was executed" in refused(path)
    assert not made.exists()


def test_damage(checkpoint):
    path, _ = checkpoint()
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    assert "truncated; download it again" in refused(path)
    start = whole.index(b"net.conv.weight")
    path.write_bytes(whole[:start] + b"\xff" * 12 + whole[start + 12 :])
    assert "damaged; download it again" in refused(path)
    old, _ = checkpoint(_use_new_zipfile_serialization=False)
    old.write_bytes(old.read_bytes()[:-100])
    assert "damaged; download it again" in refused(old)


def test_what_is_no_checkpoint(tmp_path):
    path = tmp_path / "file.pth"
    assert "No such file" in refused(path)
    assert "got a folder" in refused(tmp_path)
    path.write_bytes(b"")
    assert "got an empty file" in refused(path)
    path.write_text("<!DOCTYPE html><title>Virus scan warning</title>")
    assert "got a text file, perhaps a web page" in refused(path)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(100))
    assert "got another kind of file" in refused(path)
    os.mkfifo(tmp_path / "pipe")
    assert "got no plain file" in refused(tmp_path / "pipe")


def test_other_content(torch, tmp_path):
    path = tmp_path / "file.pth"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("hello.txt", "hello")
    assert "damaged" in refused(path)
    torch.save([torch.zeros(3)], path)
    assert "expected tensors by name, got list" in refused(path)
    torch.save({"state_dict": {}}, path)
    assert "got an empty dict" in refused(path)
    torch.save({"a": torch.zeros(3), "note": "text"}, path)
    assert "expected tensors only, got str at note" in refused(path)
    torch.save({"a": torch.eye(3).to_sparse()}, path)
    assert "expected dense tensors, got torch.sparse_coo at a" in refused(path)


def test_without_torch_the_mend_is_told(tmp_path):
    """In a process where torch cannot be imported."""
    path = tmp_path / "d2_tf.pth"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("d2_tf/data.pkl", pickle.dumps({}))
    code = f"import sys; sys.modules['torch'] = None; sys.argv[1:] = ['convert', {str(path)!r}]; " \
           "from experiments.weights import main; main()"  # fmt: skip
    environment = os.environ | {"MFVPR_WEIGHTS": str(tmp_path / "weights")}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, env=environment, capture_output=True, text=True, timeout=60
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "error: converting checkpoints needs PyTorch, and nothing else does: pip install torch\n"
    assert not (tmp_path / "weights").exists()


@pytest.mark.skipif(not ALIKED.is_dir(), reason="no ../shared/weights: weights do not ship with the project")
@pytest.mark.parametrize("name", ["aliked-t16", "aliked-n32"])
def test_the_tests_own_reader_agrees_with_torch(torch, name):
    ours, theirs = read_zip(ALIKED / f"{name}.pth"), read_checkpoint(ALIKED / f"{name}.pth")
    assert list(ours) == list(theirs)
    for key, array in ours.items():
        assert array.dtype == theirs[key].dtype
        np.testing.assert_array_equal(array, theirs[key])


def test_the_tests_own_reader_runs_nothing(torch, tmp_path):
    torch.save({"model": Runs(tmp_path / "made")}, tmp_path / "evil.pth")
    with pytest.raises(pickle.UnpicklingError, match="is not allowed"):
        read_zip(tmp_path / "evil.pth")
    assert not (tmp_path / "made").exists()
