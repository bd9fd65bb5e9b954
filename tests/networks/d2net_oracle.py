"""D2-Net's detection from the paper and its published settings: float64, explicit loops, no JAX."""

import math
from typing import NamedTuple

import numpy as np

from tests.networks.aliked_oracle import sampled


class Found(NamedTuple):
    """A keypoint of one map."""

    channel: int
    row: int
    column: int
    x: float  # px
    y: float
    score: float
    descriptor: np.ndarray  # [C]


def detected(dense: np.ndarray) -> list[tuple[int, int, int]]:
    """(channel, row, column) that pass the three tests, in this order, of a map `[h, w, C]`."""
    height, width, channels = dense.shape
    positions = []
    for channel, row, column in np.ndindex(channels, height, width):
        neighborhood = dense[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2, channel]
        is_maximum = dense[row, column, channel] == dense[row, column].max() == neighborhood.max()
        if is_maximum and not _is_edge(dense, channel, row, column):
            positions.append((channel, row, column))
    return positions


def keypoints(dense: np.ndarray, banned: np.ndarray | None = None) -> list[Found]:
    """Detections where nothing is `banned` `[h, w]`, moved to the maximum of a parabola."""
    height, width, _ = dense.shape
    detections = []
    for channel, row, column in detected(dense):
        if banned is not None and banned[row, column]:
            continue
        ii, jj, ij, i, j = _derivatives(dense, channel, row, column)
        down, right = np.linalg.solve([[ii, ij], [ij, jj]], [-i, -j])
        if abs(down) >= 0.5 or abs(right) >= 0.5:
            continue
        at_row, at_column = row + down, column + right
        if min(at_row, at_column) < 0 or math.ceil(at_row) >= height or math.ceil(at_column) >= width:
            continue
        descriptor = sampled(dense, at_column, at_row)
        descriptor = descriptor / max(np.linalg.norm(descriptor), 1e-12)
        score = dense[row, column, channel]
        detections.append(Found(channel, row, column, 4 * at_column + 1.5, 4 * at_row + 1.5, score, descriptor))
    return detections


def pyramid(maps: list[np.ndarray]) -> list[list[Found]]:
    """Keypoints of each scale's map, the smallest first, px of that scale's image; scores divided by 1, 2, ..."""
    levels: list[list[Found]] = []
    previous = banned = None
    for level, dense in enumerate(maps, start=1):
        height, width, _ = dense.shape
        if previous is not None:
            dense = dense + _enlarged(previous, height, width)
        if banned is not None:
            tall, wide = banned.shape
            banned = banned[np.ix_(np.arange(height) * tall // height, np.arange(width) * wide // width)]
        ours = keypoints(dense, banned)
        now = np.zeros((height, width), bool) if banned is None else banned.copy()
        for _, row, column in detected(dense):
            now[row, column] = True
        levels.append([keypoint._replace(score=keypoint.score / level) for keypoint in ours])
        banned, previous = now, dense if ours else None
    return levels


def _derivatives(dense: np.ndarray, channel: int, row: int, column: int) -> tuple[float, float, float, float, float]:
    """Second derivatives ii, jj, ij and first derivatives i, j (rows, columns); zeros outside."""
    values = np.pad(dense[..., channel], 1)[row : row + 3, column : column + 3]
    (corner1, up, corner2), (left, center, right), (corner3, down, corner4) = values
    ij = (corner1 - corner2 - corner3 + corner4) / 4
    return up - 2 * center + down, left - 2 * center + right, ij, (down - up) / 2, (right - left) / 2


def _is_edge(dense: np.ndarray, channel: int, row: int, column: int) -> bool:
    ii, jj, ij, _, _ = _derivatives(dense, channel, row, column)
    det = ii * jj - ij * ij
    return det <= 0 or (ii + jj) ** 2 / det > (5 + 1) ** 2 / 5


def _enlarged(dense: np.ndarray, height: int, width: int) -> np.ndarray:
    """Bilinear; the corners stay the corners."""
    tall, wide, channels = dense.shape
    result = np.zeros((height, width, channels))
    for row, column in np.ndindex(height, width):
        at_row, at_column = row * (tall - 1) / (height - 1), column * (wide - 1) / (width - 1)
        result[row, column] = sampled(dense, min(at_column, wide - 1), min(at_row, tall - 1))
    return result
