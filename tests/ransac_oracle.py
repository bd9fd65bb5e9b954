"""RANSAC by loops in double precision, sample by sample, from the samples that the library draws."""

import itertools
import math

import jax
import numpy as np

from mfvpr.baselines import homography


def estimate(points1, points0, *, threshold, max_iterations=2000, confidence=0.995, seed=0):
    """(inliers `[n]` bool, samples looked at, errors `[n]`) of real matches in the order of their samples, px."""
    points1, points0 = np.asarray(points1, np.float64), np.asarray(points0, np.float64)
    count = len(points1)
    best, samples, limit = (np.zeros(count, bool), np.full(count, np.inf)), 0, max_iterations
    for round_number in itertools.count():
        drawn = np.asarray(homography.draw_four(jax.random.key(seed), round_number, np.int32(count)))
        accepted = [four for four in drawn.T if keeps_orientation(points1[four], points0[four])][: homography.ROUND]
        for four in accepted:
            if samples >= limit:
                return best[0], samples, best[1]
            samples += 1
            errors = np.linalg.norm(mapped(through(points1[four], points0[four]), points1) - points0, axis=1)
            inliers = errors <= threshold
            if inliers.sum() > max(best[0].sum(), 3):
                best, limit = (inliers, errors), needed(inliers.sum() / count, confidence, max_iterations)
        if not accepted or samples >= limit:
            return best[0], samples, best[1]


def needed(share, confidence, max_iterations):
    """As in OpenCV's RANSACUpdateNumIters."""
    if share == 1:
        return 0
    wrong = math.log(1 - share**4)
    return (
        max_iterations
        if -math.log(1 - confidence) >= -max_iterations * wrong
        else round(math.log(1 - confidence) / wrong)
    )


def keeps_orientation(first, second):
    """Whether the triangles of four points all keep, or all change, their orientation, and none is flat."""
    first, second = first.tolist(), second.tolist()
    signs = set()
    for triangle in itertools.combinations(range(4), 3):
        turns = [area(*(points[corner] for corner in triangle)) for points in (first, second)]
        signs.add(math.copysign(1, turns[0] * turns[1]) if all(turns) else 0)
    return signs in ({1}, {-1})


def area(a, b, c):
    """Twice the signed area of a triangle."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def through(first, second):
    """`[3, 3]` homography through four matches: eight linear equations."""
    rows, right = [], []
    for (x, y), (u, v) in zip(first, second, strict=True):
        rows += [[x, y, 1, 0, 0, 0, -u * x, -u * y], [0, 0, 0, x, y, 1, -v * x, -v * y]]
        right += [u, v]
    return np.append(np.linalg.solve(rows, right), 1).reshape(3, 3)


def mapped(matrix, points):
    """`[n, 2]` where a homography takes points."""
    moved = np.concatenate([points, np.ones((len(points), 1))], axis=1) @ np.asarray(matrix).T
    return moved[:, :2] / moved[:, 2:]
