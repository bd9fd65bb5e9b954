"""Pixels as the networks take them."""

import numpy as np
import pytest

from mfvpr.networks.imagenet import preprocess


@pytest.mark.optimized
def test_bytes_are_preprocessed_to_the_last_bit():
    byte = np.arange(256, dtype=np.uint8)
    image = np.stack([byte, byte[::-1], np.roll(byte, 7)], axis=-1)[None, None]
    mean = np.array([103.939, 116.779, 123.68])  # blue comes first
    expected = (image[..., ::-1].astype(np.float32) - mean).astype(np.float32)
    np.testing.assert_array_equal(preprocess(image, "caffe"), expected)
    np.testing.assert_allclose(preprocess(image.astype(np.float32), "caffe"), expected, atol=1e-5)
    mean, deviation = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
    expected = ((image.astype(np.float32) / np.float32(255) - mean) / deviation).astype(np.float32)
    np.testing.assert_array_equal(preprocess(image, "torch"), expected)
    np.testing.assert_allclose(preprocess(image.astype(np.float32), "torch"), expected, atol=1e-5)
