"""Networks in plain torch, with the keys of the published weights.

A network is a function of its weights and of RGB images `[B, 3, H, W]`, 0 .. 255. Results are on the host. Deformable
convolutions use `grid_sample`.
"""

from collections.abc import Callable, Iterable, Mapping
from functools import cache
from typing import Any, NamedTuple

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
        x = F.relu(x, inplace=True) if position else x
        if position in (5, 10):
            x = F.max_pool2d(x, 2)
        elif position == 17:  # dilation replaces the stride of the last pooling
            x = F.avg_pool2d(x, 2, stride=1)
        reach = 2 if position >= 17 else 1
        x = conv(w, f"dense_feature_extraction.model.{position}", x, bias=True, padding=reach, dilation=reach)
    return F.relu(x, inplace=True)


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
            stride = 2 if layer > 1 and block == 0 else 1
            x = _bottleneck(w, f"backbone.model.layer{layer}.{block}", x, stride, shortcut=block == 0)
    return x


def _bottleneck(w: Weights, name: str, x: Tensor, stride: int, shortcut: bool) -> Tensor:
    out = F.relu(batch_norm(w, f"{name}.bn1", conv(w, f"{name}.conv1", x)), inplace=True)
    out = conv(w, f"{name}.conv2", out, stride=stride, padding=1)
    out = F.relu(batch_norm(w, f"{name}.bn2", out), inplace=True)
    out = batch_norm(w, f"{name}.bn3", conv(w, f"{name}.conv3", out))
    if shortcut:
        x = batch_norm(w, f"{name}.downsample.1", conv(w, f"{name}.downsample.0", x, stride=stride))
    return F.relu(out.add_(x), inplace=True)


_RADIUS = 2  # of the detector, px
_LEVELS = ((1, 1), (2, 2), (4, 8), (4, 32))  # before each block: pooling, and size of the image / size of the map


def aliked(w: Weights, images: Tensor, threshold: float) -> list[LocalFeatures]:
    """Keypoints with sub-pixel positions, and their descriptors; sides of images are divisible by 32."""
    features, scores = dense_features(w, images)
    corner = torch.tensor(scores.shape[:1:-1], device=scores.device) - 1  # (width, height) - 1
    extracted = []
    for dense, score, peaks in zip(features, scores, _maxima(scores) > threshold, strict=True):
        points = (
            _aliked_refine(score[0], *peaks[0].nonzero(as_tuple=True)) / corner * 2 - 1
        )  # and back, rounded as published
        values = F.grid_sample(score[None], points[None, None], align_corners=True)[0, 0, 0]
        descriptors = _aliked_descriptors(w, dense, (points / 2 + 0.5) * corner)
        extracted.append(to_host((points + 1) / 2 * corner, descriptors, values))
    return extracted


def dense_features(w: Weights, images: Tensor) -> tuple[Tensor, Tensor]:
    """Unit features `[B, D, H, W]` and scores `[B, 1, H, W]`."""
    x, levels = images / 255, []
    for place, (pooled, factor) in enumerate(_LEVELS, start=1):
        x = x if pooled == 1 else F.avg_pool2d(x, pooled)
        x = _aliked_block(w, f"block{place}", x, deformable=place > 2, shortcut=place > 1)
        level = F.selu(conv(w, f"conv{place}", x), inplace=True)
        enlarged = {"scale_factor": factor, "mode": "bilinear", "align_corners": True}
        levels.append(level if factor == 1 else F.interpolate(level, **enlarged))
    features = torch.cat(levels, 1)
    score = conv(w, "score_head.0", features)
    for position in (2, 4, 6):
        score = conv(w, f"score_head.{position}", F.selu(score, inplace=True), padding=1)
    return F.normalize(features), score.sigmoid()


def _aliked_block(w: Weights, name: str, x: Tensor, *, deformable: bool, shortcut: bool) -> Tensor:
    """Two 3 x 3 convolutions; the shortcut is added before the last SELU."""

    def normalized_conv(place: int, x: Tensor) -> Tensor:
        of_place = f"{name}.conv{place}"
        out = _deformable(w, of_place, x) if deformable else conv(w, of_place, x, padding=1)
        return batch_norm(w, f"{name}.bn{place}", out)

    out = normalized_conv(2, F.selu(normalized_conv(1, x), inplace=True))
    return F.selu(out.add_(conv(w, f"{name}.downsample", x, bias=True)) if shortcut else out, inplace=True)


def _deformable(w: Weights, name: str, x: Tensor) -> Tensor:
    """3 x 3 convolution whose nine taps move by the offsets of another convolution; zeros outside."""
    height, width = x.shape[2:]
    limit = max(height, width) / 4
    offsets = conv(w, f"{name}.offset_conv", x, bias=True, padding=1).clamp(-limit, limit).unflatten(1, (9, 2))
    rows, columns = torch.arange(height, device=x.device), torch.arange(width, device=x.device)
    down, right = (step.reshape(9, 1, 1) for step in _neighborhood(1, x.device))
    vertical = offsets[:, :, 0] + (rows[:, None] + down)  # [B, 9, h, w]
    horizontal = offsets[:, :, 1] + (columns + right)
    taps = sample(x, torch.stack([horizontal, vertical], -1).flatten(1, 2)).unflatten(2, (9, height))
    products = w(f"{name}.regular_conv.weight").flatten(1) @ taps.flatten(3).flatten(1, 2)
    return products.unflatten(2, (height, width))


def _maxima(scores: Tensor) -> Tensor:
    """Scores at maxima of their neighborhoods, in three rounds; 0 elsewhere and along the border."""

    def local_max(values: Tensor) -> Tensor:
        return F.max_pool2d(values, 2 * _RADIUS + 1, stride=1, padding=_RADIUS)

    peaks = scores == local_max(scores)
    for _ in range(2):
        suppressed = local_max(peaks.float()) > 0
        remaining = scores.masked_fill(suppressed, 0)
        peaks |= (remaining == local_max(remaining)) & ~suppressed
    inside = F.pad(torch.ones_like(scores[..., 2 * _RADIUS :, 2 * _RADIUS :]), (_RADIUS,) * 4)
    return scores * peaks * inside


def _aliked_refine(score: Tensor, row: Tensor, column: Tensor) -> Tensor:
    """Positions `[n, 2]` (x, y) px of peaks, moved by a soft-argmax of their neighborhoods."""
    down, right = _neighborhood(_RADIUS, score.device)
    patches = F.pad(score, (_RADIUS,) * 4)[row[:, None] + _RADIUS + down, column[:, None] + _RADIUS + right]
    weights = ((patches - patches.amax(1, keepdim=True)) / 0.1).exp()
    residual = weights @ torch.stack([right, down], 1).float() / weights.sum(1, keepdim=True)
    return torch.stack([column, row], 1) + residual


def _aliked_descriptors(w: Weights, features: Tensor, points: Tensor) -> Tensor:
    """Descriptors `[n, D]` of points `[n, 2]` (x, y) px, sampled where the neighborhood of each point says."""
    reach = torch.arange(3, device=points.device)
    column, row = points.long().T
    padded = F.pad(features, (1, 1, 1, 1))
    patches = padded[:, (row[:, None] + reach)[:, :, None], (column[:, None] + reach)[:, None]]  # [D, n, 3, 3]
    limit = max(features.shape[1:]) / 4
    offsets = F.selu(conv(w, "desc_head.offset_conv.0", patches.transpose(0, 1), bias=True), inplace=True)
    offsets = conv(w, "desc_head.offset_conv.2", offsets, bias=True).clamp(-limit, limit)
    places = points[:, None] + offsets.flatten(1).unflatten(1, (2, -1)).transpose(1, 2)  # [n, M, 2]
    mixed = conv(w, "desc_head.sf_conv", sample(features[None], places[None]))[0]  # [D, n, M]
    return F.normalize(torch.einsum("cnp,pcd->nd", F.selu(mixed, inplace=True), w("desc_head.agg_weights")))


def _neighborhood(radius: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Offsets down and to the right, row by row."""
    reach = torch.arange(-radius, radius + 1, device=device)
    down, right = torch.cartesian_prod(reach, reach).T
    return down, right
