"""Folders of exported programs: another process gives the same bits, and damage is noticed."""

import hashlib
import json
import shutil
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export as jax_export

import mfvpr
from mfvpr import ExportShapes, InputError
from mfvpr.deployment import folders
from mfvpr.features import Aggregated, Sift, VladFitting
from mfvpr.retrieval import Retrieval
from tests.programs import ROOT

pytestmark = pytest.mark.thorough

SHAPES = ExportShapes(candidates=3, keypoints=20, image_size=(320, 240))


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A folder that only reads are allowed of."""
    folder = tmp_path_factory.mktemp("exported") / "histogram"
    mfvpr.export(folder, mfvpr.HistogramOfShifts(), SHAPES, with_shift=True, onnx=False)
    return folder


@pytest.fixture
def folder(written, tmp_path):
    """A copy that may be damaged."""
    return shutil.copytree(written, tmp_path / "histogram")


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
    files = {path.relative_to(written).as_posix() for path in written.rglob("*") if path.is_file()}
    assert {*description["files"]} == files - {"export.json"}
    assert len(files) == 1 + 1 + 7 + 2


def test_a_program_takes_arrays_of_jax_and_other_libraries(written):
    program = mfvpr.load_exported(written)
    inputs = inputs_of(program)
    expected = program(**inputs)
    assert {name: values.shape for name, values in expected.items()} == {"scores": (3,), "shift": (3, 2)}
    for name, values in program(**{name: jnp.asarray(array) for name, array in inputs.items()}).items():
        np.testing.assert_array_equal(values, expected[name])


@pytest.mark.parametrize(("change", "message"), [
    ({"points0": np.zeros((3, 21, 2), np.float32)}, r"points0: expected float32 \[3, 20, 2\], got .* \[3, 21, 2\]"),
    ({"points0": np.zeros((3, 20, 2))}, r"points0: expected float32 \[3, 20, 2\], got float64"),
    ({"mask": np.zeros((3, 20), np.uint8)}, r"mask: expected bool \[3, 20\], got uint8"),
    ({"ratio": np.zeros((3, 20))}, r"inputs: expected points0, points1, .*, got .*ratio"),
])  # fmt: skip
def test_wrong_inputs_are_refused(written, change, message):
    program = mfvpr.load_exported(written)
    with pytest.raises(InputError, match=message):
        program(**inputs_of(program) | change)
    with pytest.raises(InputError, match=r"inputs: expected points0, .*, got none"):
        program()


@pytest.mark.parametrize(("name", "size"), [
    ("image_size0", [0, 0]), ("image_size0", [-320, 240]), ("image_size0", [np.nan, 240]), ("image_size0", [240, 320]),
    ("image_size1", [[320, 240], [240, 320], [320, 240]]),
])  # fmt: skip
def test_image_sizes_that_cannot_be_right_are_refused(written, name, size):
    program = mfvpr.load_exported(written)
    with pytest.raises(InputError, match=rf"^{name}: expected \(width, height\)"):
        program(**inputs_of(program) | {name: np.array(size, np.float32)})


def test_sizes_of_padding_may_be_anything(written):
    program = mfvpr.load_exported(written)
    inputs = inputs_of(program)
    expected = program(**inputs)
    inputs["image_size1"][-1] = inputs["points1"][-1] = np.nan  # the last candidate has no matches
    assert program(**inputs)["scores"].tolist() == expected["scores"].tolist()


def test_a_system_checks_the_keypoints_of_both_images(tmp_path):
    pipeline = mfvpr.Pipeline(Sift(), Retrieval(Aggregated(Sift(), VladFitting())))
    system = mfvpr.System(pipeline, {"histogram": mfvpr.HistogramOfShifts()})
    program = mfvpr.export(tmp_path / "system", system, SHAPES, onnx=False)
    inputs = inputs_of(program)
    for name in ("image_size0", "image_size1"):
        with pytest.raises(InputError, match=name):
            program(**inputs | {name: inputs[name][..., ::-1].copy()})


def edit(folder, change):
    path = folder / "export.json"
    description = json.loads(path.read_text())
    change(description)
    path.write_text(json.dumps(description))


def flip(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


DAMAGE = {
    "no folder": (shutil.rmtree, r"export\.json: expected a folder of mfvpr\.export with this file, got nothing"),
    "no description": (lambda folder: (folder / "export.json").unlink(), "export.json: expected a folder of"),
    "no program": (lambda folder: (folder / "program.stablehlo").unlink(), "stablehlo: expected a file, got nothing"),
    "a bit": (lambda folder: flip(folder / "program.stablehlo"), "expected the file as it was exported, got a changed"),
    "a bit of an array": (lambda folder: flip(folder / "check" / "mask.npy"), "mask.npy: expected the file as it was"),
    "cut": (lambda folder: (folder / "export.json").write_text('{"format"'), "export.json: expected the format"),
    "a list": (lambda folder: (folder / "export.json").write_text("[]"), "export.json: expected the format"),
    "another version": (
        lambda folder: edit(folder, lambda d: d.update(format="mfvpr exported program 2")),
        "expected the format 'mfvpr exported program 1'",
    ),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_and_foreign_folders_are_refused_in_one_line(folder, damage):
    change, message = DAMAGE[damage]
    change(folder)
    with pytest.raises(InputError, match=message) as error:
        mfvpr.load_exported(folder)
    assert "\n" not in str(error.value)


def exchange_program(folder, content):
    (folder / "program.stablehlo").write_bytes(content)
    digest = hashlib.sha256(content).hexdigest()
    edit(folder, lambda description: description["files"].update({"program.stablehlo": digest}))


def test_a_program_that_calls_a_library_is_not_loaded(folder):
    exported = jax_export.export(jax.jit(jnp.linalg.cholesky))(jax.ShapeDtypeStruct((3, 3), np.float32))
    exchange_program(folder, bytes(exported.serialize()))
    with pytest.raises(
        InputError, match=r"program\.stablehlo: expected a program without calls .* got lapack_spotrf_ffi"
    ):
        mfvpr.load_exported(folder)


def test_a_program_that_jax_cannot_read_is_refused(folder):
    """With a hash that fits, as somebody else's program would have."""
    for content in (b"", b"no program", (folder / "program.stablehlo").read_bytes()[:1000]):
        exchange_program(folder, content)
        with pytest.raises(InputError, match=r"program\.stablehlo: expected a program that JAX .* reads, got") as error:
            mfvpr.load_exported(folder)
        assert "\n" not in str(error.value)


def test_a_folder_is_written_whole_or_not_at_all(tmp_path, monkeypatch):
    (tmp_path / "empty").mkdir()
    program = mfvpr.export(tmp_path / "empty", mfvpr.MatchCount(), SHAPES, onnx=False)
    assert program(mask=np.ones((3, 20), bool))["scores"].tolist() == [20, 20, 20]
    with pytest.raises(InputError, match=r"empty: expected a new or an empty folder, got another"):
        mfvpr.export(tmp_path / "empty", mfvpr.MatchCount(), SHAPES, onnx=False)
    monkeypatch.setattr(np, "save", lambda *_, **__: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        mfvpr.export(tmp_path / "new", mfvpr.MatchCount(), SHAPES, onnx=False)
    assert [path.name for path in tmp_path.iterdir()] == ["empty"]


def test_without_jax2onnx_the_description_says_so_and_a_request_fails(tmp_path, monkeypatch):
    monkeypatch.setattr(folders.onnx_models, "find_spec", lambda _: None)
    program = mfvpr.export(tmp_path / "count", mfvpr.MatchCount(), SHAPES)
    assert program.description["onnx"] == {"missing": "jax2onnx is not installed"}
    with pytest.raises(InputError, match=r"onnx=True: expected the package jax2onnx.*pip install 'mfvpr\[export\]'"):
        mfvpr.export(tmp_path / "model", mfvpr.MatchCount(), SHAPES, onnx=True)
    assert not (tmp_path / "model").exists()


def test_paths_that_cannot_be_a_new_folder_are_one_line(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "folder")
    (tmp_path / "dangling").symlink_to(tmp_path / "none")
    monkeypatch.chdir(tmp_path / "folder")
    for name in ("../file", "../file/below", "../link", "../dangling", "."):
        with pytest.raises(InputError) as error:
            mfvpr.export(name, mfvpr.MatchCount(), ExportShapes(2, 3, (64, 48)), onnx=False)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("size", [np.array([64, 48]), [64, 48], (64.0, 48.0)])
def test_sizes_may_be_arrays(size):
    assert ExportShapes(2, 3, size) == ExportShapes(2, 3, (64, 48))
    with pytest.raises(InputError, match="image_size"):
        ExportShapes(2, 3, (64, np.inf))
