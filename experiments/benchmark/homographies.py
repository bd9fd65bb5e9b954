"""Homographies of one query's candidates: mfvpr's RANSAC in one batch beside OpenCV's, which goes pair by pair."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import jax
import numpy as np

import mfvpr
from experiments.benchmark.harness import Entry, Lineup, Results, Seconds, compete
from mfvpr.types import Matches

PAIRS, MATCHES, SLOTS, SIZE = 50, 300, 320, 336
SHARES = (0.1, 0.3, 0.6)  # of inliers
THRESHOLDS = (8.0, 24.0)  # px, the paper's
NOISE = 2.0  # px
PLANE = np.array([[1.05, 0.05, 8.0], [-0.03, 0.97, -5.0], [1e-4, -5e-5, 1.0]])
OPTIONS = {"maxIters": 2000, "confidence": 0.995}

Points = list[tuple[np.ndarray, np.ndarray]]  # of the candidates, of the query


def run(rounds: int | None, out: Path) -> None:
    """Everyone, at every share and threshold."""
    lineup = Lineup(
        title=f"1 query x {PAIRS} candidates, {MATCHES} matches a pair, at most {OPTIONS['maxIters']} samples",
        setting={"pairs": PAIRS, "matches_per_pair": MATCHES, "noise_px": NOISE, **OPTIONS},
        entries=[*entries()],
        rounds=7,
        remarks=_remarks,
    )
    compete(lineup, rounds, out)


def entries() -> Iterator[Entry]:
    """By share of inliers and threshold; each returns the inliers of every pair."""
    for share in SHARES:
        pairs = made_up(share)
        matches = as_matches(pairs)
        for threshold in THRESHOLDS:
            step = f"{share:.0%} inliers, {threshold:g} px"
            yield step, "mfvpr", _batched(mfvpr.Homography(threshold), matches)
            yield step, "mfvpr, refit", _batched(mfvpr.Homography(threshold, refit=True), matches)
            yield step, "OpenCV RANSAC", _one_by_one(cv2.RANSAC, threshold, pairs)
            yield step, "OpenCV RANSAC, on threads", _batched(mfvpr.OpenCvHomography(threshold), matches)
            yield step, "OpenCV MAGSAC", _one_by_one(cv2.USAC_MAGSAC, threshold, pairs)


def made_up(share: float, seed: int = 0) -> Points:
    """Pairs of which a share of the matches lies on one plane, up to noise; the others are anywhere."""
    rng, pairs = np.random.default_rng(seed), []
    for _ in range(PAIRS):
        points1 = rng.uniform(0, SIZE, (MATCHES, 2))
        moved = np.concatenate([points1, np.ones((MATCHES, 1))], axis=1) @ PLANE.T
        points0 = moved[:, :2] / moved[:, 2:] + rng.normal(0, NOISE, (MATCHES, 2))
        wrong = rng.permutation(MATCHES)[round(share * MATCHES) :]
        points0[wrong] = rng.uniform(0, SIZE, (len(wrong), 2))
        pairs.append((points1.astype(np.float32), points0.astype(np.float32)))
    return pairs


def as_matches(pairs: Points) -> Matches:
    """`[P, SLOTS, ...]`, on the device."""
    padding = SLOTS - MATCHES
    points1, points0 = (np.pad(np.stack(side), ((0, 0), (0, padding), (0, 0))) for side in zip(*pairs, strict=True))
    number = np.ones(points0.shape[:2], np.float32)
    size = np.full((len(pairs), 2), SIZE, np.float32)
    mask = np.broadcast_to(np.arange(SLOTS) < MATCHES, number.shape)
    index = np.broadcast_to(np.arange(SLOTS, dtype=np.int32), number.shape)
    matches = Matches(points0, points1, number, number, number, mask, size, size, index0=index)
    return jax.device_put(matches)


def _batched(scorer: Any, matches: Matches) -> Callable[[], Any]:
    return lambda: jax.block_until_ready(mfvpr.score_candidates(scorer, matches))


def _one_by_one(estimator: int, threshold: float, pairs: Points) -> Callable[[], Any]:
    def counts() -> list[int]:
        found = (cv2.findHomography(*points, estimator, threshold, **OPTIONS)[1] for points in pairs)
        return [0 if inliers is None else int(inliers.sum()) for inliers in found]

    return counts


def _remarks(_: Seconds, results: Results) -> Iterator[str]:
    yield "inliers of a pair, mean:"
    steps: dict[str, list[str]] = {}
    for (step, who), counts in results.items():
        steps.setdefault(step, []).append(f"{who} {np.mean(counts):.1f}")
    yield from (f"  {step}: {', '.join(found)}" for step, found in steps.items())
