"""Folders of exported programs: another process gives the same bits, and wrong inputs are refused."""

import json
import shutil
import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest

import mfvpr
from mfvpr import ExportShapes, InputError
from mfvpr.deployment import folders
from tests.deployment.test_programs import make_system
from tests.programs import ROOT

pytestmark = pytest.mark.thorough

SHAPES = ExportShapes(candidates=3, keypoints=20, image_size=(320, 240))


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A folder that only reads are allowed of."""
    folder = tmp_path_factory.mktemp("exported") / "histogram"
    mfvpr.export(folder, mfvpr.HistogramOfShifts(), SHAPES, with_shift=True, onnx=False)
    return folder


def inputs_of(program):
    return {each.name: np.load(program.folder / "check" / f"{each.name}.npy") for each in program.inputs}


@pytest.mark.optimized
def test_a_fresh_process_without_the_scorer_gives_the_same_bits(written):
    code = f"""
import mfvpr
program = mfvpr.load_exported({str(written)!r})
assert program.check() == 0.0
print(",".join(each.name for each in program.outputs))
"""
    process = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert (process.returncode, process.stdout) == (0, "scores,shift\n"), process.stderr


def test_the_description_has_inputs_units_capacities_parameters_versions_and_platforms(written):
    description = json.loads((written / "export.json").read_text())
    points, scores = description["inputs"][0], description["outputs"][0]
    assert points == {"name": "points0", "shape": [3, 20, 2], "dtype": "float32", "unit": "px", "axes": "CK2"}
    assert scores == {"name": "scores", "shape": [3], "dtype": "float32", "unit": "", "axes": "C"}
    assert description["platforms"] == ["cpu", "cuda"]
    assert description["parameters"]["scores"].items() >= {"class": "HistogramOfShifts", "bin_size": 15.0}.items()
    assert description["parameters"]["scores"]["max_bins"] == 48  # 2 * 320 / 15, a multiple of 8
    assert description["image_size"] == [320, 240]
    assert {"mfvpr", "jax", "jaxlib"} <= description["versions"].keys()
    assert len([path for path in written.rglob("*") if path.is_file()]) == 1 + 1 + 7 + 2


SIZES = r"expected \(width, height\) of images that contain all points"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points0": np.zeros((3, 21, 2), np.float32)}, r"points0: expected float32 \[3, 20, 2\], got .* \[3, 21, 2\]"),
        ({"mask": np.zeros((3, 20), np.uint8)}, r"mask: expected bool \[3, 20\], got uint8"),
        ({"ratio": np.zeros((3, 20))}, r"inputs: expected points0, points1, .*, got .*ratio"),
        ({"image_size0": np.zeros(2, np.float32)}, f"image_size0: {SIZES}"),
        ({"image_size0": np.array([np.nan, 240], np.float32)}, f"image_size0: {SIZES}"),
        ({"image_size0": np.array([240, 320], np.float32)}, f"image_size0: {SIZES}"),
        ({"image_size1": np.array([[320, 240], [240, 320], [320, 240]], np.float32)}, f"image_size1: {SIZES}"),
    ],
)
def test_wrong_inputs_are_refused(written, change, message):
    program = mfvpr.load_exported(written)
    with pytest.raises(InputError, match=message):
        program(**inputs_of(program) | change)
    with pytest.raises(InputError, match=r"inputs: expected points0, .*, got none"):
        program()


def test_sizes_of_padding_may_be_anything(written):
    program = mfvpr.load_exported(written)
    inputs = inputs_of(program)
    expected = program(**{name: jnp.asarray(array) for name, array in inputs.items()})  # of JAX, as of NumPy
    assert {name: values.shape for name, values in expected.items()} == {"scores": (3,), "shift": (3, 2)}
    inputs["image_size1"][-1] = inputs["points1"][-1] = np.nan  # the last candidate has no matches
    assert program(**inputs)["scores"].tolist() == expected["scores"].tolist()


def test_a_system_checks_the_keypoints_of_both_images(tmp_path):
    program = mfvpr.export(tmp_path / "system", make_system({"count": mfvpr.HistogramOfShifts()}), SHAPES, onnx=False)
    inputs = inputs_of(program)
    for name in ("image_size0", "image_size1"):
        with pytest.raises(InputError, match=name):
            program(**inputs | {name: inputs[name][..., ::-1].copy()})


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("program.stablehlo", "no program", r"program\.stablehlo: cannot be read .*a program that JAX .* reads"),
        ("export.json", '{"format": "mfvpr exported program 2"}', "expected the format 'mfvpr exported program 1'"),
    ],
)
def test_damaged_and_foreign_folders_are_refused_in_one_line(written, tmp_path, name, content, message):
    folder = shutil.copytree(written, tmp_path / "histogram")
    (folder / name).write_text(content)
    with pytest.raises(InputError, match=message) as error:
        mfvpr.load_exported(folder)
    assert "\n" not in str(error.value)
    with pytest.raises(InputError, match=r"export\.json: expected a folder of mfvpr\.export .*, got nothing"):
        mfvpr.load_exported(tmp_path)


def test_a_program_is_written_to_a_new_or_an_empty_folder(tmp_path):
    (tmp_path / "empty").mkdir()
    program = mfvpr.export(tmp_path / "empty", mfvpr.MatchCount(), SHAPES, onnx=False)
    assert program(mask=np.ones((3, 20), bool))["scores"].tolist() == [20, 20, 20]
    with pytest.raises(InputError, match="empty: expected a new or an empty folder"):
        mfvpr.export(tmp_path / "empty", mfvpr.MatchCount(), SHAPES, onnx=False)


def test_without_jax2onnx_the_description_says_so_and_a_request_fails(tmp_path, monkeypatch):
    monkeypatch.setattr(folders, "find_spec", lambda name: None if name == "jax2onnx" else name)
    program = mfvpr.export(tmp_path / "count", mfvpr.MatchCount(), SHAPES)
    assert program.description["onnx"] == {"missing": "jax2onnx is not installed"}
    with pytest.raises(InputError, match=r"onnx=True: expected the package jax2onnx.*pip install 'mfvpr\[export\]'"):
        mfvpr.export(tmp_path / "model", mfvpr.MatchCount(), SHAPES, onnx=True)
    assert not (tmp_path / "model").exists()
