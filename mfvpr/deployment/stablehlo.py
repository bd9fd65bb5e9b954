"""Programs as StableHLO, by `jax.export`: for CPU and CUDA, without calls into Python or libraries."""

import re
from collections.abc import Callable
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
_CALLBACK = re.compile(r"\b(\w+_callback|debug_print)\[")
_CUSTOM_CALL = re.compile(r"custom_call @([\w.]+)")


def without_unused_inputs(program: Program) -> Program:
    """The program without inputs that have no effect on its outputs."""
    exported = _export(program.call, program.inputs)
    used = [program.inputs[index] for index in exported.module_kept_var_idx]
    names = {each.name for each in used}
    unused = {each.name: (each.shape, each.dtype) for each in program.inputs if each.name not in names}

    def function(arrays: dict[str, Array], form: Any) -> tuple[Array, ...]:
        return program.function(arrays | {name: jnp.zeros(*like) for name, like in unused.items()}, form)

    return replace(program, inputs=tuple(used), function=function)


def serialize(program: Program) -> bytes:
    """The program as bytes that `deserialize` reads."""
    _require_flatbuffers()
    return bytes(_export(program.call, program.inputs).serialize())


def deserialize(content: bytes, where: str) -> jax_export.Exported:
    """The program of `serialize`; an InputError, which begins with `where`, if JAX cannot read it."""
    _require_flatbuffers()
    try:
        exported = jax_export.deserialize(bytearray(content))
        operations = _CUSTOM_CALL.findall(exported.mlir_module())
    except Exception as error:  # of flatbuffers, of MLIR, or of JAX's own checks
        got = _first_line(error)
        raise InputError(f"{where}: expected a program that JAX {jax.__version__} reads, got {got}") from error
    _require_none(operations, where)
    return exported


def shape_structs(tensors: tuple[Tensor, ...]) -> list[jax.ShapeDtypeStruct]:
    return [jax.ShapeDtypeStruct(each.shape, each.dtype) for each in tensors]


def _export(function: Callable[..., Any], inputs: tuple[Tensor, ...]) -> jax_export.Exported:
    """Export for all platforms; an InputError names operations that the program cannot have."""
    structs, program = shape_structs(inputs), jax.jit(lambda *arrays: function(*arrays))
    try:
        traced = program.trace(*structs)
        _require_none(_CALLBACK.findall(str(traced.jaxpr)), "scorer")
        text = traced.lower(lowering_platforms=PLATFORMS).as_text()
    except (jax.errors.JAXTypeError, NotImplementedError) as error:
        expected = f"code that JAX compiles for {' and '.join(PLATFORMS)}"
        mend = "use jax.numpy instead of NumPy and Python"
        raise InputError(f"scorer: expected {expected}, got {_first_line(error)}; {mend}") from error
    _require_none(_CUSTOM_CALL.findall(text), "scorer")
    return jax_export.export(program, platforms=PLATFORMS)(*structs)


def _require_none(operations: list[str], where: str) -> None:
    if operations:
        got = ", ".join(sorted({*operations}))
        raise InputError(
            f"{where}: expected a program without calls into Python or libraries, got {got}; leave the operation out"
        )


def _require_flatbuffers() -> None:
    if find_spec("flatbuffers") is None:
        raise InputError("export: expected the package flatbuffers, got none; pip install 'mfvpr[export]'")


def _first_line(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).partition(chr(10))[0].split())[:200]}"
