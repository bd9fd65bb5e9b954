"""Programs as StableHLO, by `jax.export`: for CPU and CUDA, without calls into Python or libraries."""

import re
from collections.abc import Sequence
from dataclasses import replace
from importlib.util import find_spec
from typing import Any

import jax
import jax.numpy as jnp
from jax import export as jax_export

from mfvpr.core.types import Array
from mfvpr.deployment.programs import Program, Tensor
from mfvpr.utils.errors import InputError

PLATFORMS = ("cpu", "cuda")


def without_unused_inputs(program: Program) -> Program:
    """The program without inputs that have no effect on its outputs."""
    used = [program.inputs[index] for index in export_program(program).module_kept_var_idx]
    unused = {each.name: (each.shape, each.dtype) for each in program.inputs if each not in used}

    def function(arrays: dict[str, Array], form: Any) -> tuple[Array, ...]:
        return program.function(arrays | {name: jnp.zeros(*like) for name, like in unused.items()}, form)

    return replace(program, inputs=tuple(used), function=function)


def export_program(program: Program) -> jax_export.Exported:
    """Export for all platforms; an InputError names operations that the program cannot have."""
    function = jax.jit(lambda *arrays: program.call(*arrays))
    try:
        exported = jax_export.export(function, platforms=PLATFORMS)(*shape_structs(program.inputs))
        calls = {*re.findall(r"custom_call @([\w.]+)", exported.mlir_module())}
    except InputError:
        raise
    except (jax.errors.JAXTypeError, NotImplementedError, ValueError) as error:
        expected = f"code that JAX compiles for {' and '.join(PLATFORMS)}, without calls into Python"
        mend = "use jax.numpy instead of NumPy and Python"
        raise InputError(f"scorer: expected {expected}, got {_first_line(error)}; {mend}") from error
    if calls:
        got = f"{', '.join(sorted(calls))}; leave the operation out"
        raise InputError(f"scorer: expected a program without calls into libraries, got {got}")
    return exported


def serialize(program: Program) -> bytes:
    """The program as bytes that `deserialize` reads."""
    _require_flatbuffers()
    return bytes(export_program(program).serialize())


def deserialize(content: bytes, where: str) -> jax_export.Exported:
    """The program of `serialize`; an InputError, which begins with `where`, if JAX cannot read it."""
    _require_flatbuffers()
    try:
        return jax_export.deserialize(bytearray(content))
    except Exception as error:  # of flatbuffers, of MLIR, or of JAX's own checks
        got = _first_line(error)
        raise InputError(f"{where}: expected a program that JAX {jax.__version__} reads, got {got}") from error


def shape_structs(tensors: Sequence[Tensor]) -> list[jax.ShapeDtypeStruct]:
    """Shapes and types of arrays, for JAX."""
    return [jax.ShapeDtypeStruct(each.shape, each.dtype) for each in tensors]


def _require_flatbuffers() -> None:
    if find_spec("flatbuffers") is None:
        raise InputError("export: expected the package flatbuffers, got none; pip install 'mfvpr[export]'")


def _first_line(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).partition(chr(10))[0].split())[:200]}"
