"""Makes aliked.npz: what the public code finds. `python -m tests.golden aliked CLONE WEIGHTS IMAGES`

CLONE is a clone of https://github.com/Shiaoming/ALIKED, WEIGHTS the folder of its files, IMAGES that of grief_season.
It needs torchvision; its own compiled operator is written out here.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from mfvpr.checkpoints.checkpoint import read_checkpoint
from mfvpr.datasets import read_image, resize
from tests.golden.make_d2net import projections, samples, texture
from tests.golden.torch_networks import fill, replace_module
from tests.random_checkpoints import aliked_shapes, random_checkpoint


class Case(NamedTuple):
    """A network, an image below IMAGES, and how it is processed; without an image, texture and random weights."""

    variant: str
    width: int
    height: int
    image: str | None
    threshold: float = 0.1
    max_keypoints: int = 5000

    def __str__(self) -> str:
        image = self.image.replace("/", "-").removesuffix(".jpg") if self.image else "texture"
        return f"{self.variant}-{self.width}x{self.height}-{image}-{self.threshold}-{self.max_keypoints}"


REAL = (
    Case("aliked-n16", 320, 320, "database/image0000.jpg"),
    Case("aliked-n16rot", 320, 320, "queries/image0033.jpg"),
    Case("aliked-n16", 336, 336, "queries/image0066.jpg"),
    Case("aliked-n16rot", 336, 336, "database/image0099.jpg"),
    Case("aliked-n32", 224, 224, "database/image0050.jpg", 0.1, 300),
    Case("aliked-n32", 224, 224, "queries/image0050.jpg", 0.99, 300),  # none is above: the mean, and too many
    Case("aliked-t16", 300, 200, "queries/image0012.jpg"),
    Case("aliked-t16", 300, 200, "database/image0012.jpg"),
)
DRAWN = Case("aliked-t16", 300, 200, None, 0.99)


def checkpoint(case: Case, weights: Path) -> dict[str, np.ndarray]:
    """The case's weights, by the public names."""
    return read_checkpoint(weights / f"{case.variant}.pth") if case.image else random_checkpoint(aliked_shapes())


def picture(case: Case, images: Path) -> np.ndarray:
    """The case's image, `[height, width, 3]` uint8."""
    if case.image is None:
        return texture(case.width, case.height)
    return resize(read_image(images / case.image), (case.width, case.height))


class _Patches:
    """The compiled operator: neighborhoods of pixels, zeros outside."""

    @staticmethod
    def apply(features, points, size):
        import torch
        import torch.nn.functional as F

        reach = torch.arange(size)
        padded = F.pad(features, (size // 2,) * 4)
        rows, columns = points[:, 1, None] + reach, points[:, 0, None] + reach
        return padded[:, rows[:, :, None], columns[:, None]].transpose(0, 1)


def main(_: str, weights: str, images: str) -> dict[str, np.ndarray]:
    replace_module("custom_ops", get_patches=_Patches)
    import torch
    from nets.aliked import ALIKED

    torch.cuda.synchronize = lambda *_: None

    golden = {}
    for case in (*REAL, DRAWN):
        network = ALIKED(
            case.variant, "cpu", scores_th=case.threshold, n_limit=case.max_keypoints, load_pretrained=False
        )
        fill(network, checkpoint(case, Path(weights)))
        image = picture(case, Path(images))
        result = network.run(image)
        with torch.no_grad():
            dense, _ = network.extract_dense_map(torch.from_numpy(image.copy()).permute(2, 0, 1)[None] / 255)
        golden |= {
            f"{case}/features": samples(dense[0].permute(1, 2, 0).numpy()),
            f"{case}/score_map": samples(result["score_map"][..., None]),
            f"{case}/keypoints": result["keypoints"],
            f"{case}/scores": result["scores"],
            f"{case}/projections": projections(result["descriptors"]),
        }
    return golden
