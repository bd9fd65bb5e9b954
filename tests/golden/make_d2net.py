"""Makes d2net.npz: what the public code finds with random weights. `python -m tests.golden d2net CLONE`

CLONE is a clone of https://github.com/mihaidusmanu/d2-net.
"""

from typing import NamedTuple

import numpy as np

from tests.golden.torch_networks import fill
from tests.random_checkpoints import d2net_shapes, random_checkpoint

SAMPLES = 1000


class Case(NamedTuple):
    """An image and its processing."""

    width: int
    height: int
    preprocessing: str
    multiscale: bool
    plain: int = 0  # rows from the top that are of one gray
    gray: int = 255

    def __str__(self) -> str:
        plain = f"-{self.plain}_rows_of_{self.gray}" if self.plain else ""
        return f"{self.width}x{self.height}-{self.preprocessing}{'-multiscale' if self.multiscale else ''}{plain}"

    @property
    def image(self) -> np.ndarray:
        """`[height, width, 3]` uint8."""
        image = texture(self.width, self.height)
        image[: self.plain] = self.gray
        return image


CASES = (
    Case(336, 336, "caffe", False),
    Case(320, 320, "caffe", False),
    Case(224, 224, "torch", False),
    Case(256, 192, "caffe", False),
    Case(250, 187, "caffe", False),
    Case(210, 154, "caffe", True),
)
# Of one size. What sees nothing but one gray has no keypoints; where texture or border comes into view, there are some.
PLAIN = (
    Case(337, 251, "caffe", False, plain=140),
    *(Case(337, 251, "caffe", False, plain=251, gray=gray) for gray in (0, 128, 255)),
)


def texture(width: int, height: int, seed: int = 0) -> np.ndarray:
    """`[height, width, 3]` uint8: blobs of four sizes, by integer arithmetic alone."""
    rows, columns = np.arange(height), np.arange(width)
    total = np.zeros((height, width, 3), np.int64)
    for cell, weight in ((3, 2), (6, 3), (12, 3), (24, 2)):
        corners = _noise(height // cell + 2, width // cell + 2, seed + cell)
        down, right = (rows % cell)[:, None, None], (columns % cell)[None, :, None]
        lines = corners[rows // cell] * (cell - down) + corners[rows // cell + 1] * down
        blobs = lines[:, columns // cell] * (cell - right) + lines[:, columns // cell + 1] * right
        total += weight * blobs // cell**2
    return np.clip(total // 5 - 128, 0, 255).astype(np.uint8)  # twice the contrast


def _noise(height: int, width: int, seed: int) -> np.ndarray:
    """`[height, width, 3]` integers from 0 to 255, a hash of their places."""
    row, column, channel = np.indices((height, width, 3), np.uint32)
    mixed = row * np.uint32(374761393) + column * np.uint32(668265263) + channel * np.uint32(2246822519)
    mixed = (mixed + np.uint32(seed)) * np.uint32(3266489917)
    mixed = (mixed ^ (mixed >> np.uint32(15))) * np.uint32(1274126177)
    return (mixed >> np.uint32(16) & np.uint32(255)).astype(np.int64)


def samples(dense: np.ndarray) -> np.ndarray:
    """Values at `SAMPLES` places of a dense map `[h, w, C]`, then the mean of each channel."""
    places = np.random.default_rng(0).choice(dense.size, SAMPLES, replace=False)
    return np.concatenate([dense.reshape(-1)[places], dense.mean((0, 1), np.float64)]).astype(np.float32)


def projections(descriptors: np.ndarray) -> np.ndarray:
    """`[N, 8]`: descriptors `[N, D]` along fixed random directions of unit length."""
    directions = np.random.default_rng(0).standard_normal((descriptors.shape[1], 8))
    return (descriptors @ (directions / np.linalg.norm(directions, axis=0))).astype(np.float32)


def main(_: str) -> dict[str, np.ndarray]:
    import torch
    from lib.model_test import D2Net
    from lib.pyramid import process_multiscale
    from lib.utils import preprocess_image

    network = fill(D2Net(use_cuda=False), random_checkpoint(d2net_shapes()))
    golden = {}
    for case in CASES + PLAIN:
        image = preprocess_image(case.image, case.preprocessing).astype(np.float32)
        with torch.no_grad():
            batch = torch.from_numpy(image[None])
            scales = [0.5, 1, 2] if case.multiscale else [1]
            dense = network.dense_feature_extraction(batch)[0].numpy().transpose(1, 2, 0)
            keypoints, scores, descriptors = process_multiscale(batch, network, scales)
        golden |= {
            f"{case}/dense": samples(dense),
            f"{case}/keypoints": keypoints[:, [1, 0]],  # (row, column, scale) -> (x, y)
            f"{case}/scores": scores,
            f"{case}/projections": projections(descriptors),
        }
    return golden
