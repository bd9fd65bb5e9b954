"""Programs as ONNX models, by jax2onnx, and their outputs by ONNX Runtime."""

import logging
import warnings
from collections.abc import Mapping
from functools import partial
from importlib.util import find_spec
from typing import Any

import jax
import numpy as np
from jax.extend.core import jaxpr_as_fun

from mfvpr.deployment.programs import Program
from mfvpr.deployment.stablehlo import shape_structs
from mfvpr.utils.errors import InputError

TOLERANCE = 1e-4  # relative to outputs above 1, else absolute; ONNX Runtime sums in another order
_ERRORS_ONLY = 3  # severity of ONNX Runtime's log


def is_installed() -> bool:
    """Whether ONNX models can be written."""
    return find_spec("jax2onnx") is not None


def convert(program: Program) -> bytes:
    """The program as an ONNX model with named inputs and outputs; an InputError if jax2onnx lacks an operation."""
    if not is_installed():
        raise InputError("onnx=True: expected the package jax2onnx, got none; pip install 'mfvpr[export]'")
    structs = shape_structs(program.inputs)
    # jax2onnx traces functions of jax.numpy in its own way, which lacks options; a jaxpr has plain operations.
    function = jaxpr_as_fun(jax.make_jaxpr(partial(program.call, form="loop"))(*structs))
    names = {
        "input_names": [each.name for each in program.inputs],
        "output_names": [each.name for each in program.outputs],
    }
    try:
        with warnings.catch_warnings(action="ignore"):
            from jax2onnx import to_onnx

            logging.getLogger("onnx_ir").setLevel(logging.ERROR)

            return to_onnx(function, structs, model_name="mfvpr", **names).SerializeToString()
    except Exception as error:  # of any kind: NotImplementedError, RuntimeError, AssertionError
        got = " ".join(f"{type(error).__name__} {error}".split())[:200]
        raise InputError(f"onnx=True: expected operations that jax2onnx converts, got {got}; leave onnx out") from error


def run(model: bytes, inputs: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Outputs of a model by name, by ONNX Runtime on the CPU."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = _ERRORS_ONLY
    try:
        session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
        outputs: Any = session.run(None, dict(inputs))
    except Exception as error:  # ONNX Runtime has no common class of errors
        got = " ".join(str(error).split())[:200]
        raise InputError(f"onnx=True: expected a model that ONNX Runtime runs, got {got}; leave onnx out") from error
    return dict(zip((each.name for each in session.get_outputs()), outputs, strict=True))
