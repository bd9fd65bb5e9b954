"""SSM-VPR's cells of one query and its candidates: mfvpr beside the public program's way, candidate by candidate."""

from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax
import numpy as np

import mfvpr
from experiments.benchmark.harness import Entry, Lineup, Results, Seconds, compete
from mfvpr.types import Features, Matches

CANDIDATES, SIDE, DIMENSION, SIZE = 50, 40, 100, 336
CELLS = SIDE**2
COMMON = 0.6  # of the cells of a candidate show the query, moved by a few cells
NOISE = 1.0
MATCHING, SCORE = "matching", "score"


def run(rounds: int | None, out: Path) -> None:
    """Everyone, on one query and its candidates."""
    query, candidates = made_up()
    lineup = Lineup(
        title=f"1 query x {CANDIDATES} candidates, {SIDE} x {SIDE} cells of {DIMENSION} dimensions",
        setting={"candidates": CANDIDATES, "cells": CELLS, "dimension": DIMENSION},
        entries=entries(query, candidates),
        rounds=9,
        remarks=_remarks,
    )
    compete(lineup, rounds, out)


def _remarks(seconds: Seconds, results: Results) -> list[str]:
    ours, theirs = (np.asarray(results[SCORE, who]) for who in ("mfvpr", "NumPy, patch by patch"))
    return [f"scores that differ: {int((ours != theirs).sum())} of {len(ours)}"]


def entries(query: Features, candidates: Features) -> list[Entry]:
    """By step; scores of the same matches."""
    images = jax.device_put((query, candidates))
    matches = mfvpr.match_candidates(*images, cross_check="candidate")
    index = np.asarray(matches.index0).astype(np.int64).reshape(-1, SIDE, SIDE)
    vectors = query.descriptors.astype(np.float64), candidates.descriptors  # as the program keeps them

    def match() -> list[np.ndarray]:
        return [np.argmin(1 - np.inner(vectors[0], of_candidate), axis=0) for of_candidate in vectors[1]]

    def matched() -> Matches:
        return jax.block_until_ready(mfvpr.match_candidates(*images, cross_check="candidate"))

    scored = _scored(matches)
    return [
        (MATCHING, "mfvpr", matched), (MATCHING, "NumPy, inner product", match), *_of_torch(*vectors),
        (SCORE, "mfvpr", scored(mfvpr.GridAnchors(SIDE))),
        (SCORE, "mfvpr, displacements", scored(mfvpr.GridAnchors(SIDE, wrap=False))),
        (SCORE, "NumPy, patch by patch", lambda: [patch_by_patch(one) for one in index]),
    ]  # fmt: skip


def _scored(matches: Matches) -> Callable[[mfvpr.GridAnchors], Callable[[], Any]]:
    return lambda scorer: lambda: jax.block_until_ready(mfvpr.score_candidates(scorer, matches))


def patch_by_patch(index: np.ndarray) -> int:
    """The score of one candidate `[side, side]` as the public program computes it."""
    side = len(index)
    size = int(0.75 * side)
    size -= size % 2 == 0
    offsets = np.arange(-(size // 2), size // 2 + 1)
    expected = index.reshape(-1, 1, 1) + (side * offsets[:, None] + offsets)
    padded = np.pad(index, size // 2, constant_values=-1000)
    patches = np.lib.stride_tricks.sliding_window_view(padded, (size, size)).reshape(-1, size, size)
    return int(np.count_nonzero(patches == expected))


def _of_torch(query: np.ndarray, candidates: np.ndarray) -> list[Entry]:
    """All candidates in one batch, in single and in half precision, as on the program's GPU path."""
    if find_spec("torch") is None:
        return []
    import torch

    sides = {
        kind: (torch.from_numpy(query).to(kind)[None], torch.from_numpy(candidates).to(kind).mT)
        for kind in (torch.float32, torch.float16)
    }

    @torch.inference_mode()
    def match(kind: torch.dtype) -> torch.Tensor:
        return torch.argmax(torch.matmul(*sides[kind]), dim=1)

    return [
        (MATCHING, "torch, batched", lambda: match(torch.float32)),
        (MATCHING, "torch, batched, float16", lambda: match(torch.float16)),
    ]


def made_up(seed: int = 0) -> tuple[Features, Features]:
    """A query, and candidates most of whose cells show it."""
    rng = np.random.default_rng(seed)
    query, candidates = rng.normal(size=(CELLS, DIMENSION)), []
    for _ in range(CANDIDATES):
        moved = np.roll(query.reshape(SIDE, SIDE, -1), rng.integers(-5, 6, 2), axis=(0, 1)).reshape(query.shape)
        other = rng.normal(size=query.shape)
        shows = rng.random((CELLS, 1)) < COMMON
        candidates.append(np.where(shows, moved + NOISE * other, other))
    return _features(query), _features(np.stack(candidates))


def _features(vectors: np.ndarray) -> Features:
    shape = vectors.shape[:-1]
    points, size = np.zeros((*shape, 2), np.float32), np.full((*shape[:-1], 2), SIZE, np.float32)
    return Features(points, vectors.astype(np.float32), np.ones(shape, np.float32), np.ones(shape, bool), size)
