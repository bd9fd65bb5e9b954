"""ALIKED in plain torch, with the keys of the published weights; deformable convolutions use `grid_sample`."""

import torch
import torch.nn.functional as F
from torch import Tensor

from experiments.benchmark.torch_networks import LocalFeatures, Weights, batch_norm, conv, sample, to_host

RADIUS = 2  # of the detector, px
LEVELS = ((1, 1), (2, 2), (4, 8), (4, 32))  # before each block: pooling, and size of the image / size of the map


def aliked(w: Weights, images: Tensor, threshold: float) -> list[LocalFeatures]:
    """Keypoints with sub-pixel positions, and their descriptors; sides of images are divisible by 32."""
    features, scores = dense_features(w, images)
    corner = torch.tensor(scores.shape[:1:-1], device=scores.device) - 1  # (width, height) - 1
    extracted = []
    for dense, score, peaks in zip(features, scores, _maxima(scores) > threshold, strict=True):
        points = _refine(score[0], *peaks[0].nonzero(as_tuple=True)) / corner * 2 - 1  # and back, rounded as published
        values = F.grid_sample(score[None], points[None, None], align_corners=True)[0, 0, 0]
        descriptors = _descriptors(w, dense, (points / 2 + 0.5) * corner)
        extracted.append(to_host((points + 1) / 2 * corner, descriptors, values))
    return extracted


def dense_features(w: Weights, images: Tensor) -> tuple[Tensor, Tensor]:
    """Unit features `[B, D, H, W]` and scores `[B, 1, H, W]`."""
    x, levels = images / 255, []
    for place, (pooled, factor) in enumerate(LEVELS, start=1):
        x = x if pooled == 1 else F.avg_pool2d(x, pooled)
        x = _block(w, f"block{place}", x, deformable=place > 2, shortcut=place > 1)
        level = F.selu(conv(w, f"conv{place}", x), inplace=True)
        enlarged = {"scale_factor": factor, "mode": "bilinear", "align_corners": True}
        levels.append(level if factor == 1 else F.interpolate(level, **enlarged))
    features = torch.cat(levels, 1)
    score = conv(w, "score_head.0", features)
    for position in (2, 4, 6):
        score = conv(w, f"score_head.{position}", F.selu(score, inplace=True), padding=1)
    return F.normalize(features), score.sigmoid()


def _block(w: Weights, name: str, x: Tensor, *, deformable: bool, shortcut: bool) -> Tensor:
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
        return F.max_pool2d(values, 2 * RADIUS + 1, stride=1, padding=RADIUS)

    peaks = scores == local_max(scores)
    for _ in range(2):
        suppressed = local_max(peaks.float()) > 0
        remaining = scores.masked_fill(suppressed, 0)
        peaks |= (remaining == local_max(remaining)) & ~suppressed
    inside = F.pad(torch.ones_like(scores[..., 2 * RADIUS :, 2 * RADIUS :]), (RADIUS,) * 4)
    return scores * peaks * inside


def _refine(score: Tensor, row: Tensor, column: Tensor) -> Tensor:
    """Positions `[n, 2]` (x, y) px of peaks, moved by a soft-argmax of their neighborhoods."""
    down, right = _neighborhood(RADIUS, score.device)
    patches = F.pad(score, (RADIUS,) * 4)[row[:, None] + RADIUS + down, column[:, None] + RADIUS + right]
    weights = ((patches - patches.amax(1, keepdim=True)) / 0.1).exp()
    residual = weights @ torch.stack([right, down], 1).float() / weights.sum(1, keepdim=True)
    return torch.stack([column, row], 1) + residual


def _descriptors(w: Weights, features: Tensor, points: Tensor) -> Tensor:
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
