"""ONNX models, and their outputs in ONNX Runtime."""

import jax.numpy as jnp
import numpy as np
import pytest

import mfvpr
from mfvpr import ExportShapes, InputError
from mfvpr.deployment import folders
from tests.deployment.test_programs import HISTOGRAM, make_system
from tests.needs import needs

pytestmark = [pytest.mark.thorough, needs("jax2onnx")]

SHAPES = ExportShapes(candidates=3, keypoints=30, image_size=(320, 240))


@pytest.fixture(scope="module")
def system_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("exported") / "system"
    system = make_system({"histogram": HISTOGRAM, "anchor": mfvpr.AnchorPoints(), "count": mfvpr.MatchCount()})
    mfvpr.export(folder, system, SHAPES, with_shift=True, onnx=True)
    return folder


def test_onnx_runtime_gives_the_outputs_in_the_folder(system_folder):
    program = mfvpr.load_exported(system_folder)
    assert program.description["onnx"]["largest_difference"] <= program.description["onnx"]["tolerance"] == 1e-4
    inputs = {each.name: np.load(system_folder / "check" / f"{each.name}.npy") for each in program.inputs}
    import onnxruntime

    session = onnxruntime.InferenceSession(system_folder / "program.onnx", providers=["CPUExecutionProvider"])
    outputs = dict(zip((each.name for each in session.get_outputs()), session.run(None, inputs), strict=True))
    assert [*outputs] == ["scores", "scores_anchor", "scores_count", "shift"]
    for each in program.outputs:
        expected = np.load(system_folder / "check" / f"{each.name}.npy")
        np.testing.assert_allclose(outputs[each.name], expected, rtol=1e-4, atol=1e-4)
        assert outputs[each.name].dtype == np.float32
    assert (outputs["scores_count"][:2] > 15).all()
    shapes = [(each.name, each.shape) for each in session.get_inputs()]  # in this order, so that C++ may number them
    assert shapes == [(each.name, [*each.shape]) for each in program.inputs]


def search_sorted(matches):
    return jnp.sum(jnp.searchsorted(jnp.sort(matches.distance), matches.scores0)).astype(jnp.float32)


def test_an_operation_that_onnx_lacks_is_named(tmp_path):
    program = mfvpr.export(tmp_path / "search", search_sorted, SHAPES)
    assert (
        "expected operations that jax2onnx converts, got NotImplementedError" in program.description["onnx"]["missing"]
    )
    assert not (tmp_path / "search" / "program.onnx").exists()
    with pytest.raises(InputError, match="onnx=True: expected operations that jax2onnx converts") as error:
        mfvpr.export(tmp_path / "requested", search_sorted, SHAPES, onnx=True)
    assert "\n" not in str(error.value)


def test_a_model_with_other_outputs_is_not_written(tmp_path, monkeypatch):
    monkeypatch.setattr(folders, "largest_difference", lambda *_: 7.0)
    with pytest.raises(InputError, match=r"onnx=True: expected outputs within 0.0001 of JAX's, got a difference of 7"):
        mfvpr.export(tmp_path / "count", mfvpr.MatchCount(), SHAPES, onnx=True)
    assert not (tmp_path / "count").exists()
