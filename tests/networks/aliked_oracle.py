"""ALIKED's operators from the paper and its published settings: float64, explicit loops, no JAX."""

import math

import numpy as np


def sampled(dense: np.ndarray, x: float, y: float) -> np.ndarray:
    """A map `[H, W, C]` at (x, y): each pixel's weight falls to 0 within one pixel; zeros outside."""
    height, width, channels = dense.shape
    total = np.zeros(channels)
    for row in range(math.floor(y), math.floor(y) + 2):
        for column in range(math.floor(x), math.floor(x) + 2):
            if 0 <= row < height and 0 <= column < width:
                total += (1 - abs(y - row)) * (1 - abs(x - column)) * dense[row, column]
    return total


def deformed(dense: np.ndarray, kernel: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """The deformable convolution of a map `[H, W, C]`; `offsets` `[H, W, 18]` are (y, x) of each tap, row by row."""
    height, width, _ = dense.shape
    limit = max(height, width) / 4
    offsets = np.clip(offsets, -limit, limit).reshape(height, width, 3, 3, 2)
    total = np.zeros((height, width, kernel.shape[-1]))
    for row, column, down, right in np.ndindex(height, width, 3, 3):
        y, x = offsets[row, column, down, right]
        values = sampled(dense, column + right - 1 + x, row + down - 1 + y)
        total[row, column] += values @ kernel[down, right]
    return total


def _highest(scores: np.ndarray, row: int, column: int) -> float:
    """Maximum of the 5 x 5 neighborhood."""
    return scores[max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3].max()


def peaks(scores: np.ndarray) -> list[tuple[int, int]]:
    """(row, column) of the maxima, in three rounds."""
    height, width = scores.shape
    places = [*np.ndindex(scores.shape)]
    maxima = {place for place in places if scores[place] == _highest(scores, *place)}
    for _ in range(2):
        near = {(row + down - 2, column + right - 2) for row, column in maxima for down, right in np.ndindex(5, 5)}
        remaining = scores.copy()
        for place in near.intersection(places):
            remaining[place] = 0
        maxima |= {place for place in places if place not in near and remaining[place] == _highest(remaining, *place)}
    return sorted((row, column) for row, column in maxima if 2 <= row < height - 2 and 2 <= column < width - 2)


def keypoints(scores: np.ndarray, threshold: float, limit: int) -> np.ndarray:
    """Rows of x, y, score."""
    places = [place for place in peaks(scores) if scores[place] > threshold]
    if not places:
        places = [place for place in peaks(scores) if scores[place] > scores.mean()]
    if len(places) > limit:
        places = sorted(places, key=lambda place: -scores[place])[:limit]
    padded = np.pad(scores, 2)
    rows = []
    for row, column in places:
        patch = padded[row : row + 5, column : column + 5]
        weights = np.exp((patch - patch.max()) / 0.1)
        x = column + sum(weights[i, j] * (j - 2) for i, j in np.ndindex(5, 5)) / weights.sum()
        y = row + sum(weights[i, j] * (i - 2) for i, j in np.ndindex(5, 5)) / weights.sum()
        rows.append((x, y, sampled(scores[..., None], x, y)[0]))
    return np.array(rows).reshape(-1, 3)


def _selu(values: np.ndarray) -> np.ndarray:
    return 1.0507009873554805 * np.where(values > 0, values, 1.6732632423543772 * np.expm1(np.minimum(values, 0)))


def described(features: np.ndarray, point: np.ndarray, head: dict[str, np.ndarray]) -> np.ndarray:
    """The descriptor at a point (x, y), from features `[H, W, D]` of unit length; `head` holds the weights by name."""
    height, width, _ = features.shape
    column, row = int(point[0]), int(point[1])
    padded = np.pad(features, ((1, 1), (1, 1), (0, 0)))
    hidden = np.array(head["offset1.bias"], np.float64)
    for down, right in np.ndindex(3, 3):
        hidden += padded[row + down, column + right] @ head["offset1.kernel"][down, right]
    moves = _selu(hidden) @ head["offset2.kernel"][0, 0] + head["offset2.bias"]
    limit = max(height, width) / 4
    moves = np.clip(moves, -limit, limit).reshape(2, -1)  # all x, then all y
    total = np.zeros(features.shape[-1])
    for (x, y), mixing in zip(moves.T, head["agg_weights"], strict=True):
        total += _selu(sampled(features, point[0] + x, point[1] + y) @ head["sample.kernel"][0, 0]) @ mixing
    return total / np.linalg.norm(total)
