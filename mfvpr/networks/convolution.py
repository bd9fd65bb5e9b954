"""3 x 3 convolutions with half of the products on a CPU.

Winograd's F(4, 3) (Lavin & Gray, CVPR 2016) along the rows: four rows of the result come from six rows of the input by
six convolutions with 1 x 3 kernels, instead of twelve. The rounding errors of VGG16 grow by half, and differ between
the four rows: equal neighborhoods give results that differ in the last bits. `uniform=True` avoids this by the direct
method. On other processors, the library of the device chooses a method.
"""

from collections.abc import Sequence
from functools import partial

import jax.numpy as jnp
from flax import nnx
from jax import lax
from jaxtyping import Bool, Float

from mfvpr.core.types import Array

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
_OUTPUT = (
    (1, 1, 1, 1, 1, 0),
    (0, 1, -1, 2, -2, 0),
    (0, 1, 1, 4, 4, 0),
    (0, 1, -1, 8, -8, 1),
)


class Conv3x3(nnx.Module):
    """3 x 3 convolution that keeps the size: `kernel` `[3, 3, C, D]`, `bias` `[D]` or none; zeros outside.

    `dilation` is the distance between the kernel's columns and rows.
    """

    def __init__(
        self, inputs: int, outputs: int, *, dilation: int = 1, use_bias: bool = True, precision: str, rngs: nnx.Rngs
    ) -> None:
        initial = nnx.initializers.he_normal()
        self.kernel = nnx.Param(initial(rngs.params(), (3, 3, inputs, outputs), jnp.float32))
        self.bias = nnx.Param(jnp.zeros(outputs, jnp.float32)) if use_bias else None
        self.dilation = dilation
        self.precision = precision

    def __call__(
        self, x: Float[Array, "batch height width inputs"], uniform: bool | Bool[Array, ""] = False
    ) -> Float[Array, "batch height width outputs"]:
        """Convolve a map; if `uniform`, equal neighborhoods give equal bits, which takes 1.5 times as long."""
        kernel, options = self.kernel[...], {"dilation": self.dilation, "precision": self.precision}
        direct, on_cpu = partial(_convolve, above=self.dilation, **options), partial(winograd, **options)

        def fast(x: Array, kernel: Array) -> Array:
            return lax.cond(uniform, direct, on_cpu, x, kernel)

        is_wide = x.shape[-1] >= _WIDE
        product = lax.platform_dependent(x, kernel, cpu=fast, default=direct) if is_wide else direct(x, kernel)
        return product if self.bias is None else product + self.bias[...][None, None, None]


def winograd(
    x: Float[Array, "batch height width inputs"],
    kernel: Float[Array, "3 3 inputs outputs"],
    dilation: int,
    precision: str,
) -> Float[Array, "batch height width outputs"]:
    """Convolve a map, zeros outside."""
    batch, height, width, channels = x.shape
    tiles = -(-height // (4 * dilation))
    below = dilation * (4 * tiles + 3) - height
    x = jnp.pad(x, ((0, 0), (dilation, below), (0, 0), (0, 0)))
    x = x.reshape(batch, tiles + 1, 4, dilation, width, channels)  # row = 4 d tile + d place + phase
    rows = [x[:, :-1, place] for place in range(4)] + [x[:, 1:, place] for place in range(2)]
    products = [
        _convolve(evaluated.reshape(batch, -1, width, channels), column[None], 0, dilation, precision)
        for evaluated, column in zip(_combine(_INPUT, rows), _combine(_KERNEL, list(kernel)), strict=True)
    ]
    result = _combine(_OUTPUT, [product.reshape(batch, tiles, dilation, width, -1) for product in products])
    return jnp.stack(result, axis=2).reshape(batch, 4 * tiles * dilation, width, -1)[:, :height]


def _convolve(x: Array, kernel: Array, above: int, dilation: int, precision: str) -> Array:
    return lax.conv_general_dilated(
        x,
        kernel,
        window_strides=(1, 1),
        padding=((above, above), (dilation, dilation)),
        rhs_dilation=(dilation, dilation),
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
        precision=precision,
    )


def _combine(matrix: Sequence[Sequence[float]], parts: Sequence[Array]) -> list[Array]:
    """Product of a matrix and the column of parts."""
    products = [[weight * part for weight, part in zip(row, parts, strict=True) if weight] for row in matrix]
    return [sum(terms[1:], start=terms[0]) for terms in products]
