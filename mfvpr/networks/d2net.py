"""D2-Net (Dusmanu et al., CVPR 2019): one dense map serves as detector and as descriptor.

The network returns a map `[h, w, C]`. A position is a keypoint if its strongest channel has a maximum in its 3 x 3
neighborhood there that is no edge. A Newton step refines the position, and the descriptor is the map, interpolated at
the refined position. Positions in the map are (row, column); in the image, position p is (x, y) = 4 p + 1.5 px.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax import lax
from jaxtyping import Bool, Float, Int

from mfvpr.core.types import Array
from mfvpr.networks import layers
from mfvpr.networks.backbones import Vgg16

STRIDE = 4  # px between positions of the map
SCALES = (0.5, 1.0, 2.0)  # of the multi-scale detection, in this order
_FIELD = (-10, 11)  # receptive field (92 x 92 px) of a position, in cells of 4 x 4 px relative to its own
_EDGE_THRESHOLD = 5  # largest ratio of the principal curvatures


class D2Net(nnx.Module):
    """VGG16 to `conv4_3` and a ReLU.

    The third pooling only smooths, so the stride stays 4, and block 4 is dilated instead.
    """

    def __init__(self, *, rngs: nnx.Rngs) -> None:
        self.vgg = Vgg16("conv4_3", pools=("max", "max", "average"), dilations=(1, 1, 1, 2), rngs=rngs)

    def __call__(self, images: layers.Images) -> Float[Array, "batch height//4-1 width//4-1 512"]:
        """Dense maps of preprocessed images."""
        return nnx.relu(self.vgg(images, uniform=_repeats(images)))


def _repeats(images: layers.Images) -> Bool[Array, ""]:
    """Whether two neighbors in a map of any image have equal receptive fields, as in a white sky.

    The map is constant there, but rounding can create peaks. Pixels outside the images count as equal.
    """
    batch, height, width, _ = images.shape
    rows, columns = -(-height // STRIDE), -(-width // STRIDE)
    before, after = _FIELD
    repeats = jnp.zeros((), bool)
    for equal in (images[:, STRIDE:] == images[:, :-STRIDE], images[:, :, STRIDE:] == images[:, :, :-STRIDE]):
        same = jnp.all(equal, axis=-1)
        missing = (STRIDE * rows - same.shape[1], STRIDE * columns - same.shape[2])
        same = jnp.pad(same, ((0, 0), (0, missing[0]), (0, missing[1])), constant_values=True)
        same = jnp.all(same.reshape(batch, rows, STRIDE, columns, STRIDE), axis=(2, 4))
        for axis in (1, 2):
            padding = [(-before, after) if dimension == axis else (0, 0) for dimension in range(3)]
            window = [after - before + 1 if dimension == axis else 1 for dimension in range(3)]
            same = lax.reduce_window(same, True, lax.bitwise_and, window, (1, 1, 1), padding)
        repeats |= jnp.any(same)
    return repeats


class Survey(NamedTuple):
    """Properties of each position of a map, in its strongest channel."""

    channel: Int[Array, "height width"]
    score: Float[Array, "height width"]
    detected: Bool[Array, "height width"]
    step: Float[Array, "height width 2"]  # (row, column), from the position to the maximum of its parabola


def map_size(pixels: int) -> int:
    """Positions of the map along an image's side."""
    return pixels // STRIDE - 1


def extract(
    model: D2Net,
    images: layers.Pixels,
    *,
    preprocessing: layers.Preprocessing = "caffe",
    scales: Sequence[float] = (1.0,),
    share: float = 1.0,
) -> tuple[layers.Detections, ...]:
    """Keypoints of images: `Detections` for each scale, each with a leading axis `batch`.

    Args:
        images: RGB, 0 .. 255, at least 12 px high and wide at every scale.
        preprocessing: of the pixels; the published weights expect "caffe".
        scales: of the images, see `detect`; `SCALES` are the original's.
        share: slots per position of a map; 1 has room for all keypoints.
    """
    pixels = layers.preprocess(images, preprocessing)
    height, width = images.shape[1:3]
    sizes = [(int(height * scale), int(width * scale)) for scale in scales]
    maps = [model(layers.stretch(pixels, rows, columns)) for rows, columns in sizes]
    ratios = [(width / columns, height / rows) for rows, columns in sizes]
    return jax.vmap(lambda levels: detect(levels, ratios, share))(maps)


def detect(
    maps: Sequence[Float[Array, "_ _ channels"]],
    ratios: Sequence[tuple[float, float]] = ((1.0, 1.0),),
    share: float = 1.0,
) -> tuple[layers.Detections, ...]:
    """Keypoints of one image from its dense maps, one for each scale, the smallest first.

    A map with keypoints is added to the next map. Positions that one map detects are not detected in later maps. Scores
    of the n-th map are divided by n. `ratios` are (width, height) of the image, divided by those of each scale; `share`
    as in `extract`.
    """
    detections: list[layers.Detections] = []
    coarser = detected = None
    for dense, ratio in zip(maps, ratios, strict=True):
        rows, columns, _ = dense.shape
        if coarser is not None:
            dense = dense + layers.stretch(coarser, rows, columns)
        seen = survey(dense)
        if detected is not None:
            detected = detected[_nearest(len(detected), rows)][:, _nearest(detected.shape[1], columns)]
            seen = seen._replace(detected=seen.detected & ~detected)
        level = select(dense, seen, math.ceil(share * rows * columns))
        coarser = jnp.where(level.count > 0, dense, 0)
        detected = seen.detected if detected is None else detected | seen.detected
        scaled = level.keypoints * jnp.array(ratio, jnp.float32)[None]
        detections.append(level._replace(keypoints=scaled, scores=level.scores / (len(detections) + 1)))
    return tuple(detections)


def _nearest(length: int, size: int) -> Int[np.ndarray, " {size}"]:
    """Indices below `length`, evenly spread and rounded down."""
    position = np.arange(size, dtype=np.float32) * (np.float32(length) / np.float32(size))
    return np.minimum(np.floor(position).astype(int), length - 1)


def survey(dense: Float[Array, "height width channels"]) -> Survey:
    """Find the strongest channel and the local maxima of one dense map.

    If several channels share a position's maximum exactly, only the first counts. (The original reports the position
    once for each of them that is a maximum.) Positions with zeros in all channels are not detected.
    """
    height, width, channels = dense.shape
    score = jnp.max(dense, axis=-1)
    is_best = dense == score[..., None]
    channel = jnp.min(jnp.where(is_best, jnp.arange(channels), channels), axis=-1)  # on a CPU faster than argmax
    rows, columns = jnp.arange(height)[:, None], jnp.arange(width)[None, :]
    around, is_peak = {}, jnp.ones(score.shape, bool)
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            row, column = rows + down, columns + right
            inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
            value = dense[row, column, channel]
            around[down, right] = jnp.where(inside, value, 0)
            is_peak &= ~inside | (value <= score)
    # Derivatives by row and column: the curvatures tell an edge, a Newton step leads to the parabola's maximum.
    ii = around[-1, 0] - 2 * around[0, 0] + around[1, 0]
    jj = around[0, -1] - 2 * around[0, 0] + around[0, 1]
    ij = (around[-1, -1] - around[-1, 1] - around[1, -1] + around[1, 1]) / 4
    i, j = (around[1, 0] - around[-1, 0]) / 2, (around[0, 1] - around[0, -1]) / 2
    det, trace = ii * jj - ij * ij, ii + jj
    is_blob = (det > 0) & (trace * trace / det <= (_EDGE_THRESHOLD + 1) ** 2 / _EDGE_THRESHOLD)
    step = jnp.stack([ij / det * j - jj / det * i, ij / det * i - ii / det * j], axis=-1)
    return Survey(channel, score, is_peak & is_blob, step)


def select(dense: Float[Array, "height width channels"], seen: Survey, capacity: int) -> layers.Detections:
    """Keypoints among the detected positions of a map, in min(capacity, height * width) slots.

    Keypoints lie on the map after the refinement, less than half a position from the detected one; they are ordered by
    channel, then row, then column. A score is the map's value at the detected position.
    """
    height, width, _ = dense.shape
    grid = jnp.stack(jnp.meshgrid(jnp.arange(height), jnp.arange(width), indexing="ij"), axis=-1)
    position = grid.astype(seen.step.dtype) + seen.step
    last = jnp.array([height - 1, width - 1], position.dtype)[None, None]
    inside = (jnp.floor(position) >= 0) & (jnp.ceil(position) <= last)
    valid = (seen.detected & jnp.all(inside & (jnp.abs(seen.step) < 0.5), axis=-1)).reshape(-1)
    order = seen.channel.reshape(-1) * valid.size + jnp.arange(valid.size)  # int32 suffices up to 4 million positions
    _, strongest = lax.top_k(jnp.where(valid, seen.score.reshape(-1), -jnp.inf), min(capacity, valid.size))
    order = jnp.sort(jnp.where(valid, order, jnp.iinfo(order.dtype).max)[strongest])
    place = order % valid.size
    points = position.reshape(-1, 2)[place][:, ::-1]
    return layers.Detections(
        keypoints=points * STRIDE + 1.5,
        descriptors=layers.of_unit_length(layers.sample(dense, points)),
        scores=seen.score.reshape(-1)[place],
        mask=order < jnp.iinfo(order.dtype).max,
        count=jnp.sum(valid),
    )
