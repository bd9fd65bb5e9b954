"""SSM-VPR's descriptors (Camara & Preucil, RAS 2020): windows for retrieval, cells of a grid for matching."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import jax
import numpy as np
from jaxtyping import Float, Num

from mfvpr.datasets.image_reading import Interpolation
from mfvpr.features.extractor import Description, Scale, local_features
from mfvpr.features.network import NetworkExtractor, compile_network
from mfvpr.features.whitening import Whitening
from mfvpr.features.windows import WindowFitting, Windows, kernels, learned_whitening, normalize_maps, whiten_windows
from mfvpr.networks.imagenet import Preprocessing
from mfvpr.networks.ssm import STAGE1_STRIDE, STAGE2_STRIDE, SsmVgg
from mfvpr.utils.fields import SIZE, check_fields, setting, whole, word_of

CHANNELS = 512
STAGE1_SIZE = (224, 224)
STAGE1_FITTING, STAGE2_FITTING = WindowFitting(125), WindowFitting(100, dtype="float64")  # as published
_PREPROCESSING: Any = setting(
    "torch", word_of(Preprocessing), "torch, as published, or caffe, which the weights are for"
)
_STRIDES = {1: STAGE1_STRIDE, 2: STAGE2_STRIDE}
_MIDDLE = (STAGE2_STRIDE - 1) / 2  # px from a position's first pixel to its middle


@dataclass(frozen=True)
class SsmMaps(NetworkExtractor):
    """Feature maps of one stage as global descriptors, of unit length at every position.

    Attributes, beside those of `Extractor`:
        stage: 1 or 2.
        preprocessing: "torch" as the public code, or "caffe", which the weights are for.
    """

    model: SsmVgg = field(repr=False)
    stage: Literal[1, 2]
    image_size: tuple[int, int]
    interpolation: Interpolation = setting("pil_bilinear", word_of(Interpolation))
    preprocessing: Preprocessing = _PREPROCESSING
    batch_size: int = setting(8, whole(1, 256), recipe=False)

    @property
    def shape(self) -> tuple[int, int, int]:
        """(rows, columns, channels) of a map."""
        columns, rows = (-(-side // _STRIDES[self.stage]) for side in self.image_size)
        return rows, columns, CHANNELS

    @property
    def vector_size(self) -> int:
        return int(np.prod(self.shape))

    def compute(
        self, model: SsmVgg, images: Num[jax.Array, "images height width 3"]
    ) -> Float[jax.Array, "images rows columns 512"]:
        """Maps of a batch; runs in a compiled program."""
        return normalize_maps(model(model.preprocess(images, self.preprocessing), self.stage))


class _WhitenedWindows(NetworkExtractor):
    """Base of the extractors of whitened windows, which are dataclasses with the fields of `SsmMaps`."""

    stage: Literal[1, 2]
    interpolation: Interpolation
    preprocessing: Preprocessing
    whitening: WindowFitting | Whitening
    windows: Any

    @property
    def maps(self) -> SsmMaps:
        """Extractor of the stage's maps."""
        return SsmMaps(self.model, self.stage, self.image_size, self.interpolation, self.preprocessing, self.batch_size)

    @cached_property
    def _program(self) -> Callable[..., Any]:
        """Images -> whitened windows `[V, D']`; the whitening is an argument, so that XLA does not fold it."""
        maps, windows = self.maps, self.windows
        convolution = jax.device_put(kernels(learned_whitening(self), windows))

        def describe(model: SsmVgg, images: jax.Array, kernel: jax.Array, offset: jax.Array) -> jax.Array:
            return whiten_windows(maps.compute(model, images), kernel, offset, stride=windows.stride)

        program = compile_network(self.model, describe)
        return lambda images: program(images, *convolution)


@dataclass(frozen=True)
class SsmWindows(_WhitenedWindows):
    """Descriptors for retrieval by votes: 36 whitened windows of 9 x 9 positions of the first stage's map.

    Images have 224 x 224 px, because the map of a larger image has more windows and the public code draws 36.

    Attributes, beside those of `SsmMaps`:
        whitening: settings to learn it from the database, or the learned whitening.
    """

    image_size, stage = STAGE1_SIZE, 1
    model: SsmVgg = field(repr=False)
    interpolation: Interpolation = setting("pil_bilinear", word_of(Interpolation))
    preprocessing: Preprocessing = _PREPROCESSING
    whitening: WindowFitting | Whitening = STAGE1_FITTING
    batch_size: int = setting(8, whole(1, 256), recipe=False)

    @property
    def windows(self) -> Windows:
        """The 36 windows of a map."""
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

    Attributes, beside those of `SsmMaps`:
        image_size: (width, height) px: 336 x 336 as the paper, 224 x 224 as the public program, 448 x 448.
        stride: positions from cell to cell.
        whitening: settings to learn it from the database, or the learned whitening.

    Raises:
        InputError: images of this size have no cells.
    """

    vector_size, stage = 0, 2  # no global descriptor; the second stage's map
    model: SsmVgg = field(repr=False)
    image_size: tuple[int, int] = setting(
        (336, 336), SIZE, "width, height: 40 x 40 cells; [224, 224]: 26 x 26, [448, 448]: 54 x 54"
    )
    interpolation: Interpolation = setting("pil_bilinear", word_of(Interpolation))
    preprocessing: Preprocessing = _PREPROCESSING
    stride: int = setting(1, whole(1, 8), "positions of the map, 8 px each, from cell to cell")
    whitening: WindowFitting | Whitening = STAGE2_FITTING
    batch_size: int = setting(8, whole(1, 256), recipe=False)

    def __post_init__(self) -> None:
        check_fields(self)
        self.windows  # noqa: B018  # refuses images that are too small

    @property
    def windows(self) -> Windows:
        """The windows of a map: 40 x 40 at 336 px."""
        return Windows(self.maps.shape, 3, self.stride)

    @property
    def scales(self) -> tuple[Scale, ...]:
        """One scale with all cells."""
        return (Scale(self.whitening.dimension, self.windows.count),)

    def _describe(self, result: Float[np.ndarray, "cells dimensions"]) -> Description:
        middles = STAGE2_STRIDE * (self.windows.corners[:, ::-1] + self.windows.size // 2) + _MIDDLE
        return Description(local=(local_features(middles, result, self.image_size),))
