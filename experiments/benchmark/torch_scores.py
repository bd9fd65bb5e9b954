"""Matching, scores and search in torch, as its users would write them, with all pairs of a query in one batch."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

SIZE, BIN, SIGMA = 336, 15.0, 22.5  # px
product = torch.matmul
CELLS, REACH, TOLERANCE = 15, 5, 3.0  # of anchor points: cells per side, half of the window, cells


def match(query: Tensor, candidates: Tensor) -> tuple[Tensor, Tensor]:
    """Nearest neighbors of descriptors `[N0, D]` in `[C, N1, D]`, and whether they are mutual, `[C, N0]`."""
    similarity = torch.matmul(query, candidates.mT)
    nearest1, nearest0 = similarity.argmax(2), similarity.argmax(1)
    return nearest1, torch.gather(nearest0, 1, nearest1) == torch.arange(len(query), device=query.device)


def match_with_distances(query: Tensor, candidates: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """`match`, and the distances of the descriptors."""
    nearest1, mutual = match(query, candidates)
    return nearest1, mutual, torch.linalg.vector_norm(query - take(candidates, nearest1), dim=2)


def take(rows: Tensor, index: Tensor) -> Tensor:
    """Rows `[C, K, D]` of `[C, N, D]` by their index `[C, K]`."""
    return torch.gather(rows, 1, index[..., None].expand(-1, -1, rows.shape[2]))


def bin_centers(bin_size: float, device: torch.device | None = None) -> Tensor:
    """Centers of the bins of shifts along an axis, px."""
    return torch.arange(-SIZE + bin_size / 2, SIZE, bin_size, device=device)


def histogram(shifts: Tensor, weights: Tensor, centers: Tensor, sigma: float) -> Tensor:
    """Tallest bins `[C, W]` from shifts `[C, K, 2]` and weights `[C, W, K]`, by separable Gaussians."""
    votes_x, votes_y = (torch.exp(-0.5 * ((shifts[:, :, axis, None] - centers) / sigma) ** 2) for axis in (0, 1))
    columns = (weights[:, :, None] * votes_y.mT[:, None]).flatten(1, 2)  # [C, W * bins, K]
    return torch.matmul(columns, votes_x).unflatten(1, (weights.shape[1], -1)).amax((2, 3))


def anchor(points0: Tensor, points1: Tensor, weights: Tensor) -> Tensor:
    """Scores of anchor points `[C]`; padding has weight 0."""
    step = torch.tensor([1, CELLS], device=weights.device)
    cell0, cell1 = ((p * CELLS / SIZE).long().clamp(0, CELLS - 1).mul(step).sum(2) for p in (points0, points1))
    votes = torch.zeros(len(weights), CELLS**4, device=weights.device)
    votes = votes.scatter_add_(1, cell0 * CELLS**2 + cell1, weights).unflatten(1, (CELLS**2, CELLS**2))
    best, winner = votes.max(2)
    cells = torch.arange(CELLS**2, device=weights.device)
    row, column = cells // CELLS, cells % CELLS
    rows, columns = (winner // CELLS - row).float(), (winner % CELLS - column).float()
    distance = torch.hypot(rows[:, :, None] - rows[:, None], columns[:, :, None] - columns[:, None])
    near = ((row[:, None] - row).abs() <= REACH) & ((column[:, None] - column).abs() <= REACH)
    support = (TOLERANCE - distance).clamp(min=0) * (near & (best > 0)[:, None])
    return (best * support.sum(2)).sum(1)


def aggregate(shifts: Tensor, weights: Tensor, mask: Tensor) -> Tensor:
    """Aggregated scores `[C]` around the unweighted mean shift."""
    real = mask[..., None].float()
    mean = (shifts * real).sum(1, keepdim=True) / real.sum(1, keepdim=True).clamp(min=1)
    return (weights * ((SIZE - (shifts - mean).abs()) ** 2).sum(2)).sum(1)


def match_weights(name: str, fields: Sequence[Tensor], farthest: float = 2.0) -> Tensor:
    """Weights `[C, K]` of matches by name; 0 for padding and for matches farther apart."""
    scores0, scores1, distance, mask = fields
    weights = {"fs": scores0 + scores1, "dmf": 2 - distance, "unit": torch.ones_like(distance)}[name]
    return torch.where(mask & (distance <= farthest), weights, 0.0)


def score(points0: Tensor, points1: Tensor, *fields: Tensor, scorer: str) -> Tensor:
    """Scores `[C]` by the histogram, anchor points or the sum with the paper's weights."""
    weights, shifts = match_weights("dmf" if scorer == "sum" else "fs", fields), points1 - points0
    if scorer == "anchor":
        return anchor(points0, points1, weights)
    if scorer == "sum":
        return aggregate(shifts, weights, fields[-1])
    return histogram(shifts, weights[:, None], bin_centers(BIN, shifts.device), SIGMA)[:, 0]


def grid(points0: Tensor, points1: Tensor, *fields: Tensor, **axes: Sequence[Any]) -> Tensor:
    """Scores of all settings: `[bin sizes * sigmas, C, weights * distances]`."""
    names, limits = axes.get("weight", ("fs",)), axes.get("max_distance", (2.0,))
    weights = torch.stack([match_weights(name, fields, limit) for name in names for limit in limits], 1)
    shifts = points1 - points0
    bins = [bin_centers(size, shifts.device) for size in axes["bin_size"]]
    return torch.stack([histogram(shifts, weights, centers, sigma) for centers in bins for sigma in axes["sigma"]])


def search(queries: Tensor, database: Tensor, *, candidates: int) -> Tensor:
    """Rows `[Q, candidates]` of the largest products."""
    return torch.topk(queries @ database.T, candidates).indices


def rank(rows: Tensor, *fields: Tensor) -> Tensor:
    """Rankings of candidates `[Q, C]` by histograms; fields are points, descriptors and scores of both sides."""
    rankings, centers = [], bin_centers(BIN, rows.device)
    for row in rows:  # candidates of a query; the query is the view of the first
        points0, query, scores0 = (field[row[0]] for field in fields[:3])
        points1, candidates, scores1 = (field[row] for field in fields[3:])
        nearest1, mutual = match(query, candidates)
        weights = torch.where(mutual, scores0 + torch.gather(scores1, 1, nearest1), 0.0)
        scores = histogram(take(points1, nearest1) - points0, weights[:, None], centers, SIGMA)[:, 0]
        rankings.append(scores.argsort(descending=True))
    return torch.stack(rankings)
