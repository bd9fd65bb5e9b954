"""Extractors with a network: their base, which runs images in batches, global descriptors, and keypoints.

Keypoints are those of ALIKED (Zhao et al., IEEE TIM 2023), XFeat (Potje et al., CVPR 2024) and D2-Net (Dusmanu et al.,
CVPR 2019). A program has as many keypoint slots as images usually need; images with more run again in a larger program.
"""

import math
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, field
from functools import cache, cached_property, partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Num

from mfvpr.datasets.image_reading import Interpolation
from mfvpr.features.extractor import Description, Scale, local_features
from mfvpr.networks import aliked, d2net, efficientnet, xfeat
from mfvpr.networks.global_descriptors import IMAGE_SIZE
from mfvpr.networks.layers import Detections, Preprocessing, average_cells, of_unit_length
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import FLAG, NOT_NEGATIVE, SHAPED_SIZE, SIZE, Rule, check_fields, setting, whole, word_of
from mfvpr.utils.numerics import device_bytes, knows_own_context, repeat_last
from mfvpr.utils.runtime import ordered_map

TOGETHER = 8  # images on an accelerator: with more, cuDNN may choose a method that takes thirty times as long
_PIXELS_PER_SLOT = 40  # photographs have a keypoint of XFeat in 44 px at most, one of ALIKED in 65 px
_SHARE = 0.3  # keypoint slots of D2-Net per position of its map; photographs take about a tenth
_SMALLEST_MAP = 2  # of D2-Net


@dataclass(frozen=True)
class NetworkExtractor:
    """Base of the extractors with a network: dataclasses whose further fields are further settings.

    By default it gives the global descriptors of `model.dimension` numbers that the network returns for preprocessed
    images. An extractor of another kind defines `compute`, `describe_result`, `vector_size` and `scales`.

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
        return self.model.dimension if self.has_vector else 0

    @property
    def scales(self) -> tuple[Scale, ...]:
        return ()

    def __call__(self, images: Num[np.ndarray, "images height width 3"]) -> list[Description]:
        """Descriptions of images, RGB, 0 .. 255, uint8 or float32; an `InputError` for images of another size."""
        width, height = self.image_size
        if images.shape[1:3] != (height, width):
            got = f"{images.shape[2]} x {images.shape[1]}"
            raise InputError(f"{type(self).__name__}: expected images of {width} x {height} px, got {got}")
        return [self.describe_result(result) for result in self.run_network(images)]

    def run_network(self, images: Num[np.ndarray, "images height width 3"]) -> list[Any]:
        return in_batches(self._program, images, self.batch_size)

    @cached_property
    def _program(self) -> Callable[..., Any]:
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
        "pil_bicubic", word_of(Interpolation), "pil_bicubic: the authors' demo; pil_bilinear: their training"
    )


@dataclass(frozen=True)
class GlobalDescriptor(NetworkExtractor):
    """Global descriptors of a network that takes images of many sizes, as the public code extracts them.

    The model has `dimension`, `has_components` (whether a descriptor consists of principal components, the largest
    first), `require(size)` (an InputError for sizes that it cannot take) and `preprocess(images)`; called with
    preprocessed images, it returns descriptors of unit length. 640 x 480 px is Patch-NetVLAD's size. The principal
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


@dataclass(frozen=True)
class EfficientNetDescriptor(NetworkExtractor):
    """The map of a block of EfficientNet-Lite0, averaged to a square grid and scaled to unit length, float16.

    Middle blocks describe places better than the last ones, see features/README.md.
    """

    image_size: tuple[int, int] = setting((160, 160), SIZE, "width, height")
    block: int = setting(10, whole(0, len(efficientnet.CHANNELS) - 1), "whose map it is")
    grid: int = setting(7, whole(1, 64), "cells per side that the map is averaged to")

    @property
    def vector_size(self) -> int:
        return self.grid**2 * efficientnet.CHANNELS[self.block]

    def compute(self, model: efficientnet.EfficientNetLite0, images: jax.Array) -> jax.Array:
        maps = model(model.preprocess(images), self.block)
        for axis in (1, 2):
            maps = average_cells(maps, self.grid, axis)
        return of_unit_length(maps.reshape(len(maps), -1)).astype(jnp.float16)


class KeypointNetwork(NetworkExtractor):  # no dataclass, so that `max_keypoints` is the last field
    """Base of the extractors of keypoints; the result of a network is a tuple of `Detections`, as of several scales."""

    has_vector = False
    max_keypoints: int | None = None

    def run_network(self, images: Num[np.ndarray, "images height width 3"]) -> list[Any]:
        usual = self.slots()
        results = in_batches(self._program(usual), images, self.batch_size)
        counts = [[(int(level.count), len(level.mask)) for level in result] for result in results]
        crowded = [row for row, levels in enumerate(counts) if any(count > slots for count, slots in levels)]
        more = self.slots(max((count for levels in counts for count, _ in levels), default=0))
        if crowded and more > usual:
            again = in_batches(self._program(more), images[crowded], self.batch_size)
            for row, result in zip(crowded, again, strict=True):
                results[row] = result
        return results

    @cached_property
    def _program(self) -> Callable[[float], Callable[[Any], Any]]:
        """The compiled network for a number of slots."""

        @cache
        def program(slots: float) -> Callable[[Any], Any]:
            run = compile_network(self.model, partial(self.compute, slots=slots))  # pyright: ignore[reportCallIssue]
            return run if device_bytes(()) is None else lambda images: self._without_empty_slots(run(images))

        return program

    def _without_empty_slots(self, result: Any) -> Any:
        """A batch's result without most of the slots that no image fills: an accelerator returns them slowly."""
        most = max(int(np.max(level.count)) for level in result)
        return _first_slots(result, 256 * math.ceil(most / 256))  # few sizes: each is a program

    @property
    def _limit(self) -> int:
        pixels = math.prod(self.image_size)
        return pixels if self.max_keypoints is None else min(self.max_keypoints, pixels)

    def slots(self, count: int | None = None) -> float:
        """Slots for what images usually have, or for images of up to `count` keypoints."""
        usual = math.ceil(math.prod(self.image_size) / _PIXELS_PER_SLOT)
        powers_of_two = usual if count is None else 1 << (count - 1).bit_length()  # few programs
        return min(self._limit, powers_of_two)

    def describe_result(self, result: tuple[Detections, ...]) -> Description:
        keypoints, descriptors, scores = (
            np.concatenate([getattr(level, name)[level.mask] for level in result])
            for name in ("keypoints", "descriptors", "scores")
        )
        strongest = np.sort(np.argsort(-scores, kind="stable")[: self.max_keypoints])
        features = local_features(keypoints[strongest], descriptors[strongest], self.image_size, scores[strongest])
        return Description(local=(features,))


@partial(jax.jit, static_argnums=1)
def _first_slots(result: Any, slots: int) -> Any:
    return jax.tree.map(lambda field: field[:, :slots] if field.ndim > 1 else field, result)


@dataclass(frozen=True)
class AlikedFeatures(KeypointNetwork):
    """ALIKED's keypoints and descriptors of 128 dimensions (64 of the smallest network), as the public code has them.

    Keypoints are in row order, or by falling score if an image has more than `max_keypoints`. If no score of an image
    is above the `threshold`, in (0, 1), keypoints above its mean score are taken. The default is that of Pivonka &
    Preucil (IEEE T-IV 2024).
    """

    side_multiple = aliked.STRIDE  # px: other images are padded, which costs recall
    image_size: tuple[int, int] = setting((320, 320), SIZE, SHAPED_SIZE)
    threshold: float = setting(0.1, NOT_NEGATIVE, "of the detection score: the paper's; its authors' default is 0.2")
    max_keypoints: int | None = setting(5000, whole(1, 20_000) | None, "the highest scores are kept; null = all")

    @property
    def scales(self) -> tuple[Scale, ...]:
        """One scale. Images have one keypoint in 125 px, or `max_keypoints`; aliked-n16rot and -n32 half as many."""
        return (Scale(self.model.dimension, min(self._limit, math.prod(self.image_size) // 125)),)

    def compute(self, model: aliked.Aliked, images: jax.Array, *, slots: int) -> Any:
        return (model.extract(images.astype(jnp.float32) / 255, self.threshold, slots),)


@dataclass(frozen=True)
class XFeatFeatures(KeypointNetwork):
    """XFeat's sparse keypoints and descriptors of 64 dimensions, as `match_xfeat` of the public code extracts them.

    Keypoints are in the order of falling score: the probability of a keypoint, which is above the `threshold`, times
    the reliability of its descriptor. The public code keeps 4096.

    Raises:
        InputError: a side of `image_size` is no multiple of 32 px.
    """

    side_multiple = xfeat.STRIDE  # px
    image_size: tuple[int, int] = setting((320, 320), SIZE, f"{SHAPED_SIZE}; multiples of {xfeat.STRIDE}")
    threshold: float = setting(0.05, NOT_NEGATIVE, "of the probability of a keypoint")
    max_keypoints: int | None = setting(1000, whole(1, 20_000) | None, "the highest scores are kept; null = all")

    def __post_init__(self) -> None:
        super().__post_init__()
        if any(side % xfeat.STRIDE for side in self.image_size):
            mend = f"for example {[max(1, round(side / xfeat.STRIDE)) * xfeat.STRIDE for side in self.image_size]}"
            got = list(self.image_size)
            raise InputError(f"image_size={got}: expected multiples of {xfeat.STRIDE} px for XFeat, {mend}")

    @property
    def scales(self) -> tuple[Scale, ...]:
        """One scale. Images have one keypoint in 60 px, or `max_keypoints`."""
        return (Scale(self.model.dimension, min(self._limit, math.prod(self.image_size) // 60)),)

    def compute(self, model: xfeat.XFeat, images: jax.Array, *, slots: int) -> Any:
        return (model.extract(images.astype(jnp.float32) / 255, self.threshold, slots),)


@dataclass(frozen=True)
class D2NetFeatures(KeypointNetwork):
    """D2-Net's keypoints and descriptors of 512 dimensions, as the public code extracts them and in its order.

    Scores are activations, which are not comparable between images. `multiscale` detects at half, full and double size,
    in this order, and gives features of one `Scale`. The published preprocessing is "caffe".

    Raises:
        InputError: images of this size are too small for the network.
    """

    image_size: tuple[int, int] = setting((336, 336), SIZE, SHAPED_SIZE)
    preprocessing: Preprocessing = setting("caffe", word_of(Preprocessing))
    multiscale: bool = setting(False, FLAG)
    max_keypoints: int | None = setting(
        None, whole(1, 20_000) | None, "the highest scores are kept; null = all, as in the paper"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        smallest = round((_SMALLEST_MAP + 1) * d2net.STRIDE / min(self._network_scales))
        if min(self.image_size) < smallest:
            name = "D2-Net, multi-scale" if self.multiscale else "D2-Net"
            got = f"{self.image_size[0]} x {self.image_size[1]}"
            raise InputError(f"{name}: expected images of {smallest} x {smallest} px or more, got {got}")

    @property
    def scales(self) -> tuple[Scale, ...]:
        """One scale: 740 features at 336 x 336 px, in proportion to the map's size; 1.4 times as many multi-scale."""
        width, height = self.image_size
        share = d2net.map_size(width) * d2net.map_size(height) / d2net.map_size(336) ** 2
        usual = round(740 * share * (1.4 if self.multiscale else 1))
        return (Scale(512, usual if self.max_keypoints is None else min(usual, self.max_keypoints)),)

    @property
    def _network_scales(self) -> tuple[float, ...]:
        return d2net.SCALES if self.multiscale else (1.0,)

    def slots(self, count: int | None = None) -> float:
        """Share of the map's positions that have a slot."""
        return _SHARE if count is None else 1.0

    def compute(self, model: d2net.D2Net, images: jax.Array, *, slots: float) -> Any:
        options = {"preprocessing": self.preprocessing, "scales": self._network_scales}
        return d2net.extract(model, images, **options, share=slots)


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
    same time, since a network leaves cores idle. On other devices at most `TOGETHER` run at the same time, and the last
    batch is filled up, so that there is one program. Images of 0 to 1, which every network sees as black, raise an
    `InputError`.
    """
    if images.dtype.kind == "f" and images.size and 0 < (largest := images.max()) <= 1:
        raise InputError(f"images: expected values from 0 to 255, got at most {largest:.3g}; multiply by 255")
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
