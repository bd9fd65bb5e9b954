"""Inputs of patch_scores.npz, which Patch-NetVLAD's code has scored and ranked, see README.md."""

import numpy as np

from tests.golden.make_relatives import MAP

WEIGHTS = (0.45, 0.15, 0.4)  # of the sizes of patches
DIMENSION = 32
# Of candidates, so alike that RANSAC needs no luck: how far they are moved (columns, rows), and how many of the patches
# show the place; None = one color.
CANDIDATES = (((0, 0), 0.9), ((1, 0), 0.8), ((-1, 0), 0.9), ((0, -1), 0.7), ((3, 0), 0.9), ((0, 0), None))


def descriptors(patch: int) -> tuple[np.ndarray, np.ndarray]:
    """`[n, D]` of the query's patches and `[C, n, D]` of the candidates', float32 of unit length, by rows."""
    rng, edge = np.random.default_rng(patch), 4
    rows, columns = (side - patch + 1 for side in MAP)
    world = rng.normal(size=(rows + 2 * edge, columns + 2 * edge, DIMENSION))
    candidates = []
    for (right, down), share in CANDIDATES:
        seen = world[edge + down : edge + down + rows, edge + right : edge + right + columns]
        other, noise = rng.normal(size=(2, *seen.shape))
        shows = rng.random((rows, columns, 1)) < (share or 0)
        candidates.append(np.where(shows, seen + 0.2 * noise, other if share else world[:1, :1]))
    query = world[edge : edge + rows, edge : edge + columns]
    every = np.stack([query, *candidates]).reshape(1 + len(candidates), rows * columns, DIMENSION)
    every = (every / np.linalg.norm(every, axis=-1, keepdims=True)).astype(np.float32)
    return every[0], every[1:]
