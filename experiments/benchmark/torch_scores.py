"""Matching, scores and search in torch, for all pairs in one batch, as its users would write them."""

import torch
from torch import Tensor


def match(query: Tensor, candidates: Tensor) -> tuple[Tensor, Tensor]:
    """Nearest neighbors of descriptors `[N0, D]` in `[C, N1, D]`, and whether they are mutual, `[C, N0]`."""
    similarity = torch.matmul(query, candidates.mT)
    nearest1, nearest0 = similarity.argmax(2), similarity.argmax(1)
    return nearest1, torch.gather(nearest0, 1, nearest1) == torch.arange(len(query), device=query.device)


def take(rows: Tensor, index: Tensor) -> Tensor:
    """Rows `[C, K, D]` of `[C, N, D]` by their index `[C, K]`."""
    return torch.gather(rows, 1, index[..., None].expand(-1, -1, rows.shape[2]))


def histogram(shifts: Tensor, weights: Tensor, centers: Tensor, sigma: float) -> Tensor:
    """Tallest bins `[C]` from shifts `[C, K, 2]`, or `[C, W]` of weights `[C, W, K]`, by separable Gaussians."""
    votes_x, votes_y = (torch.exp(-0.5 * ((shifts[:, :, axis, None] - centers) / sigma) ** 2) for axis in (0, 1))
    if weights.ndim == 2:
        return torch.matmul((votes_y * weights[:, :, None]).mT, votes_x).amax((1, 2))
    columns = (weights[:, :, None] * votes_y.mT[:, None]).flatten(1, 2)  # [C, W * bins, K]
    return torch.matmul(columns, votes_x).unflatten(1, (weights.shape[1], -1)).amax((2, 3))


def anchor(points0: Tensor, points1: Tensor, weights: Tensor, size: float) -> Tensor:
    """Scores of anchor points `[C]` with 15 x 15 cells, a window of 11 cells and tolerance 3; padding has weight 0."""
    bins, reach, tolerance = 15, 5, 3.0
    cell0, cell1 = (
        ((points * bins / size).long().clamp(0, bins - 1) * torch.tensor([1, bins], device=points.device)).sum(2)
        for points in (points0, points1)
    )
    votes = torch.zeros(len(weights), bins**4, device=weights.device)
    votes = votes.scatter_add_(1, cell0 * bins**2 + cell1, weights).unflatten(1, (bins**2, bins**2))
    best, winner = votes.max(2)
    cells = torch.arange(bins**2, device=weights.device)
    row, column = cells // bins, cells % bins
    rows, columns = (winner // bins - row).float(), (winner % bins - column).float()
    distance = torch.hypot(rows[:, :, None] - rows[:, None], columns[:, :, None] - columns[:, None])
    near = ((row[:, None] - row).abs() <= reach) & ((column[:, None] - column).abs() <= reach)
    support = (tolerance - distance).clamp(min=0) * (near & (best > 0)[:, None])
    return (best * support.sum(2)).sum(1)


def aggregate(shifts: Tensor, weights: Tensor, mask: Tensor, size: float) -> Tensor:
    """Aggregated scores `[C]` around the unweighted mean shift."""
    real = mask[..., None].float()
    mean = (shifts * real).sum(1, keepdim=True) / real.sum(1, keepdim=True).clamp(min=1)
    return (weights * ((size - (shifts - mean).abs()) ** 2).sum(2)).sum(1)


def search(queries: Tensor, database: Tensor, candidates: int) -> Tensor:
    """Rows `[Q, candidates]` of the largest products."""
    return torch.topk(queries @ database.T, candidates).indices
