"""Runtime files: what was saved comes back byte for byte, or is refused by name and with the mend."""

import hashlib
import pickle
from functools import partial
from unittest.mock import patch

import numpy as np
import pytest

from mfvpr.checkpoints import REGISTRY, WeightsError, files, install, load_model, weights_folder
from mfvpr.checkpoints.files import load, read_provenance, save
from mfvpr.utils import InputError
from tests.checkpoints.conftest import PARAMETERS, SOURCE_SHAPES, tiny_entry
from tests.io.checks import one_line_error
from tests.random_checkpoints import d2net_shapes, random_checkpoint, write_legacy, write_zip


@pytest.fixture
def save_tiny(folder, tmp_path):
    """Saves arrays as `tiny`."""
    source = tmp_path / "tiny.pth"
    source.write_bytes(b"the source")
    return partial(save, REGISTRY["tiny"], source=source, parameters=PARAMETERS)


@pytest.fixture
def installed(save_tiny, arrays):
    return save_tiny(arrays)


def refused(words, name="tiny"):
    with pytest.raises(WeightsError) as caught:
        load(name)
    message = str(caught.value)
    assert words in message
    assert message.endswith(": mfvpr weights add tiny.pth")
    assert "\n" not in message
    assert str(pickle.loads(pickle.dumps(caught.value))) == message  # noqa: S301  from a worker process


def test_saved_arrays_come_back(installed, folder, arrays):
    assert [*folder.iterdir()] == [installed] == [folder / "tiny.safetensors"]
    loaded = load("tiny")
    assert loaded.keys() == arrays.keys()
    for path, array in arrays.items():
        np.testing.assert_array_equal(loaded[path], array)
        assert loaded[path].dtype == np.float32
    about = read_provenance("tiny")
    assert about.pop("sha256")
    source = {"source_file": "tiny.pth", "source_sha256": hashlib.sha256(b"the source").hexdigest()}
    assert about == {"name": "tiny", "like": None, "parameters": PARAMETERS} | source


def test_arrays_of_another_network_are_refused(save_tiny, arrays):
    arrays["conv.extra"] = arrays.pop("conv.bias")
    arrays["mix.0.kernel"] = arrays["mix.0.kernel"].T
    save_tiny(arrays)
    with pytest.raises(InputError, match=r"tiny\.safetensors: keys") as caught:
        load_model("tiny")
    assert all(name in str(caught.value) for name in ("conv.extra", "mix.0.kernel", "conv.bias", "install it again"))


def test_damage_is_refused(installed, arrays):
    content = installed.read_bytes()
    start = 8 + int.from_bytes(content[:8], "little")
    for place in (0, 9, start, start + 40, len(content) - 1):
        installed.write_bytes(content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :])
        refused("tiny.safetensors: ")
    for other in (b"", content[:-1], content[:start], files.safetensors.numpy.save(arrays)):
        installed.write_bytes(other)
        refused("tiny.safetensors: ")
    installed.rename(installed.with_name("d2_tf.safetensors")).write_bytes(content)
    with pytest.raises(WeightsError, match="expected a file of these weights"):
        load("d2_tf")
    refused("not installed in")


def test_a_crash_leaves_nothing_that_looks_complete(folder, arrays, save_tiny):
    with patch.object(files.safetensors.numpy, "save", side_effect=KeyboardInterrupt), pytest.raises(KeyboardInterrupt):
        save_tiny(arrays)
    assert not [*folder.iterdir()]


@pytest.mark.parametrize("name", ["../tiny", "unknown"])
def test_unknown_names(folder, name):
    with pytest.raises(InputError, match="expected the name of published weights"):
        load(name)


def test_values_that_are_not_finite_are_not_saved(folder, arrays, save_tiny):
    arrays["conv.bias"][1] = np.nan
    with pytest.raises(InputError, match=r"NaN or infinity in conv\.bias"):
        save_tiny(arrays)
    assert not folder.exists()


def test_folder(monkeypatch):
    monkeypatch.setenv("MFVPR_WEIGHTS", "~/w")
    assert weights_folder().is_absolute()
    assert weights_folder().name == "w"
    monkeypatch.setenv("MFVPR_WEIGHTS", "")
    assert weights_folder().parts[-3:] == (".cache", "mfvpr", "weights")


@pytest.mark.parametrize(
    ("tensors", "words"),
    [
        (random_checkpoint(d2net_shapes()), "keys do not fit the network"),
        ({f"{place}{99 * '.long'}": np.zeros(2) for place in range(500)}, "0.long.long"),
        ({"net.conv.weight": np.zeros(2, np.float16)}, "asks for torch.HalfStorage"),
    ],
    ids=["another network", "unknown network", "half"],
)
def test_foreign_files_are_one_short_line(folder, tmp_path, tensors, words):
    path = write_zip(tmp_path / "tiny.pth", tensors)
    with one_line_error(None, str(path), words, "use the official"):
        install(path, "tiny")
    assert not folder.exists()


def test_float64_is_rounded(folder, tmp_path):
    tensors = random_checkpoint(SOURCE_SHAPES)
    third = tensors["net.conv.bias"].astype(np.float64) / 3
    path = write_legacy(tmp_path / "tiny.pth", tensors | {"net.conv.bias": third})
    install(path, "tiny")
    np.testing.assert_array_equal(load("tiny")["conv.bias"], third.astype(np.float32))
    np.testing.assert_array_equal(load_model("tiny").mix[0].kernel[...], tensors["net.mix.0.weight"].T)


def test_a_file_of_another_hash_is_not_installed(folder, tmp_path, monkeypatch):
    path = write_zip(tmp_path / "tiny.pth", random_checkpoint(SOURCE_SHAPES))
    monkeypatch.setitem(REGISTRY, "tiny", tiny_entry(sha256="0" * 64))
    with pytest.raises(InputError, match=r"tiny\.pth: .*sha256 of tiny, 0{12}\.\.\., got [0-9a-f]{12}"):
        install(path, "tiny")
    assert not folder.exists()
    monkeypatch.setitem(REGISTRY, "tiny", tiny_entry(sha256=hashlib.sha256(path.read_bytes()).hexdigest()))
    assert install(path, "tiny").is_file()
