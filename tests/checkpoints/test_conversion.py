"""Conversion of checkpoints: every key and target once, every type and shape, errors in one short message."""

import hashlib

import numpy as np
import pytest

from mfvpr.checkpoints import REGISTRY, entry_of
from mfvpr.checkpoints.checkpoint import read_checkpoint
from mfvpr.checkpoints.conversion import TABLES, Table, convert
from mfvpr.checkpoints.networks import plan_network
from mfvpr.utils import InputError
from tests import random_checkpoints as checkpoints
from tests.checkpoints.conftest import PARAMETERS, SHAPES, SOURCE_SHAPES, TABLE, tiny_entry
from tests.needs import ALIKED, LIGHTGLUE, needs
from tests.random_checkpoints import d2net_shapes, mixvpr_shapes, places365_shapes, random_checkpoint

pytestmark = pytest.mark.thorough

PUBLIC = {
    "d2_tf": d2net_shapes(),
    "mixvpr_4096": mixvpr_shapes(1024, 4),
    "mixvpr_512": mixvpr_shapes(256, 2),
    "mixvpr_128": mixvpr_shapes(64, 2),
    "vgg16_places365": places365_shapes(),
    "aliked-t16": checkpoints.aliked_shapes(),
    **{
        f"aliked-n{kind}": checkpoints.aliked_shapes((16, 32, 64, 128), 128, positions)
        for kind, positions in (("16", 16), ("16rot", 16), ("32", 32))
    },
    "aliked_lightglue": checkpoints.lightglue_shapes(),
    **{f"patchnetvlad_mapillary_{outputs}": checkpoints.netvlad_shapes(16, outputs) for outputs in (4096, 512, 128)},
    **{f"patchnetvlad_pitts_{outputs}": checkpoints.netvlad_shapes(64, outputs) for outputs in (4096, 512, 128)},
    "patchnetvlad_landmarks_4096": checkpoints.netvlad_shapes(64, 4096),
    "netvlad_pytorch": checkpoints.netvlad_shapes(64, None),
    **{f"netvlad_{training}": checkpoints.matlab_shapes() for training in ("pitts30k", "tokyotm")},
    "cosplace_vgg16_512": checkpoints.gem_shapes("vgg16", 512),
    **{f"cosplace_resnet50_{outputs}": checkpoints.gem_shapes("resnet50", outputs) for outputs in (512, 2048)},
    **{
        f"dinov2_vit{size}14": checkpoints.dinov2_shapes(width, depth)
        for size, width, depth in (("s", 384, 12), ("b", 768, 12), ("l", 1024, 24))
    },
    **{f"selavpr_{training}": checkpoints.selavpr_shapes() for training in ("pitts30k", "msls")},
    "selavpr_msls_registers": checkpoints.selavpr_shapes(registers=4),
}


@pytest.fixture
def source():
    return random_checkpoint(SOURCE_SHAPES)


def test_layouts(source):
    parameters = convert(source, TABLE, SHAPES)
    assert {path: array.shape for path, array in parameters.items()} == SHAPES
    assert all(array.dtype == np.float32 and array.flags.c_contiguous for array in parameters.values())
    np.testing.assert_array_equal(parameters["conv.kernel"][1, 2, 0, 3], source["net.conv.weight"][3, 0, 1, 2])
    np.testing.assert_array_equal(parameters["mix.1.kernel"], source["net.mix.1.weight"].T)
    np.testing.assert_array_equal(parameters["bn.var"], source["net.bn.running_var"])


def message(source, table=TABLE):
    with pytest.raises(InputError) as caught:
        convert(source, table, SHAPES)
    assert len(str(caught.value)) < 300
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"net.conv.kernel": np.zeros(3)}, "in 1 places: net.conv.kernel unknown"),
        ({"net.mix.1.bias": None}, "in 1 places: mix.1.bias missing"),
        ({"net.bn.weight": np.zeros(7)}, "net.bn.weight of another shape: (7,) does not give (4,)"),
        ({"net.mix.0.weight": np.zeros((4, 5))}, "net.mix.0.weight of another shape"),
        ({"net.mix.1.weight": np.zeros((2, 5, 3))}, "net.mix.1.weight of another shape"),
        ({"net.mix.0.weight": np.zeros(5)}, "net.mix.0.weight of another shape"),
        *(
            (
                {"net.mix.0.bias": np.ones(5, dtype)},
                f"net.mix.0.bias of another type: expected float32 or float64, got {dtype}",
            )
            for dtype in ("float16", "int64", "complex64", "bool")
        ),
    ],
)
def test_what_is_wrong_is_named(source, change, words):
    changed = {key: value for key, value in (source | change).items() if value is not None}
    assert words in message(changed)


def test_filled_twice(source):
    table = Table({**TABLE.names, "copy": "conv.bias"})
    assert "in 1 places: copy twice" in message(source | {"copy": np.zeros(4)}, table)


def test_a_blueprint_can_be_filled_twice(folder, arrays):
    plan = plan_network(tiny_entry().builder())
    assert dict(plan.shapes) == SHAPES
    assert plan.parameters == PARAMETERS
    first = plan.build(arrays)
    plan.build({path: 2 * array for path, array in arrays.items()})
    np.testing.assert_array_equal(first.mix[1].kernel[...], arrays["mix.1.kernel"])
    assert first.bn.use_running_average


@pytest.mark.first_case
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name.startswith("selavpr") else []) for name in PUBLIC]
)
def test_published_layouts_fit_the_networks(name):
    """Each parameter of the network comes from one key of the checkpoint."""
    plan = plan_network(entry_of(name).builder())
    parameters = convert(vacant(PUBLIC[name]), entry_of(name).table, plan.shapes)
    assert parameters.keys() == plan.shapes.keys()


def vacant(shapes):
    """Arrays of these shapes that take no memory."""
    return {key: np.broadcast_to(np.float32(0), shape) for key, shape in shapes.items()}


def test_vgg16_of_other_classes_is_not_that_of_places365():
    source = vacant(places365_shapes() | {"fc8a_1.weights": (1000, 4096), "fc8a_1.bias": (1000,)})
    with pytest.raises(InputError, match=r"weights .*: expected \(365, 4096\), got \(1000, 4096\)"):
        convert(source, TABLES["ssm"], plan_network(entry_of("vgg16_places365").builder()).shapes)


@needs(ALIKED, LIGHTGLUE)
@pytest.mark.parametrize("name", [name for name in REGISTRY if name.startswith("aliked")])
def test_real_weights_are_the_registrys_and_convert(name):
    entry = entry_of(name)
    file = (LIGHTGLUE.parent if name == LIGHTGLUE.stem else ALIKED) / entry.file
    content = file.read_bytes()
    assert len(content) == entry.size
    assert hashlib.sha256(content).hexdigest() == entry.sha256
    plan = plan_network(entry.builder())
    parameters = convert(read_checkpoint(file), entry.table, plan.shapes)
    assert parameters.keys() == plan.shapes.keys()
    assert all(np.isfinite(array).all() for array in parameters.values())


def test_registry():
    assert len({entry.file for entry in REGISTRY.values()}) == len(REGISTRY)
    hashes = [entry.sha256 for entry in REGISTRY.values() if entry.sha256]
    assert len(set(hashes)) == len(hashes) == 14
    assert all(len(digest) == 64 and int(digest, 16) for digest in hashes)
    with pytest.raises(InputError, match=r"aliked-n17: .*the nearest is aliked-n16"):
        entry_of("aliked-n17")
