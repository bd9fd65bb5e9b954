"""Networks in plain torch, with the keys of the published weights.

A network is a function of its weights and of RGB images `[B, 3, H, W]`, 0 .. 255. Features and descriptors are on the
host. Deformable convolutions use `grid_sample`.
"""

from collections.abc import Callable, Iterable, Mapping
from functools import cache, partial
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from mfvpr.checkpoints.conversion import Table
from mfvpr.networks.layers import DEVIATION, MEAN

Weights = Callable[[str], Tensor]  # published key -> weight


def torch_weights(arrays: Mapping[str, np.ndarray], table: Table, device: str, layout: torch.memory_format) -> Weights:
    """Convert arrays of mfvpr back to torch's, by their published keys."""

    @cache
    def weight(key: str) -> Tensor:
        path = table.path_of(key, arrays)
        array = arrays[path]
        if axes := table.axes_of(path, array.ndim):
            array = array.transpose(np.argsort(axes))
        tensor = torch.from_numpy(np.array(array)).to(device)
        return tensor.contiguous(memory_format=layout) if tensor.ndim == 4 else tensor

    return weight


def run_network(
    network: Callable, batches: Iterable[np.ndarray], *, weights: Weights, device: str, layout: torch.memory_format
) -> list[Any]:
    """Results of a network for each image of RGB batches `[B, H, W, 3]` uint8."""
    results = []
    for batch in batches:
        images = torch.from_numpy(batch).to(device).permute(0, 3, 1, 2).contiguous(memory_format=layout)
        results.extend(network(weights, images))
    return results


def conv(w: Weights, name: str, x: Tensor, *, bias: bool = False, **options: int) -> Tensor:
    """Convolution by name."""
    weight = w(f"{name}.weight")
    weight = weight[..., None, None] if weight.ndim == 2 else weight  # a product of matrices in mfvpr
    return F.conv2d(x, weight, w(f"{name}.bias") if bias else None, **options)


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


def d2net_map(w: Weights, images: Tensor) -> Tensor:
    """Dense maps `[B, 512, h, w]`: VGG16 to conv4_3 with stride 4; the mean is subtracted in float64, as published."""
    mean = torch.tensor((103.939, 116.779, 123.68), dtype=torch.float64, device=images.device)
    x = (images.flip(1) - mean[:, None, None]).float()
    for position in (0, 2, 5, 7, 10, 12, 14, 17, 19, 21):  # of the convolutions
        x = F.relu(x, inplace=True) if position else x
        if position in (5, 10):
            x = F.max_pool2d(x, 2)
        elif position == 17:  # dilation replaces the stride of the last pooling
            x = F.avg_pool2d(x, 2, stride=1)
        reach = 2 if position >= 17 else 1
        x = conv(w, f"dense_feature_extraction.model.{position}", x, bias=True, padding=reach, dilation=reach)
    return F.relu(x, inplace=True)


def mixvpr(w: Weights, images: Tensor) -> np.ndarray:
    """Unit descriptors `[B, D]`: four mixers over the positions, two projections."""
    x = resnet(w, images).flatten(2)  # [B, 1024, positions]
    for place in range(4):
        name = f"aggregator.mix.{place}.mix"
        normal = F.layer_norm(x, x.shape[2:], w(f"{name}.0.weight"), w(f"{name}.0.bias"))
        x = x + linear(w, f"{name}.3", F.relu(linear(w, f"{name}.1", normal)))
    x = linear(w, "aggregator.channel_proj", x.transpose(1, 2)).transpose(1, 2)
    return F.normalize(linear(w, "aggregator.row_proj", x).flatten(1)).cpu().numpy()


def resnet(w: Weights, images: Tensor) -> Tensor:
    """Maps `[B, 1024, h, w]` of MixVPR's ResNet-50 after its third layer."""
    mean, deviation = (torch.tensor(values, device=images.device)[:, None, None] for values in (MEAN, DEVIATION))
    x = conv(w, "backbone.model.conv1", (images / 255 - mean) / deviation, stride=2, padding=3)
    x = F.max_pool2d(F.relu(batch_norm(w, "backbone.model.bn1", x), inplace=True), 3, stride=2, padding=1)
    for layer, blocks in ((1, 3), (2, 4), (3, 6)):
        for block in range(blocks):
            name, stride = f"backbone.model.layer{layer}.{block}", 2 if layer > 1 and block == 0 else 1
            out = F.relu(batch_norm(w, f"{name}.bn1", conv(w, f"{name}.conv1", x)), inplace=True)
            out = conv(w, f"{name}.conv2", out, stride=stride, padding=1)
            out = F.relu(batch_norm(w, f"{name}.bn2", out), inplace=True)
            out = batch_norm(w, f"{name}.bn3", conv(w, f"{name}.conv3", out))
            if block == 0:
                x = batch_norm(w, f"{name}.downsample.1", conv(w, f"{name}.downsample.0", x, stride=stride))
            x = F.relu(out.add_(x), inplace=True)
    return x


_RADIUS = 2  # of the detector, px


def aliked(w: Weights, images: Tensor, threshold: float = 0.1) -> list[list[np.ndarray]]:
    """Keypoints `[n, 2]` (x, y) px, descriptors `[n, D]` and scores `[n]`; sides of images are divisible by 32."""
    features, scores = dense_features(w, images)
    extracted = []
    for dense, score, peaks in zip(features, scores, _maxima(scores) > threshold, strict=True):
        points = _refine(score[0], *peaks[0].nonzero(as_tuple=True))
        values = sample(score[None], points[None, None])[0, 0, 0]
        extracted.append([each.cpu().numpy() for each in (points, _deformed_descriptors(w, dense, points), values)])
    return extracted


def dense_features(w: Weights, images: Tensor) -> tuple[Tensor, Tensor]:
    """Unit features `[B, D, H, W]` and scores `[B, 1, H, W]`."""
    x, levels = images / 255, []
    for place, pooled in enumerate((1, 2, 4, 4), start=1):
        x = F.avg_pool2d(x, pooled) if pooled > 1 else x
        shortcut = conv(w, f"block{place}.downsample", x, bias=True) if place > 1 else None
        convolve = _deformable if place > 2 else partial(conv, padding=1)
        for each in (1, 2):
            x = batch_norm(w, f"block{place}.bn{each}", convolve(w, f"block{place}.conv{each}", x))
            x = F.selu(x if each == 1 or shortcut is None else x.add_(shortcut), inplace=True)
        level, size = F.selu(conv(w, f"conv{place}", x), inplace=True), images.shape[2:]
        levels.append(F.interpolate(level, size, mode="bilinear", align_corners=True) if place > 1 else level)
    features = torch.cat(levels, 1)
    score = conv(w, "score_head.0", features)
    for position in (2, 4, 6):
        score = conv(w, f"score_head.{position}", F.selu(score, inplace=True), padding=1)
    return F.normalize(features), score.sigmoid()


def _deformable(w: Weights, name: str, x: Tensor) -> Tensor:
    """3 x 3 convolution whose nine taps move by the offsets of another convolution; zeros outside."""
    height, width = x.shape[2:]
    limit = max(height, width) / 4
    offsets = conv(w, f"{name}.offset_conv", x, bias=True, padding=1).clamp(-limit, limit).unflatten(1, (9, 2))
    rows, columns = torch.arange(height, device=x.device), torch.arange(width, device=x.device)
    right, down = _neighborhood(1, x.device).T[..., None, None]
    places = torch.stack([offsets[:, :, 1] + (columns + right), offsets[:, :, 0] + (rows[:, None] + down)], -1)
    taps = sample(x, places.flatten(1, 2)).unflatten(2, (9, height))  # places are [B, 9, h, w, 2]
    products = w(f"{name}.regular_conv.weight").flatten(1) @ taps.flatten(3).flatten(1, 2)
    return products.unflatten(2, (height, width))


def _maxima(scores: Tensor) -> Tensor:
    """Scores at maxima of their neighborhoods, in three rounds; 0 elsewhere and along the border."""
    local_max = partial(F.max_pool2d, kernel_size=2 * _RADIUS + 1, stride=1, padding=_RADIUS)
    peaks = scores == local_max(scores)
    for _ in range(2):
        suppressed = local_max(peaks.float()) > 0
        remaining = scores.masked_fill(suppressed, 0)
        peaks |= (remaining == local_max(remaining)) & ~suppressed
    inside = F.pad(torch.ones_like(scores[..., 2 * _RADIUS :, 2 * _RADIUS :]), (_RADIUS,) * 4)
    return scores * peaks * inside


def _refine(score: Tensor, row: Tensor, column: Tensor) -> Tensor:
    """Positions `[n, 2]` (x, y) px of peaks, moved by a soft-argmax of their neighborhoods."""
    steps = _neighborhood(_RADIUS, score.device)
    patches = score[row[:, None] + steps[:, 1], column[:, None] + steps[:, 0]]  # no peak is near the border
    weights = ((patches - patches.amax(1, keepdim=True)) / 0.1).exp()
    return torch.stack([column, row], 1) + weights @ steps.float() / weights.sum(1, keepdim=True)


def _deformed_descriptors(w: Weights, features: Tensor, points: Tensor) -> Tensor:
    """Descriptors `[n, D]` of points `[n, 2]` (x, y) px, sampled where the neighborhood of each point says."""
    column, row = (points.long()[:, None] + _neighborhood(1, points.device) + 1).unbind(2)
    patches = F.pad(features, (1, 1, 1, 1))[:, row, column].unflatten(2, (3, 3))  # [D, n, 3, 3]
    limit = max(features.shape[1:]) / 4
    offsets = F.selu(conv(w, "desc_head.offset_conv.0", patches.transpose(0, 1), bias=True), inplace=True)
    offsets = conv(w, "desc_head.offset_conv.2", offsets, bias=True).clamp(-limit, limit)
    places = points[:, None] + offsets.flatten(1).unflatten(1, (2, -1)).transpose(1, 2)  # [n, M, 2]
    mixed = conv(w, "desc_head.sf_conv", sample(features[None], places[None]))[0]  # [D, n, M]
    return F.normalize(torch.einsum("cnp,pcd->nd", F.selu(mixed, inplace=True), w("desc_head.agg_weights")))


def _neighborhood(radius: int, device: torch.device) -> Tensor:
    """Steps (right, down) `[n, 2]`, row by row."""
    reach = torch.arange(-radius, radius + 1, device=device)
    return torch.cartesian_prod(reach, reach).flip(1)
