"""Every key once, every target once, every shape; and all that is wrong in one message."""

import hashlib

import numpy as np
import pytest

from mfvpr.errors import InputError
from mfvpr.weights.conversion import Layout, Rule, Table, convert
from mfvpr.weights.networks import NETWORKS, blueprint, network_of
from mfvpr.weights.registry import REGISTRY, entry_of
from tests.checkpoints import ALIKED, d2net_shapes, mixvpr_shapes, random_checkpoint, read_zip
from tests.weights.conftest import PARAMETERS, SHAPES, SOURCE_SHAPES, TABLE, tiny_entry

PUBLIC = {
    "d2_tf": d2net_shapes(),
    "mixvpr_4096": mixvpr_shapes(1024, 4),
    "mixvpr_512": mixvpr_shapes(256, 2),
    "mixvpr_128": mixvpr_shapes(64, 2),
}


@pytest.fixture
def source():
    return random_checkpoint(SOURCE_SHAPES)


def test_layouts(source):
    found = convert(source, TABLE, SHAPES)
    assert {path: array.shape for path, array in found.items()} == SHAPES
    assert all(array.dtype == np.float32 and array.flags.c_contiguous for array in found.values())
    np.testing.assert_array_equal(found["conv.kernel"][1, 2, 0, 3], source["net.conv.weight"][3, 0, 1, 2])
    np.testing.assert_array_equal(found["mix.1.kernel"], source["net.mix.1.weight"].T)
    np.testing.assert_array_equal(found["bn.var"], source["net.bn.running_var"])


def test_all_that_is_wrong_is_told_together(source):
    source["net.conv.kernel"] = source.pop("net.conv.weight")
    del source["net.mix.1.bias"]
    source["net.mix.2.bias"] = np.zeros(2, np.float32)
    source["net.bn.weight"] = np.zeros(7, np.float32)
    source["net.mix.0.weight"] = source["net.mix.0.weight"].T
    source["net.mix.1.weight"] = np.zeros((2, 5, 1), np.float32)
    with pytest.raises(InputError) as caught:
        convert(source, TABLE, SHAPES)
    message = str(caught.value)
    for words in (
        "unknown key net.conv.kernel",
        "nothing fills conv.kernel",
        "nothing fills mix.1.bias",
        "unknown key net.mix.2.bias",
        "net.bn.weight -> bn.scale: expected shape (4,), got (7,)",
        "net.mix.0.weight -> mix.0.kernel: expected shape (5, 4), got (4, 5)",
        "net.mix.1.weight -> mix.1.kernel: expected shape (2, 5), got (2, 5, 1)",
    ):
        assert words in message
    assert "\n" not in message
    assert message.startswith("7 of")


def test_filled_twice_and_ambiguous_rules(source):
    twice = Table((*TABLE.rules, Rule(r"copy", "conv.bias"), Rule(r"net\.bn\.bi.*", "bn.bias")), TABLE.ignored)
    with pytest.raises(InputError) as caught:
        convert(source | {"copy": np.zeros(4)}, twice, SHAPES)
    assert "copy and net.conv.bias both fill conv.bias" in str(caught.value)
    assert "net.bn.bias matches several rules" in str(caught.value)


def test_float64_and_scalars():
    table = Table((Rule("a", "a", Layout.LINEAR), Rule("s", "s")))
    found = convert({"a": np.arange(6.0).reshape(2, 3), "s": np.float64(2)}, table, {"a": (3, 2), "s": ()})
    assert found["a"].dtype == np.float32
    assert found["s"].shape == ()


def test_blueprint_of_the_small_network(folder):
    plan = blueprint(tiny_entry())
    assert dict(plan.shapes) == SHAPES
    assert plan.parameters == PARAMETERS


def test_a_blueprint_can_be_filled_twice(folder, arrays):
    plan = blueprint(tiny_entry())
    first = plan.filled(arrays)
    plan.filled({path: 2 * array for path, array in arrays.items()})
    np.testing.assert_array_equal(first.mix[1].kernel[...], arrays["mix.1.kernel"])
    assert first.bn.use_running_average


@pytest.mark.parametrize("name", PUBLIC)
def test_published_layouts_fit_the_networks(name):
    """By names and shapes alone: each parameter of the network comes from one key of the checkpoint."""
    plan = blueprint(entry_of(name))
    found = convert({key: np.zeros(shape) for key, shape in PUBLIC[name].items()}, NETWORKS[name].table, plan.shapes)
    assert found.keys() == plan.shapes.keys()
    assert plan.parameters == entry_of(name).parameters


@pytest.mark.skipif(not ALIKED.is_dir(), reason="no ../shared/weights: weights do not ship with the project")
@pytest.mark.parametrize("name", [name for name in REGISTRY if name.startswith("aliked")])
def test_real_aliked_weights_are_the_registrys_and_convert(name):
    entry = entry_of(name)
    content = (ALIKED / entry.file).read_bytes()
    assert len(content) == entry.size
    assert hashlib.sha256(content).hexdigest() == entry.sha256
    plan = blueprint(entry)
    found = convert(read_zip(ALIKED / entry.file), NETWORKS[name].table, plan.shapes)
    assert found.keys() == plan.shapes.keys()
    assert all(np.isfinite(array).all() for array in found.values())
    assert plan.parameters == entry.parameters


def test_registry():
    assert all(name == entry.name for name, entry in REGISTRY.items())
    assert len({entry.file for entry in REGISTRY.values()}) == len(REGISTRY)
    assert NETWORKS.keys() == {entry.name for entry in REGISTRY.values() if entry.network != "patchnetvlad"}
    hashes = [entry.sha256 for entry in REGISTRY.values() if entry.sha256]
    assert len(set(hashes)) == len(hashes) == 11
    assert all(len(digest) == 64 and int(digest, 16) for digest in hashes)
    with pytest.raises(InputError, match="network patchnetvlad is not part of this version"):
        network_of(entry_of("patchnetvlad_pitts_128"))
    with pytest.raises(InputError, match=r"aliked-n17: .*the nearest is aliked-n16"):
        entry_of("aliked-n17")


@pytest.mark.parametrize("name", [name for name in REGISTRY if name.startswith("patchnetvlad") and REGISTRY[name].size])
def test_patchnetvlad_sizes_agree_with_its_parameters(name):
    """The projection is stored in float64, the rest in float32; a container adds a few kilobytes."""
    entry = entry_of(name)
    projection = (512 * (16 if "mapillary" in name else 64) + 1) * int(name.rpartition("_")[2])
    assert 0 < entry.size - 4 * (entry.parameters + projection) < 30_000


def test_random_checkpoints_depend_on_names_not_on_order():
    forward = random_checkpoint(SOURCE_SHAPES)
    backward = random_checkpoint(dict(reversed(SOURCE_SHAPES.items())))
    assert all(np.array_equal(forward[key], backward[key]) for key in SOURCE_SHAPES)
    assert not np.array_equal(forward["net.conv.bias"], forward["net.bn.bias"])
    assert not np.array_equal(forward["net.conv.bias"], random_checkpoint(SOURCE_SHAPES, seed=1)["net.conv.bias"])
    assert (forward["net.bn.running_var"] > 0).all()
