"""Makes ssm_maps.npz: SSM-VPR's maps with random weights. `python -m tests.golden ssm_maps CLONE`

CLONE is a clone of https://github.com/Chicone/SSM-VPR, whose network is run in float64, so that the file holds no
rounding errors but its own.
"""

from typing import NamedTuple

import numpy as np

from mfvpr.networks.layers import DEVIATION, MEAN
from tests.golden.make_d2net import samples, texture
from tests.random_checkpoints import layered, places365_shapes, random_checkpoint

SEEDS = (0, 1, 2)


class Case(NamedTuple):
    """An image, the seed of the weights, and the stages that look at it."""

    seed: int
    width: int
    height: int
    stages: tuple[int, ...]

    def __str__(self) -> str:
        return f"{self.seed}-{self.width}x{self.height}"

    @property
    def image(self) -> np.ndarray:
        """`[height, width, 3]` uint8."""
        return texture(self.width, self.height, self.seed)


CASES = (
    *(Case(seed, 224, 224, (1, 2)) for seed in SEEDS),
    *(Case(seed, 336, 336, (2,)) for seed in SEEDS),
    Case(0, 151, 229, (1, 2)),  # odd before each pooling but the third
)


def checkpoint(seed: int) -> dict[str, np.ndarray]:
    """The tensors that the maps need, by the names of the public file."""
    return random_checkpoint(places365_shapes(full=False), seed)


def main(_: str) -> dict[str, np.ndarray]:
    import torch
    import vgg16_model

    unused = {name: np.zeros(shape, np.float32) for name, shape in places365_shapes().items()}
    golden = {}
    for case in CASES:
        weights = unused | checkpoint(case.seed)
        vgg16_model.load_weights = lambda _, weights=weights: layered(weights)
        network = vgg16_model.VGG16Model("").double().eval()
        pixels = (case.image / 255 - np.array(MEAN)) / np.array(DEVIATION)
        batch = torch.from_numpy(pixels.transpose(2, 0, 1)[None])
        for stage in case.stages:
            with torch.inference_mode():
                dense = (network.forward1 if stage == 1 else network.forward2)(batch)[0].numpy().transpose(1, 2, 0)
            golden |= {
                f"{case}/stage{stage}": samples(dense),
                f"{case}/stage{stage}/largest": np.float32(np.abs(dense).max()),
                f"{case}/stage{stage}/shape": np.array(dense.shape),
            }
    return golden
