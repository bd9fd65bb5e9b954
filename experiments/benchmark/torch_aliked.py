"""ALIKED in plain torch, with the keys of the published weights: what mfvpr's is timed against.

torchvision's compiled deformable convolution is not used; here it samples with `grid_sample` and multiplies.
"""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from experiments.benchmark.torch_networks import LocalFeatures, on_host
from mfvpr.models.aliked import VARIANTS

RADIUS = 2  # of the detector, px


class Aliked(nn.Module):
    """Keypoints with sub-pixel positions, and descriptors gathered around them; sides divisible by 32."""

    def __init__(self, variant: str = "aliked-n16", threshold: float = 0.2) -> None:
        super().__init__()
        self.threshold = threshold
        widths, dimension, positions = VARIANTS[variant]
        first, second, third, fourth = widths
        self.block1 = _Block(3, first, _conv)
        self.block2 = _Block(first, second, _conv, nn.Conv2d(first, second, 1))
        self.block3 = _Block(second, third, _Deformable, nn.Conv2d(second, third, 1))
        self.block4 = _Block(third, fourth, _Deformable, nn.Conv2d(third, fourth, 1))
        self.conv1, self.conv2, self.conv3, self.conv4 = (_conv(width, dimension // 4, 1) for width in widths)
        heads = (_conv(dimension, 8, 1), _conv(8, 4), _conv(4, 4), _conv(4, 1))
        self.score_head = nn.Sequential(
            heads[0], nn.SELU(True), heads[1], nn.SELU(True), heads[2], nn.SELU(True), heads[3]
        )
        self.desc_head = _Descriptors(dimension, positions)

    def prepared(self, images: Tensor) -> Tensor:
        """`[B, H, W, 3]` uint8 RGB -> what the network takes."""
        return (images / 255).permute(0, 3, 1, 2)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Features `[B, D, H, W]` of unit length, and scores `[B, 1, H, W]`."""
        x1 = self.block1(images)
        x2 = self.block2(F.avg_pool2d(x1, 2))
        x3 = self.block3(F.avg_pool2d(x2, 4))
        x4 = self.block4(F.avg_pool2d(x3, 4))
        levels = zip((self.conv1, self.conv2, self.conv3, self.conv4), (x1, x2, x3, x4), (1, 2, 8, 32), strict=True)
        features = torch.cat([_enlarged(F.selu(conv(x), inplace=True), factor) for conv, x, factor in levels], 1)
        return F.normalize(features), self.score_head(features).sigmoid()

    def extract(self, images: Tensor) -> list[LocalFeatures]:
        """Keypoints with their descriptors, from images as `prepared` makes them."""
        features, scores = self(images)
        extracted = []
        for dense, score, peaks in zip(features, scores, _maxima(scores) > self.threshold, strict=True):
            points = _refined(score[0], *peaks[0].nonzero(as_tuple=True))
            values = _sampled(score[None], points[None, None])[0, 0, 0]
            extracted.append(on_host(points, self.desc_head(dense, points), values))
        return extracted


def _maxima(scores: Tensor) -> Tensor:
    """The scores at maxima of their neighborhoods, in three rounds; 0 elsewhere and along the border."""

    def spread(values: Tensor) -> Tensor:
        return F.max_pool2d(values, 2 * RADIUS + 1, stride=1, padding=RADIUS)

    peaks = scores == spread(scores)
    for _ in range(2):
        suppressed = spread(peaks.float()) > 0
        others = scores.masked_fill(suppressed, 0)
        peaks |= (others == spread(others)) & ~suppressed
    inside = F.pad(torch.ones_like(scores[..., 2 * RADIUS :, 2 * RADIUS :]), (RADIUS,) * 4)
    return scores * peaks * inside


def _refined(score: Tensor, row: Tensor, column: Tensor) -> Tensor:
    """(x, y) px of peaks `[n]`, moved by a soft-argmax of their neighborhoods."""
    down, right = _neighborhood(RADIUS, score.device)
    patches = F.pad(score, (RADIUS,) * 4)[row[:, None] + RADIUS + down, column[:, None] + RADIUS + right]
    weights = ((patches - patches.amax(1, keepdim=True)) / 0.1).exp()
    residual = weights @ torch.stack([right, down], 1).float() / weights.sum(1, keepdim=True)
    return torch.stack([column, row], 1) + residual


def _neighborhood(radius: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Steps down and to the right, row by row."""
    reach = torch.arange(-radius, radius + 1, device=device)
    down, right = torch.meshgrid(reach, reach, indexing="ij")
    return down.flatten(), right.flatten()


def _sampled(x: Tensor, points: Tensor) -> Tensor:
    """`[B, C, h, w]` of maps `[B, C, H, W]` at `[B, h, w, 2]` (x, y) px, zeros outside."""
    height, width = x.shape[2:]
    grid = 2 * points / torch.tensor([width - 1, height - 1], device=x.device) - 1
    return F.grid_sample(x, grid, align_corners=True)


class _Descriptors(nn.Module):
    """Samples the features at positions that the neighborhood of a keypoint proposes, and mixes them."""

    def __init__(self, dimension: int, positions: int) -> None:
        super().__init__()
        first = nn.Conv2d(dimension, 2 * positions, 3)
        self.offset_conv = nn.Sequential(first, nn.SELU(inplace=True), nn.Conv2d(2 * positions, 2 * positions, 1))
        self.sf_conv = _conv(dimension, dimension, 1)
        self.agg_weights = nn.Parameter(torch.empty(positions, dimension, dimension))

    def forward(self, features: Tensor, points: Tensor) -> Tensor:
        """`[n, D]` from `[D, H, W]` at `[n, 2]` (x, y) px."""
        reach = torch.arange(3, device=points.device)
        column, row = points.long().T
        padded = F.pad(features, (1, 1, 1, 1))
        patches = padded[:, (row[:, None] + reach)[:, :, None], (column[:, None] + reach)[:, None]]  # [D, n, 3, 3]
        limit = max(features.shape[1:]) / 4
        offsets = self.offset_conv(patches.transpose(0, 1)).clamp(-limit, limit)
        places = points[:, None] + offsets.flatten(1).unflatten(1, (2, -1)).transpose(1, 2)  # [n, M, 2]
        sampled = F.selu(self.sf_conv(_sampled(features[None], places[None])), inplace=True)[0]  # [D, n, M]
        return F.normalize(torch.einsum("cnp,pcd->nd", sampled, self.agg_weights))


class _Deformable(nn.Module):
    """3 x 3 convolution whose nine taps move by what another convolution says; zeros outside."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.offset_conv = nn.Conv2d(inputs, 18, 3, padding=1)
        self.regular_conv = _conv(inputs, outputs)

    def forward(self, x: Tensor) -> Tensor:
        height, width = x.shape[2:]
        limit = max(height, width) / 4
        offsets = self.offset_conv(x).clamp(-limit, limit).unflatten(1, (9, 2))  # (dy, dx) of each tap
        rows, columns = torch.arange(height, device=x.device), torch.arange(width, device=x.device)
        down, right = (step.reshape(9, 1, 1) for step in _neighborhood(1, x.device))
        vertical = offsets[:, :, 0] + (rows[:, None] + down)  # [B, 9, h, w]
        horizontal = offsets[:, :, 1] + (columns + right)
        grid = torch.stack([2 * horizontal / (width - 1) - 1, 2 * vertical / (height - 1) - 1], -1)
        taps = F.grid_sample(x, grid.flatten(1, 2), align_corners=True).unflatten(2, (9, height))  # [B, C, 9, h, w]
        products = self.regular_conv.weight.flatten(1) @ taps.flatten(3).flatten(1, 2)
        return products.unflatten(2, (height, width))


class _Block(nn.Module):
    """Two 3 x 3 convolutions; a shortcut, if any, is added before the last SELU."""

    def __init__(
        self, inputs: int, outputs: int, conv: Callable[[int, int], nn.Module], shortcut: nn.Module | None = None
    ) -> None:
        super().__init__()
        self.conv1, self.bn1 = conv(inputs, outputs), nn.BatchNorm2d(outputs)
        self.conv2, self.bn2 = conv(outputs, outputs), nn.BatchNorm2d(outputs)
        self.downsample = shortcut

    def forward(self, x: Tensor) -> Tensor:
        out = F.selu(self.bn1(self.conv1(x)), inplace=True)
        out = self.bn2(self.conv2(out))
        return F.selu(out if self.downsample is None else out.add_(self.downsample(x)), inplace=True)


def _conv(inputs: int, outputs: int, size: int = 3) -> nn.Conv2d:
    """Keeps the map's size; no bias."""
    return nn.Conv2d(inputs, outputs, size, padding=size // 2, bias=False)


def _enlarged(x: Tensor, factor: int) -> Tensor:
    if factor == 1:
        return x
    return F.interpolate(x, scale_factor=factor, mode="bilinear", align_corners=True)
