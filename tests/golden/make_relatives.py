"""Inputs of relatives.npz, which public codes have scored, see README.md."""

import numpy as np

MAP = (10, 14)  # rows and columns of a feature map, 16 px each
PATCHES = (2, 5, 8)
SIZE = (320, 240)
LAYOUT = (15, 20)  # rows and columns of LoST's maps


def descriptors(seed: int, count: int, dimension: int = 16) -> np.ndarray:
    """`[count, dimension]` float32 of unit length, from whole numbers."""
    rows = np.random.default_rng(seed).integers(-999, 1000, (count, dimension)).astype(np.float64)
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def alike(first: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Descriptors of another image, and the rows of the first that most of them resemble."""
    count, dimension = first.shape
    rows = np.random.default_rng(seed).permutation(count)
    blended = first[rows] + 0.8 * descriptors(seed + 1, count, dimension)
    return (blended / np.linalg.norm(blended, axis=1, keepdims=True)).astype(np.float32), rows


def patches(patch: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places `[n, 2]` (column, row) of patches on the map, and their descriptors in query and reference."""
    row, column = np.indices((MAP[0] - patch + 1, MAP[1] - patch + 1)).reshape(2, -1)
    query = descriptors(patch, len(row))
    return np.stack([column, row], axis=1), query, alike(query, 10 * patch)[0]


def keypoints() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Keypoints `[n, 2]` px and descriptors of query and reference; the first, a corner of the image, is a match."""
    rng = np.random.default_rng(3)
    query, reference = (rng.integers(0, 4 * np.array(SIZE), (80, 2)) / 4 for _ in range(2))
    query[0] = np.array(SIZE) - 0.25
    features0 = descriptors(4, 80)
    features1, rows = alike(features0, 5)
    moved = np.arange(80) % 2 == 0  # half of the matches have a shift in common
    reference[moved] = np.clip(query[rows[moved]] + [24.5, -7.25], 0, np.array(SIZE) - 1)
    features1[rows == 0] = features0[0]
    return query.astype(np.float32), features0, reference.astype(np.float32), features1


def layouts() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Cells `[n]` of corresponding points in reference and query, and dense descriptors `[cells, D]` of both."""
    rng = np.random.default_rng(6)
    reference = rng.integers(0, LAYOUT[0] * LAYOUT[1], 60)
    query = np.where(rng.integers(0, 2, 60) == 1, reference, rng.integers(0, LAYOUT[0] * LAYOUT[1], 60))
    dense = descriptors(7, LAYOUT[0] * LAYOUT[1], 8)
    blended = dense + 0.5 * descriptors(8, LAYOUT[0] * LAYOUT[1], 8)
    return reference, query, dense, blended
