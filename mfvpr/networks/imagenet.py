"""Images as inputs of networks that were trained on ImageNet."""

from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Num

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
