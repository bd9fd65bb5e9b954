"""D2-Net and MixVPR in plain torch, with the keys of the published weights: what mfvpr's are timed against."""

from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mfvpr.models.imagenet import DEVIATION, MEAN


class LocalFeatures(NamedTuple):
    """Of one image, on the host."""

    keypoints: np.ndarray  # [n, 2] (x, y), px
    descriptors: np.ndarray  # [n, D]
    scores: np.ndarray  # [n]


def on_host(*tensors: Tensor) -> LocalFeatures:
    """Keypoints, descriptors and scores as arrays."""
    return LocalFeatures(*(tensor.cpu().numpy() for tensor in tensors))


class D2Net(nn.Module):
    """VGG16 to conv4_3 with stride 4, then the maxima of its map over channels and neighborhoods."""

    _MEAN = (103.939, 116.779, 123.68)  # BGR
    _EDGE = (5 + 1) ** 2 / 5

    def __init__(self) -> None:
        super().__init__()
        self.dense_feature_extraction = nn.ModuleDict({"model": nn.Sequential(*_vgg_layers())})
        slope, curve, here = torch.tensor([[-0.5, 0, 0.5], [1, -2, 1], [0, 1, 0]])
        factors = (slope, here), (here, slope), (curve, here), (here, curve), (slope, slope)  # di, dj, dii, djj, dij
        taps = torch.stack([torch.outer(down, right) for down, right in factors])
        self.register_buffer("_taps", taps[:, None], persistent=False)

    def prepared(self, images: Tensor) -> Tensor:
        """`[B, H, W, 3]` uint8 RGB -> what the network takes; the mean is subtracted in float64, as published."""
        mean = torch.tensor(self._MEAN, dtype=torch.float64, device=images.device)
        return (images.flip(-1) - mean).float().permute(0, 3, 1, 2)

    def forward(self, images: Tensor) -> Tensor:
        """Dense maps `[B, 512, h, w]`."""
        return F.relu(self.dense_feature_extraction["model"](images))

    def extract(self, images: Tensor) -> list[LocalFeatures]:
        """Keypoints with their descriptors, from images as `prepared` makes them."""
        dense = self(images).contiguous()
        di, dj, dii, djj, dij = (_derivative(dense, taps) for taps in self.get_buffer("_taps").split(1))
        det, trace = dii * djj - dij * dij, dii + djj
        strongest = dense == dense.amax(1, keepdim=True)
        highest = dense == F.max_pool2d(dense, 3, stride=1, padding=1)
        detected = strongest & highest & (det > 0) & (trace * trace / det <= self._EDGE)
        steps = torch.stack([(dij * dj - djj * di) / det, (dij * di - dii * dj) / det], -1)
        return [_described(*image) for image in zip(dense, detected, steps, strict=True)]


def _vgg_layers() -> list[nn.Module]:
    layers: list[nn.Module] = []
    inputs = 3
    for block, widths in enumerate(((64, 64), (128, 128), (256, 256, 256), (512, 512, 512)), start=1):
        dilation = 2 if block == 4 else 1
        for width in widths:
            layers += [nn.Conv2d(inputs, width, 3, padding=dilation, dilation=dilation), nn.ReLU(inplace=True)]
            inputs = width
        layers.append(nn.AvgPool2d(2, stride=1) if block == 3 else nn.MaxPool2d(2))
    return layers[:-2]  # ends with conv4_3


def _derivative(dense: Tensor, taps: Tensor) -> Tensor:
    """Of every channel `[B, C, h, w]` by itself, zeros outside."""
    return F.conv2d(dense.flatten(0, 1)[:, None], taps, padding=1).reshape(dense.shape)


def _described(dense: Tensor, detected: Tensor, steps: Tensor) -> LocalFeatures:
    """Features of one map `[C, h, w]`: refined positions, and the map interpolated there."""
    channel, row, column = detected.nonzero(as_tuple=True)
    step = steps[channel, row, column]
    position = torch.stack([row, column], 1) + step
    size = torch.tensor(dense.shape[1:], device=dense.device)
    low, high = position.floor().long(), position.ceil().long()
    kept = (step.abs() < 0.5).all(1) & (low >= 0).all(1) & (high < size).all(1)
    scores = dense[channel, row, column][kept]
    position, (top, left), (bottom, right) = position[kept], low[kept].T, high[kept].T
    below, beside = (position - low[kept]).T
    descriptors = (
        dense[:, top, left] * ((1 - below) * (1 - beside))
        + dense[:, top, right] * ((1 - below) * beside)
        + dense[:, bottom, left] * (below * (1 - beside))
        + dense[:, bottom, right] * (below * beside)
    )
    return on_host((4 * position + 1.5).flip(1), F.normalize(descriptors, dim=0).T, scores)


class MixVPR(nn.Module):
    """ResNet-50 to its third layer, four mixers over the positions, two projections."""

    def __init__(self, out_channels: int = 1024, out_rows: int = 4) -> None:
        super().__init__()
        positions = (320 // 16) ** 2
        self.backbone = nn.ModuleDict({"model": _ResNet()})
        self.aggregator = nn.ModuleDict(
            {
                "mix": nn.Sequential(*(_Mixer(positions) for _ in range(4))),
                "channel_proj": nn.Linear(1024, out_channels),
                "row_proj": nn.Linear(positions, out_rows),
            }
        )

    def prepared(self, images: Tensor) -> Tensor:
        """`[B, H, W, 3]` uint8 RGB -> what the network takes."""
        mean, deviation = (torch.tensor(values, device=images.device) for values in (MEAN, DEVIATION))
        return ((images / 255 - mean) / deviation).permute(0, 3, 1, 2)

    def forward(self, images: Tensor) -> Tensor:
        """Descriptors `[B, D]` of unit length."""
        mixed = self.aggregator["mix"](self.backbone["model"](images).flatten(2))  # [B, 1024, positions]
        projected = self.aggregator["channel_proj"](mixed.transpose(1, 2)).transpose(1, 2)
        return F.normalize(self.aggregator["row_proj"](projected).flatten(1))

    def describe(self, images: Tensor) -> np.ndarray:
        """`forward` on the host."""
        return self(images).cpu().numpy()


class _Mixer(nn.Module):
    def __init__(self, size: int) -> None:
        super().__init__()
        self.mix = nn.Sequential(nn.LayerNorm(size), nn.Linear(size, size), nn.ReLU(), nn.Linear(size, size))

    def forward(self, x: Tensor) -> Tensor:
        return x + self.mix(x)


class _ResNet(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.conv1, self.bn1 = nn.Conv2d(3, 64, 7, stride=2, padding=3, bias=False), nn.BatchNorm2d(64)
        self.layer1 = _layer(3, 64, 64, stride=1)
        self.layer2 = _layer(4, 256, 128, stride=2)
        self.layer3 = _layer(6, 512, 256, stride=2)

    def forward(self, x: Tensor) -> Tensor:
        x = F.max_pool2d(F.relu(self.bn1(self.conv1(x)), inplace=True), 3, stride=2, padding=1)
        return self.layer3(self.layer2(self.layer1(x)))


def _layer(blocks: int, inputs: int, width: int, stride: int) -> nn.Sequential:
    others = (_Bottleneck(4 * width, width, 1) for _ in range(blocks - 1))
    return nn.Sequential(_Bottleneck(inputs, width, stride, shortcut=True), *others)


class _Bottleneck(nn.Module):
    def __init__(self, inputs: int, width: int, stride: int, shortcut: bool = False) -> None:
        super().__init__()
        self.conv1, self.bn1 = nn.Conv2d(inputs, width, 1, bias=False), nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, stride=stride, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.conv3, self.bn3 = nn.Conv2d(width, 4 * width, 1, bias=False), nn.BatchNorm2d(4 * width)
        projection = nn.Conv2d(inputs, 4 * width, 1, stride=stride, bias=False)
        self.downsample = nn.Sequential(projection, nn.BatchNorm2d(4 * width)) if shortcut else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        out = F.relu(self.bn1(self.conv1(x)), inplace=True)
        out = F.relu(self.bn2(self.conv2(out)), inplace=True)
        return F.relu(self.bn3(self.conv3(out)).add_(self.downsample(x)), inplace=True)
