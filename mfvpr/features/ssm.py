"""SSM-VPR's descriptors (Camara & Preucil, RAS 2020): windows for its filter, cells of a grid for its matching."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import jax
import numpy as np

from mfvpr.datasets.images import Interpolation
from mfvpr.features.extractor import Description, Scale
from mfvpr.features.network import at_places, compiled, in_batches
from mfvpr.features.windows import WindowFitting, Windows, kernels, known, normalized, whitened
from mfvpr.networks.imagenet import Preprocessing
from mfvpr.networks.ssm import STAGE1_STRIDE, STAGE2_STRIDE, SsmVgg
from mfvpr.types import Features
from mfvpr.utils.errors import InputError
from mfvpr.utils.whitening import Whitening

CHANNELS = 512
STAGE1_SIZE = (224, 224)
STAGE1_FITTING, STAGE2_FITTING = WindowFitting(125), WindowFitting(100, dtype="float64")  # as published
_STRIDES = {1: STAGE1_STRIDE, 2: STAGE2_STRIDE}
_MIDDLE = (STAGE2_STRIDE - 1) / 2  # px from a position's first pixel to its middle


@dataclass(frozen=True)
class SsmMaps:
    """The maps of one stage, of unit length at every position, as vectors.

    Attributes:
        model: the network with its weights.
        stage: 1 or 2.
        image_size: (width, height) px.
        interpolation: see `mfvpr.datasets.images.resize`.
        preprocessing: "torch" as the public code, or "caffe", which the weights are for.
        batch_size: images per call.
    """

    model: SsmVgg
    stage: Literal[1, 2]
    image_size: tuple[int, int]
    interpolation: Interpolation = "pil_bilinear"
    preprocessing: Preprocessing = "torch"
    batch_size: int = field(default=8, metadata={"recipe": False})

    @property
    def shape(self) -> tuple[int, int, int]:
        """(rows, columns, channels) of a map."""
        columns, rows = (-(-side // _STRIDES[self.stage]) for side in self.image_size)
        return rows, columns, CHANNELS

    @property
    def vector_size(self) -> int:
        """Numbers of a map."""
        return int(np.prod(self.shape))

    @property
    def scales(self) -> tuple[Scale, ...]:
        """(): there are no local features."""
        return ()

    def __call__(self, images: np.ndarray) -> list[Description]:
        """Maps of images `[B, H, W, 3]` RGB, 0 .. 255."""
        return [Description(maps.reshape(-1)) for maps in in_batches(self._program, images, self.batch_size)]

    def computed(self, model: SsmVgg, images: jax.Array) -> jax.Array:
        """`[B, rows, columns, 512]`, to be compiled."""
        stage = {1: model.stage1, 2: model.stage2}[self.stage]
        return normalized(stage(model.preprocess(images, self.preprocessing)))

    @cached_property
    def _program(self) -> Callable[..., Any]:
        return compiled(self.model, self.computed)


@dataclass(frozen=True)
class SsmWindows:
    """What the filter votes with: 36 windows of 9 x 9 positions of the first stage's map.

    Attributes:
        model: the network with its weights.
        interpolation: as of `SsmMaps`.
        preprocessing: likewise.
        whitening: how it is learned from the database, or what was learned.
        batch_size: images per call.
    """

    model: SsmVgg
    interpolation: Interpolation = "pil_bilinear"
    preprocessing: Preprocessing = "torch"
    whitening: WindowFitting | Whitening = STAGE1_FITTING
    batch_size: int = field(default=8, metadata={"recipe": False})

    @property
    def image_size(self) -> tuple[int, int]:
        """(224, 224), the only one: larger maps would have more windows, of which the public code draws 36."""
        return STAGE1_SIZE

    @property
    def maps(self) -> SsmMaps:
        """What the windows are taken from."""
        return SsmMaps(self.model, 1, self.image_size, self.interpolation, self.preprocessing, self.batch_size)

    @property
    def windows(self) -> Windows:
        """36."""
        return Windows(self.maps.shape, 9)

    @property
    def vector_size(self) -> int:
        """Numbers of all windows, one after the other."""
        return self.windows.count * self.whitening.dimension

    @property
    def scales(self) -> tuple[Scale, ...]:
        """(): there are no local features."""
        return ()

    def __call__(self, images: np.ndarray) -> list[Description]:
        """Whitened windows of images `[B, 224, 224, 3]` RGB, 0 .. 255, `[36 * D']` float32 each.

        Raises:
            InputError: it has not seen the database.
        """
        return [Description(vectors.reshape(-1)) for vectors in in_batches(self._program, images, self.batch_size)]

    @cached_property
    def _program(self) -> Callable[..., Any]:
        return _program(self.model, self.maps, self.windows, known(self))


@dataclass(frozen=True)
class SsmCells:
    """What is matched: whitened windows of 3 x 3 positions of the second stage's map, each a cell of a grid.

    They are of any length: what is matched is the largest dot product, for every cell of the candidate (`candidate` of
    `mfvpr.match`), and scored by `GridAnchors`, whose `side` is that of `windows.grid`.

    Attributes:
        model: the network with its weights.
        image_size: (width, height) px: 336 x 336 as the paper, 224 x 224 as the public program, 448 x 448.
        interpolation: as of `SsmMaps`.
        preprocessing: likewise.
        stride: positions from cell to cell.
        whitening: how it is learned from the database, or what was learned.
        batch_size: images per call.

    Raises:
        InputError: images of this size have no cells.
    """

    model: SsmVgg
    image_size: tuple[int, int] = (336, 336)
    interpolation: Interpolation = "pil_bilinear"
    preprocessing: Preprocessing = "torch"
    stride: int = 1
    whitening: WindowFitting | Whitening = STAGE2_FITTING
    batch_size: int = field(default=8, metadata={"recipe": False})

    def __post_init__(self) -> None:
        if self.stride < 1:
            raise InputError(f"stride={self.stride}: expected positions from cell to cell, from 1")
        self.windows  # noqa: B018  # refuses images that are too small

    @property
    def maps(self) -> SsmMaps:
        """What the cells are taken from."""
        return SsmMaps(self.model, 2, self.image_size, self.interpolation, self.preprocessing, self.batch_size)

    @property
    def windows(self) -> Windows:
        """Of a map: 40 x 40 at 336 px."""
        return Windows(self.maps.shape, 3, self.stride)

    @property
    def vector_size(self) -> int:
        """0: there is no global descriptor."""
        return 0

    @property
    def scales(self) -> tuple[Scale, ...]:
        """One, of all cells."""
        return (Scale(self.whitening.dimension, self.windows.count),)

    def __call__(self, images: np.ndarray) -> list[Description]:
        """Cells of images `[B, H, W, 3]` RGB, 0 .. 255, rows from the top, each from the left; scores are 1.

        Raises:
            InputError: it has not seen the database.
        """
        cells = in_batches(self._program, images, self.batch_size)
        return [Description(local=(self._features(vectors),)) for vectors in cells]

    @cached_property
    def _program(self) -> Callable[..., Any]:
        return _program(self.model, self.maps, self.windows, known(self))

    def _features(self, descriptors: np.ndarray) -> Features:
        middle = STAGE2_STRIDE * (self.windows.corners[:, ::-1] + self.windows.size // 2) + _MIDDLE
        return at_places(middle, descriptors, self.image_size)


def _program(model: SsmVgg, maps: SsmMaps, windows: Windows, whitening: Whitening) -> Callable[..., Any]:
    """Images -> whitened windows `[V, D']`; the whitening is no constant of the program."""
    learned = jax.device_put(kernels(whitening, windows))
    program = compiled(
        model, lambda model, images, *parts: whitened(maps.computed(model, images), *parts, stride=windows.stride)
    )
    return lambda images: program(images, *learned)
