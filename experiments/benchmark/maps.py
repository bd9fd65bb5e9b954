"""Dense maps of a query and its candidates: SelaVPR's count of matches, Patch-NetVLAD's rapid score, the products."""

from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import mfvpr
from experiments.benchmark.harness import Entry, Lineup, Results, Seconds, compete
from mfvpr.types import Features

# Candidates, rows and columns of the map, dimension: SelaVPR at 224 px, Patch-NetVLAD "speed" at 640 x 480 px.
SELAVPR, SPEED = (50, (61, 61), 128), (100, (26, 36), 512)
COUNT, MATCHING, RAPID = "SelaVPR, matching and count", "Patch-NetVLAD, matching", "Patch-NetVLAD, matching and score"
PRODUCTS = "its products alone"
MFVPR = "mfvpr"


def run(rounds: int | None, out: Path) -> None:
    """Everyone, on one query and its candidates."""
    named = (("SelaVPR", SELAVPR), ("Patch-NetVLAD", SPEED))
    shapes = "; ".join(
        f"{name}: {count} x {rows} x {columns} x {size}" for name, (count, (rows, columns), size) in named
    )
    lineup = Lineup(
        title=f"1 query x candidates: {shapes}",
        setting={"selavpr": SELAVPR, "patch_netvlad": SPEED},
        entries=[*count_entries(made_up(*SELAVPR)), *patch_entries(made_up(*SPEED))],
        rounds=7,
        remarks=list_remarks,
    )
    compete(lineup, rounds, out)


def list_remarks(seconds: Seconds, results: Results) -> Iterator[str]:
    for step in (COUNT, MATCHING):
        pairs = zip(seconds[step, MFVPR], seconds[step, PRODUCTS], strict=True)
        yield f"{step}: {np.median([whole / bare for whole, bare in pairs]):.2f} x {PRODUCTS}"
    pairs = zip(seconds[RAPID, MFVPR], seconds[MATCHING, MFVPR], strict=True)
    yield f"{RAPID}: {np.median([whole / part for whole, part in pairs]):.2f} x the matching"
    for step in (COUNT, RAPID):
        ours, *others = (
            np.asarray(result) for (one, _), result in results.items() if one == step and result is not None
        )
        yield f"{step}: scores that differ: {[int((np.abs(ours - one) > 1e-3 * np.abs(one)).sum()) for one in others]}"


def count_entries(images: tuple[Features, Features]) -> list[Entry]:
    query, candidates = images
    return [
        (COUNT, MFVPR, _ranked(images, mfvpr.MatchCount(single="zero"))),
        (COUNT, PRODUCTS, _products(images)),
        *_of_torch(COUNT, query.descriptors, candidates.descriptors, lambda mutual, _: mutual.sum()),
    ]


def patch_entries(images: tuple[Features, Features]) -> list[Entry]:
    (query, candidates), (_, (rows, columns), _) = images, SPEED
    places = np.asarray(query.keypoints) / 16
    largest = np.array([columns - 1, rows - 1])

    def rapid(mutual: np.ndarray, nearest: np.ndarray) -> float:
        shifts = places[mutual] - places[nearest[mutual]]
        return float(((largest - np.abs(shifts - shifts.mean(axis=0))) ** 2).sum() / len(places))

    scorer = mfvpr.RapidSpatialScore(size=tuple(16.0 * largest), per_feature=True)
    matched = jax.device_put(images)
    return [
        (MATCHING, MFVPR, lambda: jax.block_until_ready(mfvpr.match_candidates(*matched))),
        (MATCHING, PRODUCTS, _products(images)),
        (RAPID, MFVPR, _ranked(images, scorer, 256)),
        *_of_torch(RAPID, query.descriptors, candidates.descriptors, rapid),
    ]


def _ranked(images: tuple[Features, Features], scorer: mfvpr.Scorer, unit: float = 1.0) -> Callable[[], np.ndarray]:
    """Matches and scores `[C]`, in multiples of `unit`."""
    sides = jax.device_put(images)
    return lambda: np.asarray(mfvpr.score_candidates(scorer, mfvpr.match_candidates(*sides))) / unit


def _products(images: tuple[Features, Features]) -> Callable[[], None]:
    """All similarities, of one candidate after the other; nobody looks at them."""
    query, candidates = (jnp.asarray(side.descriptors) for side in images)

    @jax.jit
    def program(query: Any, candidates: Any) -> Any:
        def one(candidate: Any) -> Any:
            similarity = jnp.matmul(query, candidate.T, precision=jax.lax.Precision.HIGHEST)
            return jax.lax.optimization_barrier(similarity)[0, 0]

        return jax.lax.map(one, candidates)

    def products() -> None:
        jax.block_until_ready(program(query, candidates))

    return products


def _of_torch(step: str, query: Any, candidates: Any, score: Callable[..., float]) -> list[Entry]:
    """Mutual matches candidate by candidate, with `score` of (which of the candidate's are, their nearest)."""
    if find_spec("torch") is None:
        return []
    import torch

    sides = torch.from_numpy(np.array(query)), torch.from_numpy(np.array(candidates))

    @torch.inference_mode()
    def scores() -> np.ndarray:
        found = []
        for candidate in sides[1]:
            similarity = candidate @ sides[0].T
            nearest, back = similarity.argmax(1), similarity.argmax(0)
            mutual = back[nearest] == torch.arange(len(candidate))
            found.append(score(mutual.numpy(), nearest.numpy()))
        return np.array(found)

    return [(step, "torch, candidate by candidate", scores)]


def made_up(count: int, shape: tuple[int, int], dimension: int, seed: int = 0) -> tuple[Features, Features]:
    """A query, and candidates that show it more and more, moved by a few positions."""
    rng = np.random.default_rng(seed)
    query, candidates = rng.normal(size=(*shape, dimension)), []
    for share in np.linspace(0, 0.8, count):
        moved = np.roll(query, rng.integers(-4, 5, 2), axis=(0, 1))
        candidates.append(share * moved + (1 - share) * rng.normal(size=query.shape))
    return _features(query[None], 0), _features(np.stack(candidates), slice(None))


def _features(maps: np.ndarray, which: Any) -> Features:
    row, column = np.indices(maps.shape[1:3]).reshape(2, -1)
    rows = maps.reshape(len(maps), -1, maps.shape[-1])
    vectors = (rows / np.linalg.norm(rows, axis=-1, keepdims=True)).astype(np.float32)
    shape = vectors.shape[:2]
    keypoints = np.broadcast_to(16.0 * np.stack([column, row], axis=1), (*shape, 2)).astype(np.float32)
    size = np.full((len(maps), 2), 16.0 * max(maps.shape[1:3]), np.float32)
    every = Features(keypoints, vectors, np.ones(shape, np.float32), np.ones(shape, bool), size)
    return jax.tree.map(lambda values: values[which], every)
