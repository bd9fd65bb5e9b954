"""The grid of histograms as NumPy's users would write it, in processes of its own; imports nothing slow."""

import multiprocessing
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from importlib.util import find_spec

import numpy as np


class Workers:
    """Processes that score some of the pairs each; every one with a single thread."""

    def __init__(self, count: int) -> None:
        self.count = count
        # Their BLAS reads it when it is loaded, which here was long ago.
        os.environ["OPENBLAS_NUM_THREADS"] = os.environ["MKL_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"
        context = multiprocessing.get_context("spawn")
        self._pool = ProcessPoolExecutor(count, mp_context=context, initializer=flush_denormals)

    def __call__(
        self, shifts: np.ndarray, weights: np.ndarray, sigmas: Sequence[float], bin_sizes: Sequence[float], reach: float
    ) -> np.ndarray:
        """`tallest_bins`, each process a part of the pairs."""
        parts = np.array_split(np.arange(len(shifts)), self.count)
        jobs = [
            self._pool.submit(tallest_bins, shifts[part], weights[part], sigmas, bin_sizes, reach) for part in parts
        ]
        return np.concatenate([job.result() for job in jobs], axis=-1)


def flush_denormals() -> bool:
    """Whether this thread's denormal floats now count as zero, as in XLA's; NumPy itself has no such switch."""
    if find_spec("torch") is None:
        return False
    import torch

    return torch.set_flush_denormal(True)


def tallest_bins(
    shifts: np.ndarray, weights: np.ndarray, sigmas: Sequence[float], bin_sizes: Sequence[float], reach: float
) -> np.ndarray:
    """Scores `[sigmas, bin sizes, W, C]`, one pair and setting after the other.

    The Gaussians are separable, and the same for all weights, which are one matrix product.

    Args:
        shifts: `[C, K, 2]` px.
        weights: `[C, W, K]`.
        sigmas: px.
        bin_sizes: px.
        reach: bins cover [-reach, reach] px.
    """
    num_pairs, num_weights, slots = weights.shape
    found = np.empty((len(sigmas), len(bin_sizes), num_weights, num_pairs), np.float32)
    for j, size in enumerate(bin_sizes):
        centers = np.arange(-reach + size / 2, reach + size / 2, size, dtype=np.float32)
        x, y = (np.square(centers[:, None] - shifts[:, None, :, axis]) for axis in (0, 1))  # [C, B, K]
        for i, sigma in enumerate(sigmas):
            scale = np.float32(-0.5 / sigma**2)
            for pair in range(num_pairs):
                votes_x, votes_y = np.exp(x[pair] * scale), np.exp(y[pair] * scale)
                weighted = (weights[pair][:, None] * votes_y[None]).reshape(-1, slots)
                found[i, j, :, pair] = (weighted @ votes_x.T).reshape(num_weights, -1).max(1)
    return found
