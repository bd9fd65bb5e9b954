"""The C++ examples, built and run on an exported scorer."""

import os
import shutil
import subprocess
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from mfvpr.deployment.folders import largest_difference
from tests.golden.make_exported import export_scorer
from tests.needs import skip_without
from tests.programs import ROOT

pytestmark = pytest.mark.thorough
GOLDEN = np.load(ROOT / "tests" / "golden" / "exported.npz")
EXAMPLES = ("scorer_openvino", "scorer_onnx_runtime")


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A scorer that was exported once, as ONNX."""
    folder = tmp_path_factory.mktemp("exported")
    (folder / "check").mkdir()
    for name in GOLDEN:
        (folder / name).write_bytes(GOLDEN[name].tobytes())
    return folder


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """The folder of the examples whose runtime is installed."""
    skip_without("cmake", "c++", "experiments")
    build, openvino = tmp_path_factory.mktemp("build"), find_spec("openvino")
    options = []
    if openvino is not None and openvino.origin is not None:
        options = [f"-DOpenVINO_DIR={Path(openvino.origin).parent / 'cmake'}"]
    if not options and "ONNXRUNTIME_ROOT" not in os.environ:
        skip_without("openvino")
    for command in (["-S", ROOT / "experiments" / "cpp", "-B", build, *options], ["--build", build]):
        done = subprocess.run(["cmake", *map(str, command)], capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
    return build


def run_example(program, *arguments):
    done = subprocess.run([program, *map(str, arguments)], capture_output=True, text=True)
    return done.returncode, done.stdout, done.stderr


def test_the_outputs_in_the_folder_are_those_of_this_library(exported, tmp_path):
    program = export_scorer(tmp_path / "exported", onnx=False)
    inputs, outputs = (
        {each.name: np.load(exported / "check" / f"{each.name}.npy") for each in tensors}
        for tensors in (program.inputs, program.outputs)
    )
    assert [*outputs] == ["scores", "shift"]
    assert (outputs["scores"][:2] > 0).all()
    values = program.run(*inputs.values())  # the call would refuse points outside of their image
    assert largest_difference(dict(zip(outputs, values, strict=True)), outputs) < 1e-5


@pytest.mark.parametrize("example", EXAMPLES)
def test_cpp_gives_the_outputs_in_the_folder(built, exported, tmp_path, example):
    program = built / example
    if not program.exists():
        pytest.skip(f"needs the runtime of {example}")
    code, stdout, stderr = run_example(program, exported)
    assert (code, stderr) == (0, "")
    scores = stdout.splitlines()[0].removeprefix("scores: ").split()
    np.testing.assert_allclose([*map(float, scores)], np.load(exported / "check" / "scores.npy"), rtol=1e-4)
    changed = shutil.copytree(exported, tmp_path / "changed")
    np.save(changed / "check" / "scores.npy", np.full(3, 5, np.float32))
    assert run_example(program, changed)[0] == 1
    np.save(changed / "check" / "scores.npy", np.full(3, np.nan, np.float32))
    assert run_example(program, changed)[0] == 1
    np.save(changed / "check" / "scores.npy", np.full(2, 5, np.float32))
    assert run_example(program, changed)[0] == 2
    (changed / "check" / "mask.npy").unlink()
    assert run_example(program, changed)[0] == 2
    assert run_example(program)[0] == 2
