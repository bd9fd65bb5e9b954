"""Matching, scores and search in torch, as its users would write them, with all pairs of a query in one batch."""

from collections.abc import Sequence

import torch
from torch import Tensor

SIZE, BIN, SIGMA = 336, 15.0, 22.5  # px
CELLS, REACH, TOLERANCE = 15, 5, 3.0  # of anchor points: cells per side, half of the window, cells


def product(left: Tensor, right: Tensor) -> Tensor:
    """Matrix product."""
    return left @ right


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
    """Tallest bins `[C]` from shifts `[C, K, 2]`, or `[C, W]` of weights `[C, W, K]`, by separable Gaussians."""
    votes_x, votes_y = (torch.exp(-0.5 * ((shifts[:, :, axis, None] - centers) / sigma) ** 2) for axis in (0, 1))
    if weights.ndim == 2:
        return torch.matmul((votes_y * weights[:, :, None]).mT, votes_x).amax((1, 2))
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


def score(
    points0: Tensor, points1: Tensor, scores0: Tensor, scores1: Tensor, distance: Tensor, mask: Tensor, *, scorer: str
) -> Tensor:
    """Scores `[C]` by the histogram, anchor points or the sum with the paper's weights."""
    weights = torch.where(mask, 2 - distance if scorer == "sum" else scores0 + scores1, 0.0)
    if scorer == "anchor":
        return anchor(points0, points1, weights)
    shifts = points1 - points0
    if scorer == "sum":
        return aggregate(shifts, weights, mask)
    return histogram(shifts, weights, bin_centers(BIN, mask.device), SIGMA)


def grid(
    shifts: Tensor,
    weights: Tensor,
    distance: Tensor,
    mask: Tensor,
    *,
    sigmas: Sequence[float],
    bin_sizes: Sequence[float],
    max_distances: Sequence[float],
) -> Tensor:
    """Scores of all settings for weights `[C, W, K]`: `[bins * sigmas, C, W * distances]`."""
    centers, limits = [bin_centers(size, mask.device) for size in bin_sizes], distance.new_tensor(max_distances)
    near = ((distance[:, None] <= limits[:, None]) & mask[:, None]).float()
    near_weights = (weights[:, :, None] * near[:, None]).flatten(1, 2)
    return torch.stack([histogram(shifts, near_weights, c, sigma) for c in centers for sigma in sigmas])


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
        scores = histogram(take(points1, nearest1) - points0, weights, centers, SIGMA)
        rankings.append(scores.argsort(descending=True))
    return torch.stack(rankings)
