"""Run networks: weights are arguments of one compiled program; images have one size."""

from collections.abc import Callable
from functools import cached_property
from operator import attrgetter
from typing import Any

import jax
import numpy as np
from flax import nnx
from jaxtyping import Num

from mfvpr.features.extractor import Description
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import device_bytes, knows_own_context, repeat_last
from mfvpr.utils.runtime import ordered_map

TOGETHER = 8  # images on an accelerator: with more, cuDNN may choose a method that takes thirty times as long


class NetworkExtractor:
    """Base of the extractors with a network, which are dataclasses with these fields."""

    model: Any
    image_size: tuple[int, int]
    batch_size: int
    vector_size: Any = property(attrgetter("model.dimension"))  # of the global descriptor
    scales: Any = ()  # no local features

    def __call__(self, images: Num[np.ndarray, "images height width 3"]) -> list[Description]:
        """Descriptions of images, RGB, 0 .. 255, uint8 or float32; an `InputError` for images of another size."""
        (rows, columns), size = images.shape[1:3], self.image_size
        if (columns, rows) != tuple(size):
            name = type(self).__name__
            raise InputError(f"{name}: expected images of {size[0]} x {size[1]} px, got {columns} x {rows}")
        return [self._describe(result) for result in self._extract(images)]

    def _extract(self, images: Num[np.ndarray, "images height width 3"]) -> list[Any]:
        """Results of the network for each image."""
        return in_batches(self._program, images, self.batch_size)

    @cached_property
    def _program(self) -> Callable[..., Any]:
        """The compiled network."""
        return compile_network(self.model, self.compute)

    def compute(self, model: Any, images: jax.Array) -> Any:
        """Results for a batch; runs in a compiled program."""
        return model(model.preprocess(images))

    def _describe(self, result: Any) -> Description:
        return Description(result.reshape(-1))


def compile_network(model: nnx.Module, function: Callable[..., Any]) -> Callable[..., Any]:
    """`function(model, ...)` as one program per shape. The weights lie on the device once, and are not constants."""
    graph, state = nnx.split(model)
    program = jax.jit(lambda state, *inputs: function(nnx.merge(graph, state), *inputs))
    state = jax.device_put(state)
    return lambda *inputs: program(state, *inputs)


def require_network(name: str, model: Any, expected: type[nnx.Module]) -> None:
    """Raise an InputError unless the model is a network of the expected class."""
    if not isinstance(model, expected):
        mend = "`mfvpr.checkpoints.load_model` gives a network by its name"
        raise InputError(f"{name}: expected a {expected.__name__} as model, got {type(model).__name__}; {mend}")


def require_at_least(name: str, size: tuple[int, int], smallest: int) -> None:
    """Raise an InputError if images of this (width, height) are smaller than `smallest` px."""
    if min(size) < smallest:
        raise InputError(f"{name}: expected images of {smallest} x {smallest} px or more, got {size[0]} x {size[1]}")


def in_batches(
    program: Callable[[Any], Any], images: Num[np.ndarray, "images height width 3"], batch_size: int
) -> list[Any]:
    """Results of `program` for each image, NumPy.

    On a CPU `batch_size` has no effect: images run one by one, which keeps activations in the caches, and two at the
    same time, since a network leaves some of the cores idle. On other devices at most `TOGETHER` of them run at the
    same time, and the last batch is filled up, so that there is one program.

    Raises:
        InputError: floating-point images of 0 to 1, in which every network here sees black.
    """
    if images.dtype.kind == "f" and images.size and 0 < (largest := images.max()) <= 1:
        raise InputError(f"images: expected values from 0 to 255, the largest is {largest:.3g}; multiply by 255")
    on_host = device_bytes(()) is None
    size = 1 if on_host else min(batch_size, TOGETHER)

    def run(start: int) -> list[Any]:
        batch = images[start : start + size]
        outputs = jax.tree.map(np.asarray, program(repeat_last(batch, size)))
        return [jax.tree.map(lambda field, row=row: field[row], outputs) for row in range(len(batch))]

    starts = range(0, len(images), size)
    batches = [run(start) for start in starts[:1]]  # compiles
    together = on_host and len(starts) > 2 and knows_own_context()
    batches += ordered_map(run, starts[1:], workers=2) if together else [run(start) for start in starts[1:]]
    return [result for results in batches for result in results]
