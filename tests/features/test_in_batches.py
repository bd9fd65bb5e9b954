"""Images of a network run two at a time on a CPU, with the results of one at a time."""

import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mfvpr.features import network

IMAGES = np.random.default_rng(0).integers(0, 256, (7, 6, 5, 3), np.uint8)


@pytest.fixture
def program():
    """Results: the sum of an image, and twice the image."""
    return jax.jit(lambda batch: (batch.astype(float).sum((1, 2, 3)), 2 * batch.astype(jnp.int32)))


@pytest.mark.parametrize("memory", [None, 1e9])
@pytest.mark.parametrize("count", [0, 1, 2, 7])
def test_results_stand_in_the_order_of_the_images(program, monkeypatch, memory, count):
    monkeypatch.setattr(network, "device_bytes", lambda _: memory)
    results = network.in_batches(program, IMAGES[:count], 4)
    assert len(results) == count
    for (total, doubled), image in zip(results, IMAGES, strict=False):
        assert total == image.sum()
        np.testing.assert_array_equal(doubled, 2 * image.astype(int))


def test_an_accelerator_takes_few_images_at_the_same_time(monkeypatch):
    monkeypatch.setattr(network, "device_bytes", lambda _: 1e9)
    sizes = []
    network.in_batches(lambda batch: sizes.append(len(batch)) or batch[:, 0, 0, 0], np.repeat(IMAGES, 3, axis=0), 32)
    assert sizes == [8, 8, 8]


def test_two_images_run_at_the_same_time():
    both = threading.Barrier(2, timeout=30)
    calls = []

    def program(batch):
        calls.append(batch)
        if len(calls) > 1:  # the first one compiles
            both.wait()
        return batch[:, 0, 0, 0]

    assert network.in_batches(program, IMAGES[:5], 8) == IMAGES[:5, 0, 0, 0].tolist()


def test_settings_of_the_caller_hold_for_all_images(program):
    with jax.enable_x64(True):
        assert [total.dtype for total, _ in network.in_batches(program, IMAGES, 8)] == [np.float64] * 7
