"""How a network is put to work: weights are arguments of one compiled program, batches have a fixed size."""

from collections.abc import Callable
from functools import cache
from typing import Any

import jax
import numpy as np
from flax import nnx

# XLA's own convolutions instead of YNNPACK's, which take 1.15 times as long where channels are many (AVX-512).
_WIDE_ON_CPU = {"xla_cpu_experimental_ynn_fusion_type": ""}


def compiled(model: nnx.Module, function: Callable[..., Any], *, wide: bool = False) -> Callable[..., Any]:
    """`function(model, ...)` as one program per shape. The weights lie on the device once, and are not constants.

    Args:
        model: the network.
        function: what is done with it.
        wide: nearly all of its time goes into convolutions of 256 channels and more.
    """
    options = _wide_options() if wide else {}
    graph, state = nnx.split(model)
    program = jax.jit(lambda state, *inputs: function(nnx.merge(graph, state), *inputs), compiler_options=options)
    state = jax.device_put(state)
    return lambda *inputs: program(state, *inputs)


@cache
def _wide_options() -> dict[str, str]:
    """Of the compiler; none where it does not know them, for experimental ones come and go."""
    if jax.default_backend() != "cpu":
        return {}
    try:
        jax.jit(lambda: 0, compiler_options=_WIDE_ON_CPU).lower().compile()
    except jax.errors.JaxRuntimeError:
        return {}
    return _WIDE_ON_CPU


def in_batches(program: Callable[[Any], Any], images: np.ndarray, batch_size: int) -> list[Any]:
    """What `program` gives for each image of `[B, H, W, 3]`, NumPy.

    A CPU takes them one by one, which keeps activations in its caches (a batch of 8 is no faster there); elsewhere
    the last batch is filled up, so that there is one program.
    """
    size = 1 if jax.default_backend() == "cpu" else batch_size
    found = []
    for start in range(0, len(images), size):
        batch = images[start : start + size]
        missing = size - len(batch)
        padded = np.concatenate([batch, np.repeat(batch[-1:], missing, axis=0)]) if missing else batch
        results = jax.tree.map(np.asarray, program(padded))
        found += [jax.tree.map(lambda field, row=row: field[row], results) for row in range(len(batch))]
    return found
