"""Runtime files: what was saved comes back byte for byte, or is refused by name and with the mend."""

import hashlib
import json
import pickle
from functools import partial
from unittest.mock import patch

import numpy as np
import pytest

from mfvpr.checkpoints import REGISTRY, WeightsError, files, install, load_model, weights_folder
from mfvpr.checkpoints.files import load, save
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
    assert message.endswith(
        ("; install it again: mfvpr weights add tiny.pth", "and install it: mfvpr weights add tiny.pth")
    )
    assert "\n" not in message
    assert str(pickle.loads(pickle.dumps(caught.value))) == message  # noqa: S301  from a worker process


def test_saved_arrays_come_back(installed, folder, arrays, save_tiny):
    assert installed == folder / "tiny.safetensors"
    loaded = load("tiny")
    assert loaded.keys() == arrays.keys()
    for path, array in arrays.items():
        np.testing.assert_array_equal(loaded[path], array)
        assert loaded[path].dtype == np.float32
    assert sorted(path.name for path in folder.iterdir()) == ["tiny.json", "tiny.safetensors"]
    content = installed.read_bytes()
    assert json.loads(installed.with_suffix(".json").read_text()) == {
        "name": "tiny",
        "sha256": hashlib.sha256(content).hexdigest(),
        "parameters": PARAMETERS,
        "source_file": "tiny.pth",
        "source_sha256": hashlib.sha256(b"the source").hexdigest(),
        "like": "",
    }
    save_tiny(dict(reversed(arrays.items())))
    assert installed.read_bytes() == content


def test_arrays_of_another_network_are_refused(save_tiny, arrays):
    arrays["conv.extra"] = arrays.pop("conv.bias")
    arrays["mix.0.kernel"] = arrays["mix.0.kernel"].T
    save_tiny(arrays)
    with pytest.raises(InputError, match=r"tiny\.safetensors: keys") as caught:
        load_model("tiny")
    assert all(name in str(caught.value) for name in ("conv.extra", "mix.0.kernel", "conv.bias", "install it again"))


@pytest.mark.parametrize("place", [30, -1])
def test_a_flipped_bit_is_refused(installed, place):
    content = bytearray(installed.read_bytes())
    content[place] ^= 1
    installed.write_bytes(content)
    refused("sha256")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        *((text, "") for text in ("", "[]", '{"name": "tiny"}')),
        ({"name": "d2_tf"}, "expected the manifest of tiny, got that of d2_tf"),
    ],
)
def test_other_manifests_are_refused(installed, text, words):
    manifest = installed.with_suffix(".json")
    if isinstance(text, dict):
        text = json.dumps(json.loads(manifest.read_text()) | text)
    manifest.write_text(text)
    refused(words or "expected a manifest;")
    manifest.unlink()
    refused("no manifest")


def test_a_crash_between_file_and_manifest_leaves_nothing_that_looks_complete(arrays, save_tiny):
    with patch.object(files, "write_text", side_effect=KeyboardInterrupt), pytest.raises(KeyboardInterrupt):
        save_tiny(arrays)
    refused("there is no manifest")
    save_tiny(arrays)
    arrays["conv.bias"] = np.ones(4, np.float32)
    with patch.object(files, "write_text", side_effect=KeyboardInterrupt), pytest.raises(KeyboardInterrupt):
        save_tiny(arrays)
    refused("sha256")


@pytest.mark.parametrize("name", ["../tiny", "unknown"])
def test_unknown_names(folder, name):
    with pytest.raises(InputError, match="no weights of this name"):
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


class TestInstall:
    """A checkpoint -> the runtime file."""

    @pytest.fixture
    def checkpoint(self, folder, tmp_path):
        tensors = random_checkpoint(SOURCE_SHAPES)
        return write_zip(tmp_path / "tiny.pth", tensors), tensors

    @pytest.mark.parametrize(
        ("tensors", "words"),
        [
            (random_checkpoint(d2net_shapes()), "keys do not fit the network"),
            ({f"{place}{99 * '.long'}": np.zeros(2) for place in range(500)}, "0.long.long"),
            ({"net.conv.weight": np.zeros(2, np.float16)}, "asks for torch.HalfStorage"),
        ],
        ids=["another network", "unknown network", "half"],
    )
    def test_foreign_files_are_one_short_line(self, checkpoint, folder, tensors, words):
        path, _ = checkpoint
        write_zip(path, tensors)
        with one_line_error(None, str(path), words, "use the official"):
            install(path, "tiny")
        assert not folder.exists()

    def test_float64_is_rounded(self, checkpoint):
        path, tensors = checkpoint
        third = tensors["net.conv.bias"].astype(np.float64) / 3
        write_legacy(path, tensors | {"net.conv.bias": third})
        before = path.read_bytes()
        install(path, "tiny")
        assert path.read_bytes() == before
        np.testing.assert_array_equal(load("tiny")["conv.bias"], third.astype(np.float32))
        np.testing.assert_array_equal(load_model("tiny").mix[0].kernel[...], tensors["net.mix.0.weight"].T)

    def test_wrong_hash(self, checkpoint, folder, monkeypatch):
        path, _ = checkpoint
        sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
        monkeypatch.setitem(REGISTRY, "tiny", tiny_entry(sha256="0" * 64))
        with pytest.raises(InputError, match=r"tiny\.pth: .*sha256 of tiny, 0{12}\.\.\., got [0-9a-f]{12}"):
            install(path, "tiny")
        monkeypatch.setitem(REGISTRY, "other", tiny_entry("other", sha256=sha256))
        with pytest.raises(InputError, match="got that of other"):
            install(path, "tiny")
        assert not folder.exists()
        monkeypatch.setitem(REGISTRY, "tiny", tiny_entry(sha256=sha256))
        assert install(path, "tiny").is_file()
