"""SSM-VPR's descriptors (Camara & Preucil, RAS 2020): windows for retrieval, cells of a grid for matching."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Literal

import jax
import numpy as np
from jaxtyping import Float

from mfvpr.core.types import Array
from mfvpr.features.extractor import Description, Scale, local_features
from mfvpr.features.network import NetworkExtractor, compile_network, only_size
from mfvpr.features.whitening import Whitening, WindowFitting, Windows, kernels, learned_whitening
from mfvpr.networks.backbones import STAGE1_STRIDE, STAGE2_STRIDE, SsmVgg
from mfvpr.networks.layers import PRECISION, Preprocessing, of_unit_length
from mfvpr.utils.fields import SIZE, setting, whole, word_of

_CHANNELS = 512
_OF_WINDOWS, _OF_CELLS = WindowFitting(125), WindowFitting(100, dtype="float64")  # as published
_MIDDLE = (STAGE2_STRIDE - 1) / 2  # px from a position's first pixel to its middle


def whiten_windows(
    maps: Float[Array, "images rows columns channels"],
    kernel: Float[Array, "size size channels dimensions"],
    offset: Float[Array, " dimensions"],
    *,
    stride: int,
) -> Float[Array, "images windows dimensions"]:
    """Descriptors of all windows of maps."""
    layout = {"dimension_numbers": ("NHWC", "HWIO", "NHWC"), "precision": PRECISION}
    descriptors = jax.lax.conv_general_dilated(maps, kernel, (stride, stride), "VALID", **layout)
    return descriptors.reshape(len(maps), -1, descriptors.shape[-1]) - offset[None, None]


@dataclass(frozen=True)
class SsmMaps(NetworkExtractor):
    """Feature maps of `stage` 1 or 2 as global descriptors, of unit length at every position."""

    preprocessing: Preprocessing = "torch"
    stage: Literal[1, 2] = 1

    @property
    def shape(self) -> tuple[int, int, int]:
        """(rows, columns, channels) of a map."""
        stride = {1: STAGE1_STRIDE, 2: STAGE2_STRIDE}[self.stage]
        columns, rows = (-(-side // stride) for side in self.image_size)
        return rows, columns, _CHANNELS

    @property
    def vector_size(self) -> int:
        return math.prod(self.shape)

    def compute(self, model: SsmVgg, images: Array) -> Float[Array, "images rows columns 512"]:
        return of_unit_length(model(model.preprocess(images, self.preprocessing), self.stage))


@dataclass(frozen=True)
class _WhitenedWindows(NetworkExtractor):
    """Base of the extractors of whitened windows; `whitening` has settings to learn it from the database, or is it."""

    stage: ClassVar[Literal[1, 2]]

    preprocessing: Preprocessing = setting(
        "torch", word_of(Preprocessing), "torch, as published, or caffe, which the weights are for"
    )
    whitening: WindowFitting | Whitening = _OF_WINDOWS
    windows: ClassVar[Any]  # the Windows of a map, a property

    @property
    def maps(self) -> SsmMaps:
        """Extractor of the stage's maps."""
        names = ("interpolation", "batch_size", "preprocessing", "stage")
        return SsmMaps(self.model, self.image_size, **{name: getattr(self, name) for name in names})

    @cached_property
    def _program(self) -> Callable[..., Any]:
        """Images -> whitened windows `[V, D']`; the whitening is an argument, so that XLA does not fold it."""
        maps, windows = self.maps, self.windows
        convolution = jax.device_put(kernels(learned_whitening(self), windows))

        def describe(model: SsmVgg, images: Array, kernel: Array, offset: Array) -> Array:
            return whiten_windows(maps.compute(model, images), kernel, offset, stride=windows.stride)

        program = compile_network(self.model, describe)
        return lambda images: program(images, *convolution)


@dataclass(frozen=True)
class SsmWindows(_WhitenedWindows):
    """Descriptors for retrieval by votes: 36 whitened windows of 9 x 9 positions of the first stage's map."""

    stage = 1
    image_size: tuple[int, int] = only_size(224, 224)

    @property
    def windows(self) -> Windows:
        return Windows(self.maps.shape, 9)

    @property
    def vector_size(self) -> int:
        """Length of all windows' descriptors, one after the other."""
        return self.windows.count * self.whitening.dimension


@dataclass(frozen=True)
class SsmCells(_WhitenedWindows):
    """Local features for matching: whitened windows of 3 x 3 positions of the second stage's map, the cells of a grid.

    Descriptors are of any length. Match each cell of the candidate to the cell of the largest dot product
    (`cross_check="candidate"` of `mfvpr.match`), and score with `GridAnchors`, `side` as in `windows.grid`.

    `image_size` is 336 x 336 px in the paper, 224 x 224 in the public program, or 448 x 448. `stride` is the number of
    positions from cell to cell. Images without cells raise an `InputError`.
    """

    has_vector, stage = False, 2
    image_size: tuple[int, int] = setting(
        (336, 336), SIZE, "width, height: 40 x 40 cells; [224, 224]: 26 x 26, [448, 448]: 54 x 54"
    )
    whitening: WindowFitting | Whitening = _OF_CELLS
    stride: int = setting(1, whole(1, 8), "positions of the map, 8 px each, from cell to cell")

    def __post_init__(self) -> None:
        super().__post_init__()
        self.windows  # noqa: B018  # refuses images that are too small

    @property
    def windows(self) -> Windows:
        """The windows of a map: 40 x 40 at 336 px."""
        return Windows(self.maps.shape, 3, self.stride)

    @property
    def scales(self) -> tuple[Scale, ...]:
        return (Scale(self.whitening.dimension, self.windows.count),)

    def describe_result(self, result: Float[np.ndarray, "cells dimensions"]) -> Description:
        middles = STAGE2_STRIDE * (self.windows.corners[:, ::-1] + self.windows.size // 2) + _MIDDLE
        return Description(local=(local_features(middles, result, self.image_size),))
