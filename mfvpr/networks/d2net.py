"""D2-Net (Dusmanu et al., CVPR 2019): one dense map serves as detector and as descriptor.

The network ends in a map `[h, w, C]`. A keypoint lies where a channel is the strongest of its position, a maximum of
its own 3 x 3 neighborhood, and no edge; a Newton step refines the position, and the map, interpolated there, is the
descriptor. Positions of the map are (row, column); those of the image are (x, y) = 4 p + 1.5 px.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax import Array, lax

from mfvpr.networks.imagenet import Preprocessing, preprocess
from mfvpr.networks.lengths import of_unit_length
from mfvpr.networks.sampling import between, neighbors
from mfvpr.networks.vgg import Vgg16

STRIDE = 4  # px between positions of the map
SCALES = (0.5, 1.0, 2.0)  # of the multi-scale detection, in this order
# Cells of 4 x 4 px that lie within what a position of the map sees (92 x 92 px), from its own cell on.
_FIELD = (-10, 11)
_EDGE_THRESHOLD = 5  # largest ratio of the principal curvatures


class D2Net(nnx.Module):
    """VGG16 to `conv4_3`; the third pooling is a smoothing, which keeps stride 4, and block 4 is dilated instead.

    Args:
        relu: end with a ReLU, as published.
        precision: of the products where the hardware offers less than float32, which moves keypoints.
    """

    def __init__(self, *, relu: bool = True, precision: str = "highest", rngs: nnx.Rngs) -> None:
        pools = ("max", "max", "average")
        self.vgg = Vgg16("conv4_3", pools=pools, dilations=(1, 1, 1, 2), precision=precision, rngs=rngs)
        self.relu = relu

    def __call__(self, images: Array) -> Array:
        """Dense maps `[B, h, w, 512]` of preprocessed images `[B, H, W, 3]`; h = H // 4 - 1, w = W // 4 - 1."""
        dense = self.vgg(images, uniform=_repeats(images))
        return nnx.relu(dense) if self.relu else dense


def _repeats(images: Array) -> Array:
    """Whether in any of the images `[B, H, W, 3]` two neighbors in the map see the same, as in a white sky; `[]` bool.

    The map is level there, unless the rounding makes peaks. Beyond the border all is taken to be the same.
    """
    batch, height, width, _ = images.shape
    rows, columns = -(-height // STRIDE), -(-width // STRIDE)
    before, after = _FIELD
    found = jnp.zeros((), bool)
    for shifted in (images[:, STRIDE:] == images[:, :-STRIDE], images[:, :, STRIDE:] == images[:, :, :-STRIDE]):
        same = jnp.all(shifted, axis=-1)
        missing = (STRIDE * rows - same.shape[1], STRIDE * columns - same.shape[2])
        same = jnp.pad(same, ((0, 0), (0, missing[0]), (0, missing[1])), constant_values=True)
        same = jnp.all(same.reshape(batch, rows, STRIDE, columns, STRIDE), axis=(2, 4))
        for axis in (1, 2):
            padding = [(-before, after) if axis == other else (0, 0) for other in range(3)]
            window = [after - before + 1 if axis == other else 1 for other in range(3)]
            same = lax.reduce_window(same, True, lax.bitwise_and, window, (1, 1, 1), padding)
        found |= jnp.any(same)
    return found


class Detections(NamedTuple):
    """Keypoints of one map in N slots, ordered by channel, then row, then column; then padding."""

    keypoints: Array  # [N, 2] (x, y), px of the image that the map was made of
    descriptors: Array  # [N, C], unit Euclidean length
    scores: Array  # [N] the map's value at the integer position
    mask: Array  # [N] bool
    count: Array  # [] how many were found; where it exceeds N, those of the lowest scores are missing


class Survey(NamedTuple):
    """What the detector sees at each position of a map, in the strongest channel there."""

    channel: Array  # [h, w] int32
    score: Array  # [h, w]
    detected: Array  # [h, w] bool
    step: Array  # [h, w, 2] (row, column), from the position to the maximum of a parabola


def map_size(pixels: int) -> int:
    """Length of the map's side along an image's side."""
    return pixels // STRIDE - 1


def extract(
    model: D2Net,
    images: Array,
    *,
    preprocessing: Preprocessing = "caffe",
    scales: Sequence[float] = (1.0,),
    share: float = 1.0,
) -> tuple[Detections, ...]:
    """Keypoints of images `[B, H, W, 3]`: one Detections per scale, each with a leading axis B.

    Args:
        model: the network.
        images: RGB, 0 .. 255, at least 12 px high and wide at every scale.
        preprocessing: of the pixels; "caffe" is what the published weights want.
        scales: of the images, see `detect`; `SCALES` are the original's.
        share: slots per position of a map; 1 holds whatever is found.
    """
    pixels = preprocess(images, preprocessing)
    height, width = images.shape[1:3]
    sizes = [(int(height * scale), int(width * scale)) for scale in scales]
    maps = [model(_stretched(_stretched(pixels, columns, axis=2), rows, axis=1)) for rows, columns in sizes]
    ratios = [(width / columns, height / rows) for rows, columns in sizes]
    return jax.vmap(lambda levels: detect(levels, ratios, share))(maps)


def detect(
    maps: Sequence[Array], ratios: Sequence[tuple[float, float]] = ((1.0, 1.0),), share: float = 1.0
) -> tuple[Detections, ...]:
    """Keypoints of one image from its dense maps `[h, w, C]`, one of each scale, the smallest first.

    A map is added to the next, where there were keypoints in it; where it has detections, the next has none; and scores
    of the n-th map are divided by n.

    Args:
        maps: of the scales.
        ratios: (width, height) of the image over those of each scale's.
        share: slots per position of a map; 1 holds whatever is found.
    """
    found: list[Detections] = []
    coarser = banned = None
    for dense, ratio in zip(maps, ratios, strict=True):
        rows, columns, _ = dense.shape
        if coarser is not None:
            dense = dense + _stretched(_stretched(coarser, columns, axis=1), rows, axis=0)
        seen = survey(dense)
        if banned is not None:
            banned = banned[_nearest(len(banned), rows)][:, _nearest(banned.shape[1], columns)]
            seen = seen._replace(detected=seen.detected & ~banned)
        level = select(dense, seen, math.ceil(share * rows * columns))
        coarser = jnp.where(level.count > 0, dense, 0)
        banned = seen.detected if banned is None else banned | seen.detected
        scaled = level.keypoints * jnp.array(ratio, jnp.float32)[None]
        found.append(level._replace(keypoints=scaled, scores=level.scores / (len(found) + 1)))
    return tuple(found)


def survey(dense: Array) -> Survey:
    """What the detector sees in one dense map `[h, w, C]`.

    Where several channels share a position's maximum exactly, the first alone is looked at (the original looks at each,
    and reports the position once for each that passes). Positions where all channels are zero are not detected.
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
    passes, step = _parabola(around)
    return Survey(channel, score, is_peak & passes, step)


def _parabola(around: dict[tuple[int, int], Array]) -> tuple[Array, Array]:
    """Whether it is no edge `[h, w]`, and the step to its maximum `[h, w, 2]`, from values at (down, right)."""
    center = around[0, 0]
    ii = around[-1, 0] - 2 * center + around[1, 0]
    jj = around[0, -1] - 2 * center + around[0, 1]
    ij = (around[-1, -1] - around[-1, 1] - around[1, -1] + around[1, 1]) / 4
    i = (around[1, 0] - around[-1, 0]) / 2
    j = (around[0, 1] - around[0, -1]) / 2
    det = ii * jj - ij * ij
    trace = ii + jj
    is_blob = (det > 0) & (trace * trace / det <= (_EDGE_THRESHOLD + 1) ** 2 / _EDGE_THRESHOLD)
    step = jnp.stack([ij / det * j - jj / det * i, ij / det * i - ii / det * j], axis=-1)
    return is_blob, step


def select(dense: Array, seen: Survey, capacity: int) -> Detections:
    """The keypoints among what was detected in a map `[h, w, C]`, in min(capacity, h w) slots.

    Kept are those that lie at most half a position from where they were detected, and on the map.
    """
    height, width, _ = dense.shape
    grid = jnp.stack(jnp.meshgrid(jnp.arange(height), jnp.arange(width), indexing="ij"), axis=-1)
    position = grid.astype(seen.step.dtype) + seen.step  # [h, w, 2]
    last = jnp.array([height - 1, width - 1], position.dtype)[None, None]
    inside = (jnp.floor(position) >= 0) & (jnp.ceil(position) <= last)
    valid = (seen.detected & jnp.all(inside & (jnp.abs(seen.step) < 0.5), axis=-1)).reshape(-1)
    order = seen.channel.reshape(-1) * valid.size + jnp.arange(valid.size)  # int32 suffices up to 4 million positions
    _, strongest = lax.top_k(jnp.where(valid, seen.score.reshape(-1), -jnp.inf), min(capacity, valid.size))
    order = jnp.sort(jnp.where(valid, order, jnp.iinfo(order.dtype).max)[strongest])
    place = order % valid.size
    position = position.reshape(-1, 2)[place]
    return Detections(
        keypoints=position[:, ::-1] * STRIDE + 1.5,
        descriptors=_interpolated(dense, position),
        scores=seen.score.reshape(-1)[place],
        mask=order < jnp.iinfo(order.dtype).max,
        count=jnp.sum(valid),
    )


def _interpolated(dense: Array, position: Array) -> Array:
    """The map `[h, w, C]` at positions `[N, 2]`, bilinear, scaled to unit length `[N, C]`."""
    low, high = jnp.floor(position), jnp.ceil(position)
    after = position - low
    before = 1 - after
    (top, left), (bottom, right) = low.astype(int).T, high.astype(int).T
    vectors = (
        (before[:, 0] * before[:, 1])[:, None] * dense[top, left]
        + (before[:, 0] * after[:, 1])[:, None] * dense[top, right]
        + (after[:, 0] * before[:, 1])[:, None] * dense[bottom, left]
        + (after[:, 0] * after[:, 1])[:, None] * dense[bottom, right]
    )
    return of_unit_length(vectors)


def _stretched(values: Array, size: int, *, axis: int) -> Array:
    """Linear interpolation along an axis, so that its ends stay the ends."""
    length = values.shape[axis]
    return values if size == length else between(values, neighbors(length, size), axis)


def _nearest(length: int, size: int) -> np.ndarray:
    """Which of `length` entries each of `size` takes, rounded down."""
    position = np.arange(size, dtype=np.float32) * (np.float32(length) / np.float32(size))
    return np.minimum(np.floor(position).astype(int), length - 1)
