"""VGG16 and its convolutions, against float64 sums by definition."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from mfvpr.models.convolution import Conv3x3, winograd
from mfvpr.models.vgg import Vgg16


def convolved(x, kernel, dilation):
    """`[B, H, W, C]` with `[3, 3, C, D]`, zeros outside, in float64."""
    height, width = x.shape[1:3]
    padded = np.pad(x.astype(np.float64), ((0, 0), (dilation, dilation), (dilation, dilation), (0, 0)))
    result = 0
    for row in range(3):
        for column in range(3):
            down, right = row * dilation, column * dilation
            result = result + padded[:, down : down + height, right : right + width] @ kernel[row, column].astype(float)
    return result


@pytest.mark.parametrize("height, width, dilation, channels", [(1, 1, 2, 5), (8, 8, 1, 130), (9, 7, 2, 130)])
def test_convolutions_agree_with_their_definition(height, width, dilation, channels):
    rng = np.random.default_rng(height)
    x = rng.normal(size=(2, height, width, channels)).astype(np.float32)
    layer = Conv3x3(channels, 3, dilation=dilation, precision="highest", rngs=nnx.Rngs(0))
    layer.bias[...] = jnp.arange(3, dtype=jnp.float32)
    fast = jax.jit(lambda x, kernel: winograd(x, kernel, dilation, "highest"))(x, layer.kernel[...])
    expected = convolved(x, np.asarray(layer.kernel[...]), dilation)
    tolerance = 1e-5 * np.abs(expected).max()
    np.testing.assert_allclose(layer(x), expected + np.arange(3), atol=tolerance)
    np.testing.assert_allclose(fast, expected, atol=tolerance)


@pytest.mark.parametrize("last, shape", [("conv1_1", (37, 50, 64)), ("conv4_2", (4, 6, 512)), ("conv5_3", (2, 3, 512))])
def test_the_network_ends_where_it_is_told(last, shape):
    with jax.numpy_dtype_promotion("standard"):
        model = nnx.eval_shape(lambda: Vgg16(last, rngs=nnx.Rngs(0)))
    graph, state = nnx.split(model)
    image = jax.ShapeDtypeStruct((1, 37, 50, 3), jnp.float32)
    assert jax.eval_shape(lambda state, image: nnx.merge(graph, state)(image), state, image).shape == (1, *shape)
    assert last in nnx.to_pure_dict(state)
    assert len(nnx.to_pure_dict(state)) == len(model.layers)


@pytest.mark.parametrize("last, count", [("conv4_3", 7_635_264), ("conv5_2", 12_354_880), ("conv5_3", 14_714_688)])
def test_parameter_counts_are_the_published_ones(last, count):
    with jax.numpy_dtype_promotion("standard"):
        model = nnx.eval_shape(lambda: Vgg16(last, rngs=nnx.Rngs(0)))
    assert sum(leaf.size for leaf in jax.tree.leaves(nnx.state(model))) == count
