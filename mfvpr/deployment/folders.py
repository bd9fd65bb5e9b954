"""Exported programs as StableHLO and ONNX, in folders with arrays to check them; without calls into Python."""

import json
import logging
import re
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import export as jax_export
from jax.extend.core import jaxpr_as_fun

from mfvpr.core.scorer import Scorer
from mfvpr.core.types import Array
from mfvpr.deployment.programs import ExportShapes, Program, Tensor, make_program
from mfvpr.evaluation.system import System
from mfvpr.features.network import XFeatFeatures
from mfvpr.io.containers import reading
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import write_text
from mfvpr.utils.fingerprints import recipe_of, versions
from mfvpr.utils.numerics import as_array

FORMAT = "mfvpr exported program 1"
DESCRIPTION, PROGRAM, MODEL, CHECK = "export.json", "program.stablehlo", "program.onnx", "check"
PLATFORMS = ("cpu", "cuda")
TOLERANCE = 1e-4  # of ONNX Runtime, which sums in another order: relative to outputs above 1, else absolute


@dataclass(frozen=True)
class ExportedProgram:
    """A program of a folder, called with an array for each input: `program(**arrays)["scores"]`."""

    folder: Path
    inputs: tuple[Tensor, ...]  # name, shape, dtype, unit and axes of each array that the program takes
    outputs: tuple[Tensor, ...]  # the same of each array that it returns
    description: Mapping[str, Any] = field(repr=False)  # content of `export.json`
    run: Callable[..., tuple[Array, ...]] = field(repr=False)

    def __call__(self, **arrays: Any) -> dict[str, np.ndarray]:
        """Outputs by name, NumPy.

        An `InputError` if an array is missing or has another shape or dtype, or if an image size that the program takes
        is not above 0, or is too small for the points: by more than 2 px and 1 %.
        """
        if arrays.keys() != (expected := {each.name: each for each in self.inputs}).keys():
            raise InputError(f"inputs: expected {', '.join(expected)}, got {', '.join(arrays) or 'none'}")
        values = {name: np.asarray(as_array(arrays[name])) for name in expected}
        for name, got in values.items():
            dtype, shape = expected[name].dtype, expected[name].shape
            if (str(got.dtype), got.shape) != (dtype, shape):
                raise InputError(f"{name}: expected {dtype} {[*shape]}, got {got.dtype} {[*got.shape]}")
        _require_sizes(values)
        outputs = map(np.asarray, self.run(*values.values()))
        return dict(zip((each.name for each in self.outputs), outputs, strict=True))

    def check(self) -> float:
        """Largest difference from the outputs in the folder, relative where they are above 1."""
        names = [each.name for each in (*self.inputs, *self.outputs)]
        arrays = {name: np.load(self.folder / CHECK / f"{name}.npy", allow_pickle=False) for name in names}
        expected = {each.name: arrays.pop(each.name) for each in self.outputs}
        return largest_difference(self(**arrays), expected)


def export(
    folder: Path | str,
    method: Scorer | System | XFeatFeatures,
    shapes: ExportShapes,
    *,
    with_shift: bool = False,
    with_confidence: bool = False,
    onnx: bool | None = None,
) -> ExportedProgram:
    """Write a scorer, the matcher and scorers of a system, or an extractor as a program that runs without Python.

        shapes = mfvpr.ExportShapes(candidates=50, keypoints=800, image_size=(640, 480))
        program = mfvpr.export("exported", mfvpr.HistogramOfShifts(), shapes)

    The program scores all candidates of one query, or extracts the keypoints of one image. The page of
    `mfvpr.deployment` lists files, inputs and limits.

    Args:
        folder: new or empty.
        method: a scorer takes matches; a system takes features, and returns the scores of all of its scorers;
            an `XFeatFeatures` takes an image of its size, uint8.
        shapes: sizes of all arrays.
        with_shift: also return the refined dominant shifts of the deciding `HistogramOfShifts`, `[C, 2]` px.
        with_confidence: whether a scorer takes the confidence of each match; if not, matches count fully.
        onnx: write an ONNX model as well; None = if the package jax2onnx is installed and has the operations.

    Raises:
        InputError: JAX cannot compile the scorer, or it calls Python or a library; `onnx` is True and there is no
            model, or its outputs differ; or the folder has files.
    """
    folder = Path(folder)
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise InputError(f"{folder}: expected a new or an empty folder; choose a new path")
    with jax.enable_x64(False):
        program = make_program(method, shapes, with_shift=with_shift, with_confidence=with_confidence)
        program = without_unused_inputs(program)
        content = bytes(export_program(program).serialize())
        inputs = check_inputs(program)
        run = jax.jit(jax_export.deserialize(bytearray(content)).call)
        values = run(*inputs.values())
        outputs = {each.name: np.asarray(array) for each, array in zip(program.outputs, values, strict=True)}
        model, onnx_note = None, {"missing": "not requested" if onnx is False else "jax2onnx is not installed"}
        if onnx or (onnx is None and find_spec("jax2onnx")):
            try:
                model, difference = to_onnx(program, inputs, outputs)
                onnx_note = {"largest_difference": difference, "tolerance": TOLERANCE}
            except InputError as error:
                if onnx:
                    raise
                onnx_note = {"missing": str(error)}
    recipes: dict[str, Any] = {}
    for name, part in program.parameters.items():
        try:
            recipes[name] = recipe_of(part)
        except TypeError:  # a plain function
            recipes[name] = {"function": getattr(part, "__qualname__", type(part).__qualname__)}
    description = {
        "format": FORMAT,
        "versions": versions(),
        "platforms": PLATFORMS,
        "inputs": [each._asdict() for each in program.inputs],
        "outputs": [each._asdict() for each in program.outputs],
        "axes": {"C": shapes.candidates, "K": shapes.keypoints, "D": program.shapes.dimension},
        "image_size": program.shapes.image_size,
        "parameters": recipes,
        "left_out": program.left_out,
        "onnx": onnx_note,
    }
    (folder / CHECK).mkdir(parents=True)
    (folder / PROGRAM).write_bytes(content)
    if model is not None:
        (folder / MODEL).write_bytes(model)
    for name, array in (inputs | outputs).items():
        np.save(folder / CHECK / f"{name}.npy", array, allow_pickle=False)
    # The description comes last: a folder without it is not loaded.
    write_text(folder / DESCRIPTION, json.dumps(description, indent=2, allow_nan=False) + "\n")
    return replace(load_exported(folder), run=run)  # compiled


def load_exported(folder: Path | str) -> ExportedProgram:
    """Load a program that `export` wrote, on this or on another computer.

        mfvpr.export("count", mfvpr.MatchCount(), mfvpr.ExportShapes(50, 800, (640, 480)), onnx=False)
        mfvpr.load_exported("count")(mask=np.ones((50, 800), bool))["scores"]  # [C]

    An `InputError` if a file is missing, or if this version of JAX cannot read the program.
    """
    folder = Path(folder)
    _require("flatbuffers", "load_exported")
    with reading(folder / DESCRIPTION, "a folder of mfvpr.export with this file", "export it again"):
        description = json.loads((folder / DESCRIPTION).read_text(encoding="utf-8"))
        if description["format"] != FORMAT:
            raise InputError(f"expected the format {FORMAT!r}; export it again with this version")
        tensors = [description["inputs"], description["outputs"]]
        inputs, outputs = (tuple(Tensor(**each | {"shape": tuple(each["shape"])}) for each in side) for side in tensors)
    with reading(folder / PROGRAM, mend=f"expected a program that JAX {jax.__version__} reads; export it again"):
        exported = jax_export.deserialize(bytearray((folder / PROGRAM).read_bytes()))
    return ExportedProgram(folder, inputs, outputs, description, jax.jit(exported.call))


def without_unused_inputs(program: Program) -> Program:
    """The program without inputs that have no effect on its outputs."""
    used = [program.inputs[index] for index in export_program(program).module_kept_var_idx]
    unused = {each.name: (each.shape, each.dtype) for each in program.inputs if each not in used}

    def function(arrays: dict[str, Array], form: Any) -> tuple[Array, ...]:
        return program.function(arrays | {name: jnp.zeros(*like) for name, like in unused.items()}, form)

    return replace(program, inputs=tuple(used), function=function)


def export_program(program: Program) -> jax_export.Exported:
    """Export for all platforms; an InputError names operations that the program cannot have."""
    _require("flatbuffers", "export")
    structs = [jax.ShapeDtypeStruct(each.shape, each.dtype) for each in program.inputs]
    try:
        exported = jax_export.export(jax.jit(lambda *arrays: program.call(*arrays)), platforms=PLATFORMS)(*structs)
        calls = {*re.findall(r"custom_call @([\w.]+)", exported.mlir_module())}
    except InputError:
        raise
    except (jax.errors.JAXTypeError, NotImplementedError, ValueError) as error:
        expected = f"code that JAX compiles for {' and '.join(PLATFORMS)}, without calls into Python"
        mend = "use jax.numpy instead of NumPy and Python"
        raise InputError(f"scorer: expected {expected}, got {_one_line(error)}; {mend}") from error
    if calls:
        got = f"{', '.join(sorted(calls))}; leave the operation out"
        raise InputError(f"scorer: expected a program without calls into libraries, got {got}")
    return exported


def to_onnx(program: Program, inputs: dict[str, np.ndarray], outputs: dict[str, np.ndarray]) -> tuple[bytes, float]:
    """The program as an ONNX model, and the largest difference of its outputs in ONNX Runtime from JAX's.

    An InputError if jax2onnx or ONNX Runtime lacks an operation, or if the difference is above the tolerance.
    """
    _require("jax2onnx", "onnx=True")
    structs = [jax.ShapeDtypeStruct(each.shape, each.dtype) for each in program.inputs]
    # jax2onnx traces functions of jax.numpy in its own way, which lacks options; a jaxpr has plain operations.
    function = jaxpr_as_fun(jax.make_jaxpr(partial(program.call, form="loop"))(*structs))
    names = {"model_name": "mfvpr", "input_names": [*inputs], "output_names": [*outputs]}
    try:
        with warnings.catch_warnings(action="ignore"):
            import jax2onnx
            import onnxruntime

            logging.getLogger("onnx_ir").setLevel(logging.ERROR)
            model = jax2onnx.to_onnx(function, structs, **names).SerializeToString()
            options = onnxruntime.SessionOptions()
            options.log_severity_level = 3  # errors alone
            session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
            values: Any = session.run([*outputs], inputs)
    except Exception as error:  # of any kind: NotImplementedError, RuntimeError, AssertionError
        expected = f"operations that jax2onnx converts, got {_one_line(error)}"
        raise InputError(f"onnx=True: expected {expected}; leave onnx out") from error
    difference = largest_difference(dict(zip(outputs, values, strict=True)), outputs)
    if not difference <= TOLERANCE:
        expected = f"outputs within {TOLERANCE:g} of JAX's"
        raise InputError(f"onnx=True: expected {expected}, got a difference of {difference:g}; leave onnx out")
    return model, difference


def _require_sizes(arrays: Mapping[str, np.ndarray]) -> None:
    """Raise an InputError for sizes of images that cannot be right, as width and height exchanged often cannot."""
    for side in "01":
        sizes, mask = arrays.get(f"image_size{side}"), arrays.get("mask", arrays.get(f"mask{side}"))
        if sizes is None or mask is None:
            continue
        sizes = np.broadcast_to(sizes[..., None, :], (*mask.shape, 2))[mask]
        points = arrays.get(f"points{side}", arrays.get(f"keypoints{side}"))
        points = np.zeros_like(sizes) if points is None else points[mask]
        margin = np.maximum(2.0, 0.01 * sizes)
        wrong = (~(sizes > 0) | (points < -margin) | (points > sizes + margin)).any(axis=1)
        if wrong.any():
            got = f"{sizes[wrong][0].tolist()} with a point {points[wrong][0].tolist()}"
            raise InputError(f"image_size{side}: expected (width, height) of images that contain all points, got {got}")


def check_inputs(program: Program) -> dict[str, np.ndarray]:
    """Inputs by name: candidates of one place, each less precise than the one before, the last without matches.

    The image has few keypoints, whose scores differ by more than rounding errors: those define the order.
    """
    lengths = num_candidates, num_keypoints = program.shapes.candidates, program.shapes.keypoints
    rng, size = np.random.default_rng(0), np.asarray(program.shapes.image_size, np.float32)
    spread = 0.01 * (1 + np.arange(num_candidates))[:, None, None]  # of image size and descriptors
    points = rng.uniform(size=(num_keypoints, 2)) * size
    moved = np.clip(points + 0.05 * size + spread * size * rng.normal(size=(*lengths, 2)), 0, size)
    descriptors = rng.normal(size=(num_keypoints, program.shapes.dimension or 1))
    descriptors /= np.linalg.norm(descriptors, axis=-1, keepdims=True)
    changed = descriptors + spread * rng.normal(size=(num_candidates, *descriptors.shape))
    mask = rng.uniform(size=lengths) < 0.9
    mask[-1] = num_candidates == 1
    width, height = size.astype(int)
    image = np.full((height, width, 3), 128)
    image[:32, :32] = rng.integers(0, 256, (8, 8, 3)).repeat(4, 0).repeat(4, 1)[:height, :width]
    values = {
        "image": image,
        "distance": rng.uniform(0, 1, lengths),
        "ratio": rng.uniform(0.5, 1, lengths),
        "confidence": np.linspace(0, 1, mask.size).reshape(lengths),
        "points0": points,
        "points1": moved,
        "descriptors0": descriptors,
        "descriptors1": changed / np.linalg.norm(changed, axis=-1, keepdims=True),
        "scores0": rng.uniform(0.1, 1, num_keypoints),
        "scores1": rng.uniform(0.1, 1, lengths),
        "mask": mask,
        "mask0": rng.uniform(size=num_keypoints) < 0.9,
        "mask1": mask,
    }
    for side in "01":
        values |= {f"keypoints{side}": values[f"points{side}"], f"image_size{side}": size}
        values |= {f"index{side}": np.arange(num_keypoints), f"count{side}": num_keypoints}
    arrays = {each: np.broadcast_to(values[each.name], each.shape) for each in program.inputs}
    return {each.name: np.array(array, each.dtype, order="C") for each, array in arrays.items()}


def largest_difference(arrays: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> float:
    """Largest difference of finite outputs, relative where they are above 1; infinite if NaN differ."""
    differences = [0.0]
    for name, values in expected.items():
        if not np.array_equal(np.isfinite(arrays[name]), finite := np.isfinite(values)):
            return np.inf
        difference = np.abs(np.subtract(arrays[name][finite], values[finite], dtype=float))
        difference /= np.maximum(np.abs(values[finite]), 1)
        differences.append(float(np.max(difference, initial=0.0)))
    return max(differences)


def _require(package: str, option: str) -> None:
    if find_spec(package) is None:
        raise InputError(f"{option}: expected the package {package}, got none; pip install 'mfvpr[export]'")


def _one_line(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
