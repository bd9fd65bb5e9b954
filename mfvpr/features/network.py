"""Extractors with a network: their base, which runs images in batches, and networks of global descriptors."""

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, field
from functools import cached_property
from typing import Any, ClassVar

import jax
import numpy as np
from flax import nnx
from jaxtyping import Num

from mfvpr.datasets.image_reading import Interpolation
from mfvpr.features.extractor import Description, Scale
from mfvpr.networks.global_descriptors import IMAGE_SIZE
from mfvpr.networks.layers import of_unit_length
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import SIZE, Rule, check_fields, setting, whole, word_of
from mfvpr.utils.numerics import device_bytes, knows_own_context, repeat_last
from mfvpr.utils.runtime import ordered_map

TOGETHER = 8  # images on an accelerator: with more, cuDNN may choose a method that takes thirty times as long


@dataclass(frozen=True)
class NetworkExtractor:
    """Base of the extractors with a network: dataclasses whose further fields are further settings.

    By default it is an extractor of the global descriptors of `model.dimension` numbers that the network returns for
    preprocessed images. An extractor of another kind defines `compute`, `describe_result`, `vector_size` and `scales`.

    Raises:
        InputError: another network than `network`, or a value that is out of its range.
    """

    network: ClassVar[type] = object
    has_vector: ClassVar[bool] = True  # False = no global descriptor

    model: Any = field(repr=False)
    image_size: tuple[int, int] = setting((336, 336), SIZE, "width, height")
    _: KW_ONLY
    interpolation: Interpolation = setting("pil_bilinear", word_of(Interpolation))
    batch_size: int = setting(8, whole(1, 256), recipe=False)

    def __post_init__(self) -> None:
        check_fields(self)
        if not isinstance(self.model, self.network):
            expected, got = self.network.__name__, type(self.model).__name__
            mend = "`mfvpr.checkpoints.load_model` gives a network by its name"
            raise InputError(f"{type(self).__name__}: expected a {expected} as model, got {got}; {mend}")

    @property
    def vector_size(self) -> int:
        """Length of the global descriptor."""
        return self.model.dimension if self.has_vector else 0

    @property
    def scales(self) -> tuple[Scale, ...]:
        """No local features."""
        return ()

    def __call__(self, images: Num[np.ndarray, "images height width 3"]) -> list[Description]:
        """Descriptions of images, RGB, 0 .. 255, uint8 or float32; an `InputError` for images of another size."""
        (rows, columns), size = images.shape[1:3], self.image_size
        if (columns, rows) != tuple(size):
            name = type(self).__name__
            raise InputError(f"{name}: expected images of {size[0]} x {size[1]} px, got {columns} x {rows}")
        return [self.describe_result(result) for result in self.run_network(images)]

    def run_network(self, images: Num[np.ndarray, "images height width 3"]) -> list[Any]:
        """Results of the network for each image."""
        return in_batches(self._program, images, self.batch_size)

    @cached_property
    def _program(self) -> Callable[..., Any]:
        """The compiled network."""
        return compile_network(self.model, self.compute)

    def compute(self, model: Any, images: jax.Array) -> Any:
        """Results for a batch; runs in a compiled program."""
        return model(model.preprocess(images))

    def describe_result(self, result: Any) -> Description:
        return Description(result.reshape(-1))


def only_size(width: int, height: int) -> Any:
    """The setting of an `image_size` that cannot be chosen."""
    is_size = lambda value: isinstance(value, list | tuple) and tuple(value) == (width, height)  # noqa: E731
    rule = Rule(is_size, f"[{width}, {height}], the only size that its weights are for")
    return setting((width, height), rule, "width, height: the only one that its weights are for")


@dataclass(frozen=True)
class MixVprDescriptor(NetworkExtractor):
    """MixVPR's global descriptors, as the public code extracts them: 4096, 512 or 128 numbers with published weights.

    The authors' demonstration and OpenVPRLab interpolate by "pil_bicubic", the authors' training by "pil_bilinear",
    VPR-methods-evaluation by "torch_bilinear".
    """

    image_size: tuple[int, int] = only_size(*IMAGE_SIZE)
    interpolation: Interpolation = setting(
        "pil_bicubic",
        word_of(Interpolation),
        "the authors' demo, OpenVPRLab; pil_bilinear (training), torch_bilinear (VPR-methods-evaluation)",
    )


@dataclass(frozen=True)
class GlobalDescriptor(NetworkExtractor):
    """Global descriptors of a network that takes images of many sizes, as the public code extracts them.

    The model has `dimension`, `has_components` (whether a descriptor consists of principal components, the largest
    first), `require(size)` (an InputError for sizes that it cannot take) and `preprocess(images)`; called with
    preprocessed images, it returns descriptors of unit length. 640 x 480 px is Patch-NetVLAD's size. Principal
    `components` that are kept are scaled to unit length again.

    Raises:
        InputError: the network cannot take images of this size, or has fewer principal components.
    """

    image_size: tuple[int, int] = setting((640, 480), SIZE, "width, height")
    components: int | None = setting(
        None, whole(1, 4096) | None, "how many of the first of 4096, 512 or 128 are kept; null = all"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        self.model.require(self.image_size)
        most = self.model.dimension if self.model.has_components else 0
        if self.components is not None and self.components > most:
            expected = f"null, or at most {most}" if most else "null, as these weights have no principal components"
            raise InputError(f"components={self.components}: expected {expected}")

    @property
    def vector_size(self) -> int:
        return self.components or self.model.dimension

    def compute(self, model: Any, images: jax.Array) -> jax.Array:
        descriptors = model(model.preprocess(images))
        return descriptors if self.components is None else of_unit_length(descriptors[:, : self.components])


def compile_network(model: nnx.Module, function: Callable[..., Any]) -> Callable[..., Any]:
    """`function(model, ...)` as one program per shape. The weights lie on the device once, and are not constants."""
    graph, state = nnx.split(model)
    program = jax.jit(lambda state, *inputs: function(nnx.merge(graph, state), *inputs))
    state = jax.device_put(state)
    return lambda *inputs: program(state, *inputs)


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
