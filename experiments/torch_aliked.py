"""ALIKED in plain torch, with the keys of the published weights: what mfvpr's is timed against.

torchvision's compiled deformable convolution is not used; here it samples with `grid_sample` and multiplies.
"""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from experiments.torch_networks import Found, on_host

WIDTHS = (16, 32, 64, 128)
POSITIONS = {"aliked-n16": 16, "aliked-n32": 32}  # that a descriptor is gathered from
RADIUS = 2  # of the detector, px


class Aliked(nn.Module):
    """Keypoints with sub-pixel positions, and descriptors gathered around them; sides divisible by 32."""

    DIMENSION = 128

    def __init__(self, variant: str = "aliked-n16", threshold: float = 0.2) -> None:
        super().__init__()
        self.threshold = threshold
        first, second, third, fourth = WIDTHS
        self.block1 = _Block(3, first)
        self.block2 = _Residual(first, second, _conv)
        self.block3 = _Residual(second, third, _Deformable)
        self.block4 = _Residual(third, fourth, _Deformable)
        quarter = self.DIMENSION // 4
        self.conv1, self.conv2, self.conv3, self.conv4 = (_conv(width, quarter, 1) for width in WIDTHS)
        heads = (_conv(self.DIMENSION, 8, 1), _conv(8, 4), _conv(4, 4), _conv(4, 1))
        self.score_head = nn.Sequential(
            heads[0], nn.SELU(True), heads[1], nn.SELU(True), heads[2], nn.SELU(True), heads[3]
        )
        self.desc_head = _Descriptors(self.DIMENSION, POSITIONS[variant])

    def prepared(self, images: Tensor) -> Tensor:
        """`[B, H, W, 3]` uint8 RGB -> what the network takes."""
        return (images / 255).permute(0, 3, 1, 2)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Features `[B, 128, H, W]` of unit length, and scores `[B, 1, H, W]`."""
        x1 = self.block1(images)
        x2 = self.block2(F.avg_pool2d(x1, 2))
        x3 = self.block3(F.avg_pool2d(x2, 4))
        x4 = self.block4(F.avg_pool2d(x3, 4))
        levels = zip((self.conv1, self.conv2, self.conv3, self.conv4), (x1, x2, x3, x4), (1, 2, 8, 32), strict=True)
        features = torch.cat([_upsampled(F.selu(conv(x), inplace=True), factor) for conv, x, factor in levels], 1)
        return F.normalize(features), self.score_head(features).sigmoid()

    def extract(self, images: Tensor) -> list[Found]:
        """Keypoints with their descriptors, from images as `prepared` makes them."""
        features, scores = self(images)
        corner = torch.tensor(scores.shape[:1:-1], device=scores.device) - 1  # (width, height) - 1
        found = []
        for dense, score, peaks in zip(features, scores, maxima(scores) > self.threshold, strict=True):
            points = _refined(score[0], *peaks[0].nonzero(as_tuple=True)) / corner * 2 - 1
            values = F.grid_sample(score[None], points[None, None], align_corners=True)[0, 0, 0]
            descriptors = self.desc_head(dense, (points / 2 + 0.5) * corner)
            found.append(on_host((points + 1) / 2 * corner, descriptors, values))
        return found


def maxima(scores: Tensor) -> Tensor:
    """The scores at maxima of their neighborhoods, in three rounds; 0 elsewhere and along the border."""

    def spread(values: Tensor) -> Tensor:
        return F.max_pool2d(values, 2 * RADIUS + 1, stride=1, padding=RADIUS)

    found = scores == spread(scores)
    for _ in range(2):
        suppressed = spread(found.float()) > 0
        others = scores.masked_fill(suppressed, 0)
        found |= (others == spread(others)) & ~suppressed
    inside = F.pad(torch.ones_like(scores[..., 2 * RADIUS :, 2 * RADIUS :]), (RADIUS,) * 4)
    return scores * found * inside


def _refined(score: Tensor, row: Tensor, column: Tensor) -> Tensor:
    """(x, y) of peaks `[n]`, moved by a soft-argmax of their neighborhoods."""
    reach = torch.arange(-RADIUS, RADIUS + 1, device=score.device)
    down, right = (grid.flatten() for grid in torch.meshgrid(reach, reach, indexing="ij"))
    patches = F.pad(score, (RADIUS,) * 4)[row[:, None] + RADIUS + down, column[:, None] + RADIUS + right]
    weights = ((patches - patches.amax(1, keepdim=True)) / 0.1).exp()
    residual = weights @ torch.stack([right, down], 1).float() / weights.sum(1, keepdim=True)
    return torch.stack([column, row], 1) + residual


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
        height, width = features.shape[1:]
        reach = torch.arange(3, device=points.device)
        column, row = points.long().T
        padded = F.pad(features, (1, 1, 1, 1))
        patches = padded[:, (row[:, None] + reach)[:, :, None], (column[:, None] + reach)[:, None]]  # [D, n, 3, 3]
        limit = max(height, width) / 4
        offsets = self.offset_conv(patches.transpose(0, 1)).clamp(-limit, limit)
        places = points[:, None] + offsets.flatten(1).unflatten(1, (2, -1)).transpose(1, 2)  # [n, M, 2]
        grid = 2 * places / torch.tensor([width - 1, height - 1], device=points.device) - 1
        sampled = F.grid_sample(features[None], grid[None], align_corners=True)  # [1, D, n, M]
        sampled = F.selu(self.sf_conv(sampled), inplace=True)[0]
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
        reach = torch.arange(-1, 2, device=x.device)
        down, right = (tap.reshape(9, 1, 1) for tap in torch.meshgrid(reach, reach, indexing="ij"))
        vertical = offsets[:, :, 0] + (rows[:, None] + down)  # [B, 9, h, w]
        horizontal = offsets[:, :, 1] + (columns + right)
        grid = torch.stack([2 * horizontal / (width - 1) - 1, 2 * vertical / (height - 1) - 1], -1)
        taps = F.grid_sample(x, grid.flatten(1, 2), align_corners=True).unflatten(2, (9, height))  # [B, C, 9, h, w]
        products = self.regular_conv.weight.flatten(1) @ taps.flatten(3).flatten(1, 2)
        return products.unflatten(2, (height, width))


class _Block(nn.Module):
    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.conv1, self.bn1 = _conv(inputs, outputs), nn.BatchNorm2d(outputs)
        self.conv2, self.bn2 = _conv(outputs, outputs), nn.BatchNorm2d(outputs)

    def forward(self, x: Tensor) -> Tensor:
        x = F.selu(self.bn1(self.conv1(x)), inplace=True)
        return F.selu(self.bn2(self.conv2(x)), inplace=True)


class _Residual(nn.Module):
    def __init__(self, inputs: int, outputs: int, conv: Callable[[int, int], nn.Module]) -> None:
        super().__init__()
        self.conv1, self.bn1 = conv(inputs, outputs), nn.BatchNorm2d(outputs)
        self.conv2, self.bn2 = conv(outputs, outputs), nn.BatchNorm2d(outputs)
        self.downsample = nn.Conv2d(inputs, outputs, 1)

    def forward(self, x: Tensor) -> Tensor:
        out = F.selu(self.bn1(self.conv1(x)), inplace=True)
        return F.selu(self.bn2(self.conv2(out)).add_(self.downsample(x)), inplace=True)


def _conv(inputs: int, outputs: int, size: int = 3) -> nn.Conv2d:
    """Keeps the map's size; no bias."""
    return nn.Conv2d(inputs, outputs, size, padding=size // 2, bias=False)


def _upsampled(x: Tensor, factor: int) -> Tensor:
    if factor == 1:
        return x
    return F.interpolate(x, scale_factor=factor, mode="bilinear", align_corners=True)
