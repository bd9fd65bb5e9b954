"""ONNX models: the outputs of ONNX Runtime from Python and from C++."""

import json
import os
import shutil
import subprocess
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import mfvpr
from mfvpr import ExportShapes, InputError
from mfvpr.deployment import onnx_models
from tests.deployment.test_programs import HISTOGRAM, make_system
from tests.programs import ROOT

pytest.importorskip("jax2onnx", reason="jax2onnx, of the extra `export`, is not installed")
pytestmark = pytest.mark.thorough

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
    outputs = onnx_models.run((system_folder / "program.onnx").read_bytes(), inputs)
    assert [*outputs] == ["scores", "scores_anchor", "scores_count", "shift"]
    for each in program.outputs:
        expected = np.load(system_folder / "check" / f"{each.name}.npy")
        np.testing.assert_allclose(outputs[each.name], expected, rtol=1e-4, atol=1e-4)
        assert outputs[each.name].dtype == np.float32
    assert (outputs["scores_count"][:2] > 15).all()


def test_inputs_are_those_of_the_program(system_folder):
    """In the same order, so that C++ may number them."""
    import onnx

    graph = onnx.load(system_folder / "program.onnx").graph
    shapes = [(each.name, [axis.dim_value for axis in each.type.tensor_type.shape.dim]) for each in graph.input]
    description = json.loads((system_folder / "export.json").read_text())
    assert shapes == [(each["name"], each["shape"]) for each in description["inputs"]]


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
    monkeypatch.setattr(onnx_models, "run", lambda *_: {"scores": np.full(3, 7.0, np.float32)})
    with pytest.raises(InputError, match=r"onnx=True: expected outputs within 0.0001 of JAX's, got a difference of"):
        mfvpr.export(tmp_path / "count", mfvpr.MatchCount(), SHAPES, onnx=True)
    assert not (tmp_path / "count").exists()


@pytest.fixture(scope="module")
def cpp_program(tmp_path_factory):
    """The C++ example, built."""
    for tool in ("cmake", "c++"):
        if shutil.which(tool) is None:
            pytest.skip(f"{tool} is not installed")
    build = tmp_path_factory.mktemp("build")
    commands = [["cmake", "-S", str(ROOT / "experiments" / "cpp"), "-B", str(build)], ["cmake", "--build", str(build)]]
    configured = subprocess.run(commands[0], capture_output=True, text=True)
    if configured.returncode and "ONNXRUNTIME" in configured.stderr and not os.environ.get("ONNXRUNTIME_ROOT"):
        pytest.skip("ONNX Runtime for C++ is not installed; set ONNXRUNTIME_ROOT to its folder")
    assert configured.returncode == 0, configured.stderr
    subprocess.run(commands[1], check=True, capture_output=True)
    return build / "exported_scorer"


def run_cpp(program: Path, *arguments):
    process = subprocess.run([program, *map(str, arguments)], capture_output=True, text=True)
    return process.returncode, process.stdout, process.stderr


def test_cpp_gives_the_outputs_in_the_folder(cpp_program, system_folder, tmp_path):
    code, stdout, stderr = run_cpp(cpp_program, system_folder)
    assert (code, stderr) == (0, "")
    assert "largest difference: " in stdout
    changed = shutil.copytree(system_folder, tmp_path / "changed")
    np.save(changed / "check" / "scores_count.npy", np.full(3, 5, np.float32))
    code, stdout, _ = run_cpp(cpp_program, changed)
    assert code == 1
    (changed / "check" / "mask0.npy").unlink()
    assert run_cpp(cpp_program, changed)[0] == 2
