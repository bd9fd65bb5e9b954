"""Makes patch_scores.npz: how Patch-NetVLAD's code scores pairs by patches of three sizes, and ranks candidates.

`python -m tests.golden patch_scores CLONE` with a clone of https://github.com/QVPR/Patch-NetVLAD.
"""

import sys
from collections.abc import Iterator
from unittest.mock import MagicMock

import numpy as np

from tests.golden.make_relatives import MAP, PATCHES, place_patches

WEIGHTS = (0.45, 0.15, 0.4)  # of the sizes of patches
DIMENSION = 32
# Of candidates, so alike that RANSAC needs no luck: how far they are moved (columns, rows), and how many of the patches
# show the place; None = one color.
CANDIDATES = (((0, 0), 0.9), ((1, 0), 0.8), ((-1, 0), 0.9), ((0, -1), 0.7), ((3, 0), 0.9), ((0, 0), None))
MATCHERS = ("RANSAC", "spatialApproximator")


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


def main(clone: str) -> dict[str, np.ndarray]:
    sys.path.insert(0, clone)
    return dict(_scores())


def _scores() -> Iterator[tuple[str, np.ndarray]]:
    """Yield by matcher the scores `[C, S]` of all scales, their sums `[C]` for pairs, and over the candidates `[C]`."""
    import torch

    for unused in ("patchnetvlad.tools.datasets", "patchnetvlad.models.models_generic"):
        sys.modules.setdefault(unused, MagicMock())
    from match_two import apply_patch_weights  # pyright: ignore
    from patchnetvlad.models.local_matcher import normalise_func
    from patchnetvlad.tools.patch_matcher import PatchMatcher

    keypoints, indices = zip(*place_patches(), strict=True)
    features = [descriptors(patch) for patch in PATCHES]
    query = [torch.from_numpy(of_query) for of_query, _ in features]
    for name in MATCHERS:
        matcher = PatchMatcher(name, PATCHES, [1] * len(PATCHES), keypoints, indices)
        scores = np.array(
            [
                matcher.match(query, [torch.from_numpy(of_candidates[candidate].T) for _, of_candidates in features])[0]
                for candidate in range(len(CANDIDATES))
            ]
        )
        yield f"{name}/scales", scores
        yield f"{name}/pairs", np.array([apply_patch_weights(of_pair, len(PATCHES), WEIGHTS) for of_pair in scores])
        yield f"{name}/fused", normalise_func(scores, len(PATCHES), WEIGHTS)
