"""Inputs and outputs of networks: images as for networks trained on ImageNet, and vectors of unit length."""

from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Num

from mfvpr.core.types import Array

Preprocessing = Literal["caffe", "torch"]

MEAN = (0.485, 0.456, 0.406)  # of the training images, RGB in 0 .. 1
DEVIATION = (0.229, 0.224, 0.225)
EPSILON = 1e-12  # least divisor of vectors, as in the public codes
Pixels = Num[Array, "batch height width 3"]  # RGB, 0 .. 255, uint8 or float32
Images = Float[Array, "batch height width 3"]  # inputs of networks


def preprocess(images: Pixels, preprocessing: Preprocessing = "torch") -> Images:
    """RGB images from 0 to 255 -> inputs of the network, float32.

    "caffe" is BGR minus the mean. "torch" is RGB in [0, 1], minus the mean, divided by the standard deviation. Results
    for bytes are rounded once.
    """
    ordered = images[..., ::-1] if preprocessing == "caffe" else images
    if images.dtype == jnp.uint8:
        table = jnp.asarray(_TABLES[preprocessing])
        return jnp.stack([table[channel][ordered[..., channel]] for channel in range(3)], axis=-1)
    scale, mean, deviation = (jnp.asarray(values, jnp.float32) for values in _STATISTICS[preprocessing])
    return (ordered / scale - mean[None, None, None]) / deviation[None, None, None]


# Scale, mean and deviation, in the network's order of the channels.
_STATISTICS = {
    "caffe": (1.0, np.array([103.939, 116.779, 123.68]), np.ones(3)),
    "torch": (255.0, np.array(MEAN), np.array(DEVIATION)),
}


def _table(scale: float, mean: Float[np.ndarray, "3"], deviation: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 256"]:
    """Results for all bytes, computed in float64 as in D2-Net's code; a device has no float64."""
    byte = np.arange(256, dtype=np.float32) / np.float32(scale)
    return ((byte[None] - mean[:, None]) / deviation[:, None]).astype(np.float32)


_TABLES = {name: _table(*statistics) for name, statistics in _STATISTICS.items()}


def of_unit_length(vectors: Float[Array, "*batch dimensions"]) -> Float[Array, "*batch dimensions"]:
    """Vectors divided by their lengths."""
    return vectors / jnp.maximum(jnp.linalg.norm(vectors, axis=-1, keepdims=True), EPSILON)
