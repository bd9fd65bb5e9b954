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
from jaxtyping import Float, Num

from mfvpr.features.extractor import Description, Scale, local_features
from mfvpr.features.network import NetworkExtractor, compile_network, in_batches
from mfvpr.networks import aliked, d2net
from mfvpr.networks.layers import Preprocessing
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import FLAG, NOT_NEGATIVE, SHAPED_SIZE, SIZE, setting, whole, word_of
from mfvpr.utils.numerics import device_bytes

_PIXELS_PER_SLOT = 40  # of ALIKED; photographs have a keypoint in 65 px at most
_SHARE = 0.3  # keypoint slots of D2-Net per position of its map; photographs take about a tenth
_SMALLEST_MAP = 2  # of D2-Net


def _without_empty_slots(result: Any, count_of: Callable[[Any], Array]) -> Any:
    """A batch's result without most of the slots that no image fills: an accelerator returns them slowly."""
    if device_bytes(()) is None:  # a CPU, where nothing moves
        return result
    return _first_slots(result, 256 * math.ceil(np.max(count_of(result)) / 256))  # few sizes: each is a program


@partial(jax.jit, static_argnums=1)
def _first_slots(result: Any, slots: int) -> Any:
    return jax.tree.map(lambda field: field[:, :slots] if field.ndim > 1 else field, result)


@dataclass(frozen=True)
class AlikedFeatures(NetworkExtractor):
    """ALIKED's keypoints and descriptors of 128 dimensions (64 of the smallest network), as the public code has them.

    Keypoints are in row order, or by falling score if an image has more than `max_keypoints`.

    If no score of an image is above the `threshold`, in (0, 1), keypoints above the image's mean score are taken. The
    default is that of Pivonka & Preucil (IEEE T-IV 2024).
    """

    has_vector = False
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

    def run_network(self, images: Num[np.ndarray, "images height width 3"]) -> list[Any]:
        usual = min(self._limit, math.ceil(math.prod(self.image_size) / _PIXELS_PER_SLOT))
        results = in_batches(self._program(usual), images, self.batch_size)
        counts = [int(detections.count) for detections, _ in results]
        crowded = [row for row, count in enumerate(counts) if count > usual]
        if crowded and usual < self._limit:
            capacity = min(self._limit, 1 << (max(counts) - 1).bit_length())  # powers of two: few programs
            again = in_batches(self._program(capacity), images[crowded], self.batch_size)
            for row, result in zip(crowded, again, strict=True):
                results[row] = result
        return results

    @cached_property
    def _program(self) -> Callable[[int], Callable[[Any], Any]]:
        """The compiled network for a number of keypoint slots."""

        def extract(model: aliked.Aliked, images: Array, *, capacity: int) -> Any:
            return model.extract(images.astype(jnp.float32) / 255, self.threshold, capacity)

        @cache
        def program(capacity: int) -> Callable[[Any], Any]:
            run = compile_network(self.model, partial(extract, capacity=capacity))
            return lambda images: _without_empty_slots(run(images), lambda result: result[0].count)

        return program

    def describe_result(self, result: tuple[Any, Float[np.ndarray, "slots dimensions"]]) -> Description:
        detections, descriptors = result
        keypoints, scores, mask = map(np.asarray, (detections.keypoints, detections.scores, detections.mask))
        features = local_features(keypoints[mask], descriptors[mask], self.image_size, scores[mask])
        return Description(local=(features,))


@dataclass(frozen=True)
class D2NetFeatures(NetworkExtractor):
    """D2-Net's keypoints and descriptors of 512 dimensions, as the public code extracts them and in its order.

    Scores are activations, which are not comparable between images. `multiscale` detects at half, full and double size,
    in this order, and gives features of one `Scale`. The published preprocessing is "caffe".

    Raises:
        InputError: images of this size are too small for the network.
    """

    has_vector = False
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

    def run_network(self, images: Num[np.ndarray, "images height width 3"]) -> list[Any]:
        results = in_batches(self._program(_SHARE), images, self.batch_size)
        crowded = [row for row, levels in enumerate(results) if any(level.count > len(level.mask) for level in levels)]
        for row, levels in zip(crowded, in_batches(self._program(1.0), images[crowded], self.batch_size), strict=True):
            results[row] = levels
        return results

    @cached_property
    def _program(self) -> Callable[[float], Callable[..., Any]]:
        """The compiled network for a share of positions that have a keypoint slot."""
        function = partial(d2net.extract, preprocessing=self.preprocessing, scales=self._network_scales)

        @cache
        def program(share: float) -> Callable[[Any], Any]:
            run = compile_network(self.model, partial(function, share=share))
            return lambda images: tuple(_without_empty_slots(level, lambda level: level.count) for level in run(images))

        return program

    def describe_result(self, result: tuple[d2net.Detections, ...]) -> Description:
        keypoints, descriptors, scores = (
            np.concatenate([getattr(level, name)[level.mask] for level in result])
            for name in ("keypoints", "descriptors", "scores")
        )
        strongest = np.sort(np.argsort(-scores, kind="stable")[: self.max_keypoints])
        features = local_features(keypoints[strongest], descriptors[strongest], self.image_size, scores[strongest])
        return Description(local=(features,))
