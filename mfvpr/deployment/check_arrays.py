"""Made-up inputs of an exported program, on which every implementation must agree."""

import numpy as np

from mfvpr.deployment.programs import Program

SEED = 0


def check_inputs(program: Program) -> dict[str, np.ndarray]:
    """Inputs by name: candidates of one place, each less precise than the one before, the last without matches."""
    shapes = program.shapes
    rng, size = np.random.default_rng(SEED), np.asarray(shapes.image_size, np.float32)
    lengths = shapes.candidates, shapes.keypoints
    spread = 0.01 * (1 + np.arange(shapes.candidates))[:, None, None]  # of image size and descriptors
    points0 = rng.uniform(size=(shapes.keypoints, 2)) * size
    points1 = np.clip(points0 + 0.05 * size + spread * size * rng.normal(size=(*lengths, 2)), 0, size)
    descriptors0 = _unit(rng.normal(size=(shapes.keypoints, shapes.dimension or 1)))
    descriptors1 = _unit(descriptors0 + spread * rng.normal(size=(*lengths, shapes.dimension or 1)))
    mask = rng.uniform(size=lengths) < 0.9
    mask[-1] = shapes.candidates == 1
    numbers = np.broadcast_to(np.arange(shapes.keypoints), lengths)
    scores0 = rng.uniform(0.1, 1, shapes.keypoints)
    values = {
        "points0": np.broadcast_to(points0, (*lengths, 2)),
        "points1": points1,
        "mask": mask,
        "distance": rng.uniform(0, 1, lengths),
        "ratio": rng.uniform(0.5, 1, lengths),
        "confidence": np.linspace(0, 1, lengths[0] * lengths[1]).reshape(lengths),
        "scores0": scores0,
        "scores1": rng.uniform(0.1, 1, lengths),
        "image_size0": size,
        "image_size1": np.broadcast_to(size, (shapes.candidates, 2)),
        "index0": numbers,
        "index1": numbers,
        "count0": shapes.keypoints,
        "count1": np.full(lengths[0], lengths[1]),
        "keypoints0": points0,
        "descriptors0": descriptors0,
        "mask0": rng.uniform(size=shapes.keypoints) < 0.9,
        "keypoints1": points1,
        "descriptors1": descriptors1,
        "mask1": mask,
    }
    return {
        each.name: np.array(np.broadcast_to(values[each.name], each.shape), each.dtype, order="C")
        for each in program.inputs
    }


def _unit(rows: np.ndarray) -> np.ndarray:
    return rows / np.linalg.norm(rows, axis=-1, keepdims=True)


def largest_difference(arrays: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> float:
    """Largest difference of finite outputs, relative where they are above 1; infinite if NaN differ."""
    differences = [0.0]
    for name, values in expected.items():
        if not np.array_equal(np.isfinite(arrays[name]), finite := np.isfinite(values)):
            return np.inf
        difference = np.abs(arrays[name][finite] - values[finite]) / np.maximum(np.abs(values[finite]), 1)
        differences.append(float(np.max(difference, initial=0.0)))
    return max(differences)
