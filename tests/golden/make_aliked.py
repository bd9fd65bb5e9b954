"""Makes aliked.npz: what the public code finds. `python -m tests.golden aliked CLONE WEIGHTS IMAGES`

CLONE is a clone of https://github.com/Shiaoming/ALIKED, WEIGHTS the folder of its files, IMAGES that of grief_season.
What the public code uses of torchvision and of its own compiled operator is written out here.
"""

import sys
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


def _deformable(input, offset, weight, bias=None, padding=None, mask=None):
    """torchvision's `deform_conv2d`, 3 x 3 with stride 1 and one pixel of padding."""
    import torch

    batch, channels, height, width = input.shape
    offset = offset.unflatten(1, (9, 2))
    tap = torch.arange(9).view(1, 9, 1, 1)
    y = torch.arange(height).view(1, 1, -1, 1) + tap // 3 - 1 + offset[:, :, 0]
    x = torch.arange(width).view(1, 1, 1, -1) + tap % 3 - 1 + offset[:, :, 1]
    sampled = torch.zeros(batch, channels, 9 * height * width)
    for row in (y.floor(), y.floor() + 1):
        for column in (x.floor(), x.floor() + 1):
            inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
            share = (1 - (y - row).abs()) * (1 - (x - column).abs()) * inside
            place = row.clamp(0, height - 1) * width + column.clamp(0, width - 1)
            place = place.long().flatten(1)[:, None].expand(-1, channels, -1)
            sampled += input.flatten(2).gather(2, place) * share.flatten(1)[:, None]
    taps = sampled.unflatten(2, (9, -1)).flatten(1, 2)
    return (weight.flatten(1) @ taps).unflatten(2, (height, width))


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


def _stubs() -> None:
    """Makes importable what the public code imports."""
    import torch
    from torch import nn

    def conv(inputs: int, outputs: int, size: int) -> nn.Module:
        return nn.Conv2d(inputs, outputs, size, padding=size // 2, bias=False)

    convs = {"conv1x1": lambda *widths: conv(*widths, 1), "conv3x3": lambda *widths: conv(*widths, 3)}
    models = replace_module("torchvision.models", resnet=replace_module("torchvision.models.resnet", **convs))
    operators = replace_module("torchvision.ops", deform_conv2d=_deformable)
    replace_module("torchvision", ops=operators, models=models)
    to_tensor = lambda image: torch.from_numpy(image.copy()).permute(2, 0, 1) / 255  # noqa: E731
    replace_module("torchvision.transforms", ToTensor=lambda: to_tensor)
    replace_module("custom_ops", get_patches=_Patches)
    torch.cuda.synchronize = lambda *_: None


def main(clone: str, weights: str, images: str) -> dict[str, np.ndarray]:
    sys.path.insert(0, clone)
    _stubs()
    import torch
    from nets.aliked import ALIKED

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
        print(f"{case}: {len(result['scores'])} keypoints")
    return golden
