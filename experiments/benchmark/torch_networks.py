"""Networks in plain torch, with the keys of the published weights; ALIKED has a module of its own.

A network is a function of its weights and of RGB images `[B, 3, H, W]`, 0 .. 255. Results are on the host.
"""

import re
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from mfvpr.checkpoints.conversion import Table
from mfvpr.networks.imagenet import DEVIATION, MEAN

Weights = Callable[[str], Tensor]  # published key -> weight


def torch_weights(arrays: Mapping[str, np.ndarray], table: Table, device: str, layout: torch.memory_format) -> Weights:
    """Convert arrays of mfvpr back to torch's, by their published keys."""

    @cache
    def weight(key: str) -> Tensor:
        rule, match = next((rule, match) for rule in table.rules if (match := re.fullmatch(rule.source, key)))
        array, axes = arrays[match.expand(rule.target)], rule.layout.value.axes
        tensor = torch.from_numpy(np.array(array if axes is None else array.transpose(np.argsort(axes)))).to(device)
        return tensor.contiguous(memory_format=layout) if tensor.ndim == 4 else tensor

    return weight


def run_network(
    network: Callable, batches: Iterable[np.ndarray], *, weights: Weights, device: str, layout: torch.memory_format
) -> list[Any]:
    """Results of a network for each image of RGB batches `[B, H, W, 3]` uint8."""
    results = []
    with torch.inference_mode():
        for batch in batches:
            images = torch.from_numpy(batch).to(device).permute(0, 3, 1, 2).contiguous(memory_format=layout)
            results.extend(network(weights, images))
    if device == "cuda":
        torch.cuda.synchronize()
    return results


class LocalFeatures(NamedTuple):
    """Features of one image."""

    keypoints: np.ndarray  # [n, 2] (x, y), px
    descriptors: np.ndarray  # [n, D]
    scores: np.ndarray  # [n]


def to_host(*tensors: Tensor) -> LocalFeatures:
    """Copy keypoints, descriptors and scores of an image to the host."""
    return LocalFeatures(*(tensor.cpu().numpy() for tensor in tensors))


def conv(w: Weights, name: str, x: Tensor, *, bias: bool = False, **options: int) -> Tensor:
    """Convolution by name."""
    return F.conv2d(x, w(f"{name}.weight"), w(f"{name}.bias") if bias else None, **options)


def batch_norm(w: Weights, name: str, x: Tensor) -> Tensor:
    """Batch normalization by name, with the running statistics."""
    mean, variance, weight, bias = (w(f"{name}.{key}") for key in ("running_mean", "running_var", "weight", "bias"))
    return F.batch_norm(x, mean, variance, weight, bias)


def sample(x: Tensor, points: Tensor) -> Tensor:
    """Maps `[B, C, H, W]` at points `[B, h, w, 2]` (x, y) px, zeros outside -> `[B, C, h, w]`."""
    height, width = x.shape[2:]
    grid = 2 * points / torch.tensor([width - 1, height - 1], device=x.device) - 1
    return F.grid_sample(x, grid, align_corners=True)


def linear(w: Weights, name: str, x: Tensor) -> Tensor:
    """Linear layer by name."""
    return F.linear(x, w(f"{name}.weight"), w(f"{name}.bias"))


_BGR_MEAN = (103.939, 116.779, 123.68)
_EDGE = (5 + 1) ** 2 / 5


def d2net_map(w: Weights, images: Tensor) -> Tensor:
    """Dense maps `[B, 512, h, w]`: VGG16 to conv4_3 with stride 4; the mean is subtracted in float64, as published."""
    mean = torch.tensor(_BGR_MEAN, dtype=torch.float64, device=images.device)
    x = (images.flip(1) - mean[:, None, None]).float()
    for position in (0, 2, 5, 7, 10, 12, 14, 17, 19, 21):  # of the convolutions
        if position in (5, 10):
            x = F.max_pool2d(x, 2)
        elif position == 17:  # dilation replaces the stride from here on
            x = F.avg_pool2d(x, 2, stride=1)
        reach = 2 if position >= 17 else 1
        name = f"dense_feature_extraction.model.{position}"
        x = F.relu(conv(w, name, x, bias=True, padding=reach, dilation=reach), inplace=True)
    return x


def d2net(w: Weights, images: Tensor) -> list[LocalFeatures]:
    """Features at the maxima of the dense map over channels and neighborhoods."""
    dense = d2net_map(w, images)
    di, dj, dii, djj, dij = _derivatives(dense)
    det, trace = dii * djj - dij * dij, dii + djj
    strongest = dense == dense.amax(1, keepdim=True)
    highest = dense == F.max_pool2d(dense, 3, stride=1, padding=1)
    detected = strongest & highest & (det > 0) & (trace * trace / det <= _EDGE)
    steps = torch.stack([(dij * dj - djj * di) / det, (dij * di - dii * dj) / det], -1)
    return [_local_features(*image) for image in zip(dense, detected, steps, strict=True)]


def _derivatives(dense: Tensor) -> tuple[Tensor, ...]:
    """Derivatives di, dj, dii, djj, dij of maps, zeros outside; shifted maps are faster than convolutions."""
    wide = F.pad(dense, (1, 1, 1, 1))
    up, down, left, right = wide[..., :-2, 1:-1], wide[..., 2:, 1:-1], wide[..., 1:-1, :-2], wide[..., 1:-1, 2:]
    corners = wide[..., 2:, 2:] - wide[..., 2:, :-2] - wide[..., :-2, 2:] + wide[..., :-2, :-2]
    return (down - up) / 2, (right - left) / 2, up - 2 * dense + down, left - 2 * dense + right, corners / 4


def _local_features(dense: Tensor, detected: Tensor, steps: Tensor) -> LocalFeatures:
    """Refine the positions of one map `[C, h, w]`, and interpolate its descriptors there."""
    channel, row, column = detected.nonzero(as_tuple=True)
    step = steps[channel, row, column]
    position = torch.stack([row, column], 1) + step
    last = torch.tensor(dense.shape[1:], device=dense.device) - 1
    inside = ((step.abs() < 0.5) & (position >= 0) & (position <= last)).all(1)
    position, scores = position[inside].flip(1), dense[channel, row, column][inside]
    descriptors = sample(dense[None], position[None, None])[0, :, 0]
    return to_host(4 * position + 1.5, F.normalize(descriptors, dim=0).T, scores)


def mixvpr(w: Weights, images: Tensor) -> np.ndarray:
    """Unit descriptors `[B, D]`: four mixers over the positions, two projections."""
    layers = tuple(f"backbone.model.layer{place}" for place in (1, 2, 3))
    x = resnet(w, images, "backbone.model.conv1", "backbone.model.bn1", layers).flatten(2)  # [B, 1024, positions]
    for place in range(4):
        name = f"aggregator.mix.{place}.mix"
        normal = F.layer_norm(x, x.shape[2:], w(f"{name}.0.weight"), w(f"{name}.0.bias"))
        x = x + linear(w, f"{name}.3", F.relu(linear(w, f"{name}.1", normal)))
    x = linear(w, "aggregator.channel_proj", x.transpose(1, 2)).transpose(1, 2)
    return F.normalize(linear(w, "aggregator.row_proj", x).flatten(1)).cpu().numpy()


def normalize(images: Tensor) -> Tensor:
    """Normalize images as networks trained on ImageNet expect them."""
    mean, deviation = (torch.tensor(values, device=images.device)[:, None, None] for values in (MEAN, DEVIATION))
    return (images / 255 - mean) / deviation


_BLOCKS = (3, 4, 6)  # of ResNet-50's first layers


def resnet(w: Weights, images: Tensor, first: str, norm: str, layers: tuple[str, ...]) -> Tensor:
    """Maps `[B, C, h, w]` of ResNet-50 after the last of the named layers."""
    x = conv(w, first, normalize(images), stride=2, padding=3)
    x = F.max_pool2d(F.relu(batch_norm(w, norm, x), inplace=True), 3, stride=2, padding=1)
    for place, (layer, blocks) in enumerate(zip(layers, _BLOCKS, strict=False)):
        for block in range(blocks):
            stride = 2 if place and block == 0 else 1
            x = _bottleneck(w, f"{layer}.{block}", x, stride, shortcut=block == 0)
    return x


def _bottleneck(w: Weights, name: str, x: Tensor, stride: int, shortcut: bool) -> Tensor:
    out = F.relu(batch_norm(w, f"{name}.bn1", conv(w, f"{name}.conv1", x)), inplace=True)
    out = conv(w, f"{name}.conv2", out, stride=stride, padding=1)
    out = F.relu(batch_norm(w, f"{name}.bn2", out), inplace=True)
    out = batch_norm(w, f"{name}.bn3", conv(w, f"{name}.conv3", out))
    if shortcut:
        x = batch_norm(w, f"{name}.downsample.1", conv(w, f"{name}.downsample.0", x, stride=stride))
    return F.relu(out.add_(x), inplace=True)
