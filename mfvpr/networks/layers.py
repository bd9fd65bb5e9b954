"""Parts that several networks share: preprocessing of images, convolutions, normalizations, means, interpolation.

Products are of full float32 on every device: with less, keypoints move.

On a CPU, 3 x 3 convolutions take half of the products: Winograd's F(4, 3) (Lavin & Gray, CVPR 2016) along the rows
makes four rows of the result from six rows of the input by six convolutions with 1 x 3 kernels, instead of twelve. The
rounding errors of VGG16 grow by half, and differ between the four rows: equal neighborhoods give results that differ in
the last bits. `uniform=True` avoids this by the direct method. On other processors, the library of the device chooses.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax import lax
from jaxtyping import Bool, Float, Int, Num

from mfvpr.core.types import Array

Preprocessing = Literal["caffe", "torch"]
Pixels = Num[Array, "batch height width 3"]  # RGB, 0 .. 255, uint8 or float32
Images = Float[Array, "batch height width 3"]  # inputs of networks

MEAN = (0.485, 0.456, 0.406)  # of the training images, RGB in 0 .. 1
DEVIATION = (0.229, 0.224, 0.225)
_STATISTICS = {  # scale, mean and deviation, in the network's order of the channels
    "caffe": (1.0, np.array([103.939, 116.779, 123.68]), np.ones(3)),
    "torch": (255.0, np.array(MEAN), np.array(DEVIATION)),
}

PRECISION = "highest"  # of products
EPSILON = 1e-12  # least divisor of vectors, as in the public codes

matmul = partial(jnp.matmul, precision=PRECISION)
Linear = partial(nnx.Linear, precision=PRECISION)
LayerNorm = partial(nnx.LayerNorm, use_fast_variance=False)
BatchNorm = partial(nnx.BatchNorm, use_running_average=True, epsilon=1e-5)

_WIDE = 128  # least input channels for which fewer products outweigh more memory traffic
# The convolution is a product of polynomials: their values at 0, 1, -1, 2, -2 and infinity, and the inverse.
_INPUT = (
    (4, 0, -5, 0, 1, 0),
    (0, -4, -4, 1, 1, 0),
    (0, 4, -4, -1, 1, 0),
    (0, -2, -1, 2, 1, 0),
    (0, 2, -1, -2, 1, 0),
    (0, 4, 0, -5, 0, 1),
)
_KERNEL = (
    (1 / 4, 0, 0),
    (-1 / 6, -1 / 6, -1 / 6),
    (-1 / 6, 1 / 6, -1 / 6),
    (1 / 24, 1 / 12, 1 / 6),
    (1 / 24, -1 / 12, 1 / 6),
    (0, 0, 1),
)
_OUTPUT = ((1, 1, 1, 1, 1, 0), (0, 1, -1, 2, -2, 0), (0, 1, 1, 4, 4, 0), (0, 1, -1, 8, -8, 1))


def preprocess(images: Pixels, preprocessing: Preprocessing = "torch") -> Images:
    """RGB images from 0 to 255 -> inputs of the network, float32.

    "caffe" is BGR minus the mean. "torch" is RGB in [0, 1], minus the mean, divided by the standard deviation. Results
    for bytes are those of float64, rounded once, as in D2-Net's code.
    """
    scale, mean, deviation = _STATISTICS[preprocessing]
    ordered = images[..., ::-1] if preprocessing == "caffe" else images
    if images.dtype == jnp.uint8:  # a table, since a device has no float64
        byte = np.arange(256, dtype=np.float32) / np.float32(scale)
        table = jnp.asarray((byte[None] - mean[:, None]) / deviation[:, None], jnp.float32)
        return jnp.stack([table[channel][ordered[..., channel]] for channel in range(3)], axis=-1)
    scale, mean, deviation = (jnp.asarray(values, jnp.float32) for values in (scale, mean, deviation))
    return (ordered / scale - mean[None, None, None]) / deviation[None, None, None]


def of_unit_length(vectors: Float[Array, "*batch dimensions"]) -> Float[Array, "*batch dimensions"]:
    """Vectors divided by their lengths."""
    return vectors / jnp.maximum(jnp.linalg.norm(vectors, axis=-1, keepdims=True), EPSILON)


def bias_of(layer: nnx.Linear | nnx.Conv) -> Array:
    """Bias of a layer that has one; Flax's annotation allows None."""
    assert layer.bias is not None
    return layer.bias[...]


def conv(
    inputs: int, outputs: int, size: int = 3, *, stride: int = 1, use_bias: bool = False, rngs: nnx.Rngs
) -> nnx.Conv:
    """Convolution with equal padding on all sides; with a stride, "SAME" pads one row and column fewer before."""
    shape, padding = (size, size), size // 2
    return nnx.Conv(
        inputs, outputs, shape, strides=stride, padding=padding, use_bias=use_bias, precision=PRECISION, rngs=rngs
    )


class Conv3x3(nnx.Module):
    """3 x 3 convolution that keeps the size: `kernel` `[3, 3, C, D]`, `bias` `[D]` or none; zeros outside.

    `dilation` is the distance between the kernel's columns and rows.
    """

    def __init__(self, inputs: int, outputs: int, *, dilation: int = 1, use_bias: bool = True, rngs: nnx.Rngs) -> None:
        self.kernel = nnx.Param(nnx.initializers.he_normal()(rngs.params(), (3, 3, inputs, outputs), jnp.float32))
        self.bias = nnx.Param(jnp.zeros(outputs, jnp.float32)) if use_bias else None
        self.dilation = dilation

    def __call__(
        self, x: Float[Array, "batch height width inputs"], uniform: bool | Bool[Array, ""] = False
    ) -> Float[Array, "batch height width outputs"]:
        """Convolve a map; if `uniform`, equal neighborhoods give equal bits, which takes 1.5 times as long."""
        direct = partial(_convolve, above=self.dilation, dilation=self.dilation)

        def fast(x: Array, kernel: Array) -> Array:
            return lax.cond(uniform, direct, partial(winograd, dilation=self.dilation), x, kernel)

        kernel, is_wide = self.kernel[...], x.shape[-1] >= _WIDE
        product = lax.platform_dependent(x, kernel, cpu=fast, default=direct) if is_wide else direct(x, kernel)
        return product if self.bias is None else product + self.bias[...][None, None, None]


def winograd(
    x: Float[Array, "batch height width inputs"], kernel: Float[Array, "3 3 inputs outputs"], dilation: int
) -> Float[Array, "batch height width outputs"]:
    """Convolve a map, zeros outside."""
    batch, height, width, channels = x.shape
    tiles = -(-height // (4 * dilation))
    below = dilation * (4 * tiles + 3) - height
    x = jnp.pad(x, ((0, 0), (dilation, below), (0, 0), (0, 0)))
    x = x.reshape(batch, tiles + 1, 4, dilation, width, channels)  # row = 4 d tile + d place + phase
    rows = [x[:, :-1, place] for place in range(4)] + [x[:, 1:, place] for place in range(2)]
    products = [
        _convolve(evaluated.reshape(batch, -1, width, channels), column[None], 0, dilation)
        for evaluated, column in zip(_combine(_INPUT, rows), _combine(_KERNEL, list(kernel)), strict=True)
    ]
    result = _combine(_OUTPUT, [product.reshape(batch, tiles, dilation, width, -1) for product in products])
    return jnp.stack(result, axis=2).reshape(batch, 4 * tiles * dilation, width, -1)[:, :height]


def _convolve(x: Array, kernel: Array, above: int, dilation: int) -> Array:
    return lax.conv_general_dilated(
        x,
        kernel,
        (1, 1),
        padding=((above, above), (dilation, dilation)),
        rhs_dilation=(dilation, dilation),
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
        precision=PRECISION,
    )


def sum_of_shifts(x: Array, kernel: Array, stride: int) -> Array:
    """Convolution of each channel by itself, or of one channel to several, without padding; for CPUs."""
    size = len(kernel)
    rows, columns = ((side - size) // stride + 1 for side in x.shape[1:3])
    shifts = [
        x[:, row : row + stride * (rows - 1) + 1 : stride, column : column + stride * (columns - 1) + 1 : stride]
        for row in range(size)
        for column in range(size)
    ]
    weights = kernel.reshape(size * size, 1, 1, 1, -1)
    return sum(
        (weight * shifted for weight, shifted in zip(weights[1:], shifts[1:], strict=True)), weights[0] * shifts[0]
    )


def _combine(matrix: Sequence[Sequence[float]], parts: Sequence[Array]) -> list[Array]:
    """Product of a matrix and the column of parts."""
    products = [[weight * part for weight, part in zip(row, parts, strict=True) if weight] for row in matrix]
    return [sum(terms[1:], start=terms[0]) for terms in products]


def average_cells(maps: Float[Array, "..."], cells: int, axis: int) -> Float[Array, "..."]:
    """Means of an axis over cells of about equal size; cells share a position that lies in both."""
    size, cell = maps.shape[axis], np.arange(cells)
    start, end = cell * size // cells, -(-(cell + 1) * size // cells)
    position = np.arange(size)
    inside = (position[None] >= start[:, None]) & (position[None] < end[:, None])
    weights = jnp.asarray(inside / (end - start)[:, None], maps.dtype)
    return jnp.moveaxis(jnp.tensordot(weights, maps, (1, axis), precision=PRECISION), 0, axis)


class GeneralizedMean(nnx.Module):
    """(mean_p max(x_p, 1e-6)^power)^(1 / power) of each channel: power 1 is the mean, infinity the maximum."""

    def __init__(self, power: float = 3.0) -> None:
        self.power = nnx.Param(jnp.full(1, power, jnp.float32))

    def __call__(self, maps: Float[Array, "batch height width channels"]) -> Float[Array, "batch channels"]:
        power, values = self.power[...][0], jnp.maximum(maps, 1e-6)
        largest = jnp.max(values, axis=(1, 2), keepdims=True)  # a divisor, so that powers of small values do not vanish
        means = jnp.mean((values / largest) ** power, axis=(1, 2))
        return largest[:, 0, 0] * means ** (1 / power)


class Detections(NamedTuple):
    """Keypoints of one image or map, padding last."""

    keypoints: Float[Array, "slots 2"]  # (x, y) px
    scores: Float[Array, " slots"]
    mask: Bool[Array, " slots"]  # True on the first ones
    count: Int[Array, ""]  # number of keypoints; if above the slots, those with the lowest scores are missing
    descriptors: Float[Array, "slots dimensions"] | None = None  # of unit length


class Neighbors(NamedTuple):
    """Pixels before and after each position on a line, and the position between them."""

    lower: Int[np.ndarray, " positions"]
    upper: Int[np.ndarray, " positions"]
    part: Float[np.ndarray, " positions"]  # in [0, 1], from lower to upper


def sample(
    dense: Float[Array, "height width channels"], points: Float[Array, "*points 2"]
) -> Float[Array, "*points channels"]:
    """Sample a map at positions (x, y) px.

    Pixels outside the map are zero, so values fade out within one pixel of the border, as in `grid_sample` with aligned
    corners and in deformable convolutions.
    """
    height, width, channels = dense.shape
    flat = dense.reshape(height * width, channels)  # one index is faster than two
    total = jnp.zeros((*points.shape[:-1], channels), dense.dtype)
    for y, x, weight in around(points, height, width):
        total += weight[..., None] * flat.at[y * width + x].get(mode="promise_in_bounds")
    return total


def around(
    points: Float[Array, "*points 2"], height: int, width: int
) -> Iterator[tuple[Int[Array, "*points"], Int[Array, "*points"], Float[Array, "*points"]]]:
    """Yield y, x and weight of the four pixels around positions (x, y) px; those outside move inside, with weight 0."""
    low = jnp.floor(points)
    part, pixel = points - low, low.astype(int)
    for down in (0, 1):
        for right in (0, 1):
            x, y = pixel[..., 0] + right, pixel[..., 1] + down
            across = part[..., 0] if right else 1 - part[..., 0]
            along = part[..., 1] if down else 1 - part[..., 1]
            inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
            yield jnp.clip(y, 0, height - 1), jnp.clip(x, 0, width - 1), jnp.where(inside, across * along, 0)


def stretch(
    dense: Float[Array, "*batch height width channels"], rows: int, columns: int
) -> Float[Array, "*batch {rows} {columns} channels"]:
    """Resize maps, with aligned corner pixels."""
    for axis, size in ((-2, columns), (-3, rows)):
        if dense.shape[axis] != size:
            dense = between(dense, neighbors(dense.shape[axis], size), axis)
    return dense


def neighbors(size: int, count: int, window: slice = slice(None)) -> Neighbors:
    """Neighbors of `count` evenly spaced positions, from the first to the last of `size` pixels, in a window."""
    step = np.float32((size - 1) / max(count - 1, 1))
    position = step * np.arange(count, dtype=np.float32)[window]  # rounded as torch rounds it
    lower = np.minimum(position.astype(int), size - 1)
    return Neighbors(lower, np.minimum(lower + 1, size - 1), position - lower.astype(np.float32))


def between(dense: Float[Array, "..."], places: Neighbors, axis: int) -> Float[Array, "..."]:
    """Interpolate `dense` at these places along one axis.

    Reading two neighbors is several times faster than a product with the sparse matrix of the interpolation.
    """
    part = jnp.expand_dims(places.part, [each for each in range(dense.ndim) if each != axis % dense.ndim])
    return (1 - part) * jnp.take(dense, places.lower, axis) + part * jnp.take(dense, places.upper, axis)


def local_maximum(values: Num[Array, "height width"] | Bool[Array, "height width"], radius: int) -> Array:
    """Maximum of the square around each pixel. Slices along each axis are faster than a window reduction."""
    lowest = False if values.dtype == bool else -jnp.inf
    for axis, size in enumerate(values.shape):
        margin = [(0, 0), (0, 0)]
        margin[axis] = (radius, radius)
        padded = jnp.pad(values, margin, constant_values=lowest)
        for shift in range(2 * radius + 1):
            values = jnp.maximum(values, jax.lax.slice_in_dim(padded, shift, shift + size, axis=axis))
    return values


def over_batch(function: Callable[..., Any]) -> Callable[..., Any]:
    """`jax.vmap(function)`; a batch of one goes without it, which takes a third of the time to trace."""

    def call(*batch: Any) -> Any:
        if len(jax.tree.leaves(batch)[0]) != 1:
            return jax.vmap(function)(*batch)
        return jax.tree.map(lambda leaf: leaf[None], function(*jax.tree.map(lambda leaf: jnp.asarray(leaf)[0], batch)))

    return call
