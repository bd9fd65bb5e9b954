"""Makes relatives.npz: scores of public codes. `python -m tests.golden relatives PATCHNETVLAD RERANKING LOSTX`

The arguments are clones of https://github.com/QVPR/Patch-NetVLAD, https://github.com/gbarbarani/re-ranking-for-VPR and
https://github.com/oravus/lostX, whose functions are called with the inputs below.
"""

import importlib
import sys
import tempfile

import numpy as np

from tests.golden.torch_networks import replace_module

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


def main(patch_netvlad: str, reranking: str, lostx: str) -> dict[str, np.ndarray]:
    golden = {"patch_netvlad": _patch_netvlad(patch_netvlad), "reranking": _reranking(reranking)}
    return golden | _lost(lostx)


def _patch_netvlad(clone: str) -> np.ndarray:
    """`[patch sizes]`: the smaller the better."""
    import torch

    sys.path.insert(0, clone)
    from patchnetvlad.tools.patch_matcher import PatchMatcher

    places = place_patches()
    for size, (_, indices) in zip(PATCHES, places, strict=True):
        np.testing.assert_array_equal(indices.T, patches(size)[0])
    matcher = PatchMatcher("spatialApproximator", PATCHES, [1] * len(PATCHES), *zip(*places, strict=True))
    features = [patches(size)[1:] for size in PATCHES]
    scores, _, _ = matcher.match(
        [torch.from_numpy(query) for query, _ in features], [torch.from_numpy(reference.T) for _, reference in features]
    )
    return np.array(scores)


def place_patches() -> list[tuple[np.ndarray, np.ndarray]]:
    """Keypoints and places on the map of Patch-NetVLAD's patches, by size."""
    from patchnetvlad.models.local_matcher import calc_keypoint_centers_from_patches

    config = {"imageresizeH": 16 * MAP[0], "imageresizeW": 16 * MAP[1]}
    return [calc_keypoint_centers_from_patches(config, size, size, 1, 1) for size in PATCHES]


def _reranking(clone: str) -> np.ndarray:
    """`[]`: the smaller the better."""
    import torch

    replace_module("models", __path__=[f"{clone}/src/models"])  # without those beside it, which need more
    points0, features0, points1, features1 = (torch.from_numpy(part) for part in keypoints())
    inputs = {"descriptors0": features0.T[None], "descriptors1": features1.T[None]}
    scorer = importlib.import_module("models.rapid").RAPID()
    return np.array(scorer(inputs | {"keypoints0": points0[None], "keypoints1": points1[None]})["score"])


def _lost(clone: str) -> dict[str, np.ndarray]:
    """`[]` by form and direction of view: the smaller the better."""
    sys.path.insert(0, f"{clone}/lost_kc")
    import match_lost_kc
    from scipy.spatial.distance import cosine

    # As SciPy's did itself when this code was written.
    match_lost_kc.cosine = lambda u, v: cosine(np.squeeze(u), np.squeeze(v))
    reference, query, dense, other = layouts()
    labels, golden = np.zeros((1, *LAYOUT)), {}
    with tempfile.TemporaryDirectory() as folder:
        paths = {"denseDesPath1": f"{folder}/reference", "denseDesPath2": f"{folder}/query"}
        for path, maps in zip(paths.values(), (dense, other), strict=True):
            np.savez(f"{path}0000000.npz", maps.T.reshape(-1, *LAYOUT))
        for mirrored in (False, True):
            for form, files in (("weighted", paths), ("unweighted", {})):
                options = {"flipFlag": mirrored, "preLoadDenseDescRef": False, **files}
                inputs = labels, labels, reference[None], query[None], 1, np.ones((1, 1))
                matrix = match_lost_kc.getSpatialCheckMat(*inputs, **options)
                golden[f"lost/{form}/{mirrored}"] = matrix[0, 1]
    return golden
