"""Programs as StableHLO, by `jax.export`, and as ONNX models, by jax2onnx: without calls into Python or libraries."""

import logging
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import export as jax_export
from jax.extend.core import jaxpr_as_fun

from mfvpr.core.types import Array
from mfvpr.deployment.programs import Program, Tensor
from mfvpr.utils.errors import InputError

PLATFORMS = ("cpu", "cuda")
TOLERANCE = 1e-4  # of ONNX Runtime, which sums in another order: relative to outputs above 1, else absolute
_ERRORS_ONLY = 3  # severity of ONNX Runtime's log


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
    function = jax.jit(lambda *arrays: program.call(*arrays))
    try:
        exported = jax_export.export(function, platforms=PLATFORMS)(*_shape_structs(program.inputs))
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


def deserialize(content: bytes, where: str) -> jax_export.Exported:
    """The serialized program; an InputError, which begins with `where`, if JAX cannot read it."""
    _require("flatbuffers", "export")
    try:
        return jax_export.deserialize(bytearray(content))
    except Exception as error:  # of flatbuffers, of MLIR, or of JAX's own checks
        expected = f"a program that JAX {jax.__version__} reads"
        raise InputError(f"{where}: expected {expected}, got {_one_line(error)}") from error


def has_jax2onnx() -> bool:
    """Whether ONNX models can be written."""
    return find_spec("jax2onnx") is not None


def to_onnx(program: Program) -> bytes:
    """The program as an ONNX model with named inputs and outputs; an InputError if jax2onnx lacks an operation."""
    _require("jax2onnx", "onnx=True")
    structs = _shape_structs(program.inputs)
    # jax2onnx traces functions of jax.numpy in its own way, which lacks options; a jaxpr has plain operations.
    function = jaxpr_as_fun(jax.make_jaxpr(partial(program.call, form="loop"))(*structs))
    inputs, outputs = ([each.name for each in side] for side in (program.inputs, program.outputs))
    try:
        with warnings.catch_warnings(action="ignore"):
            import jax2onnx

            logging.getLogger("onnx_ir").setLevel(logging.ERROR)
            names = {"model_name": "mfvpr", "input_names": inputs, "output_names": outputs}
            return jax2onnx.to_onnx(function, structs, **names).SerializeToString()
    except Exception as error:  # of any kind: NotImplementedError, RuntimeError, AssertionError
        expected = f"operations that jax2onnx converts, got {_one_line(error)}"
        raise InputError(f"onnx=True: expected {expected}; leave onnx out") from error


def run_onnx(model: bytes, inputs: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Outputs of a model by name, by ONNX Runtime on the CPU."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = _ERRORS_ONLY
    try:
        session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
        outputs: Any = session.run(None, dict(inputs))
    except Exception as error:  # ONNX Runtime has no common class of errors
        expected = f"a model that ONNX Runtime runs, got {_one_line(error)}"
        raise InputError(f"onnx=True: expected {expected}; leave onnx out") from error
    return dict(zip((each.name for each in session.get_outputs()), outputs, strict=True))


def _shape_structs(tensors: Sequence[Tensor]) -> list[jax.ShapeDtypeStruct]:
    return [jax.ShapeDtypeStruct(each.shape, each.dtype) for each in tensors]


def _require(package: str, what: str) -> None:
    if find_spec(package) is None:
        raise InputError(f"{what}: expected the package {package}, got none; pip install 'mfvpr[export]'")


def _one_line(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
