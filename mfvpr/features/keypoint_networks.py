"""Keypoints and descriptors of networks: ALIKED (Zhao et al., IEEE TIM 2023), D2-Net (Dusmanu et al., CVPR 2019).

A program has as many keypoint slots as images usually need; images with more keypoints run again in a larger program.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Num

from mfvpr.features.extractor import Description, Scale, local_features
from mfvpr.features.network import NetworkExtractor, compile_network, in_batches
from mfvpr.networks import aliked, d2net
from mfvpr.networks.layers import Detections, Preprocessing
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import FLAG, NOT_NEGATIVE, SHAPED_SIZE, SIZE, setting, whole, word_of
from mfvpr.utils.numerics import device_bytes

_PIXELS_PER_SLOT = 40  # of ALIKED; photographs have a keypoint in 65 px at most
_SHARE = 0.3  # keypoint slots of D2-Net per position of its map; photographs take about a tenth
_SMALLEST_MAP = 2  # of D2-Net


@dataclass(frozen=True)
class KeypointNetwork(NetworkExtractor):
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

    def slots(self, count: int | None = None) -> float:
        """Slots for what images usually have, or for images of up to `count` keypoints."""
        raise NotImplementedError

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

    Keypoints are in row order, or by falling score if an image has more than `max_keypoints`.

    If no score of an image is above the `threshold`, in (0, 1), keypoints above the image's mean score are taken. The
    default is that of Pivonka & Preucil (IEEE T-IV 2024).
    """

    side_multiple = aliked.STRIDE  # px: other images are padded, which costs recall
    image_size: tuple[int, int] = setting((320, 320), SIZE, SHAPED_SIZE)
    threshold: float = setting(0.1, NOT_NEGATIVE, "of the detection score: the paper's; its authors' default is 0.2")
    max_keypoints: int | None = setting(5000, whole(1, 20_000) | None, "the highest scores are kept; null = all")

    @property
    def scales(self) -> tuple[Scale, ...]:
        """One scale. Images have one keypoint in 125 px, or `max_keypoints`; aliked-n16rot and -n32 half as many."""
        return (Scale(self.model.dimension, min(self._limit, math.prod(self.image_size) // 125)),)

    @property
    def _limit(self) -> int:
        pixels = math.prod(self.image_size)
        return pixels if self.max_keypoints is None else min(self.max_keypoints, pixels)

    def slots(self, count: int | None = None) -> int:
        usual = math.ceil(math.prod(self.image_size) / _PIXELS_PER_SLOT)
        powers_of_two = usual if count is None else 1 << (count - 1).bit_length()  # few programs
        return min(self._limit, powers_of_two)

    def compute(self, model: aliked.Aliked, images: Array, *, slots: int) -> Any:
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

    def compute(self, model: d2net.D2Net, images: Array, *, slots: float) -> Any:
        options = {"preprocessing": self.preprocessing, "scales": self._network_scales}
        return d2net.extract(model, images, **options, share=slots)
