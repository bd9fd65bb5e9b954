"""LightGlue of one query's candidates: mfvpr's in one program beside the public code in torch, pair by pair."""

import sys
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import jax
import numpy as np

import mfvpr
from experiments.benchmark.harness import Entry, Lineup, Results, Seconds, compete
from mfvpr import Features, LightGlueMatching
from mfvpr.checkpoints import entry_of
from mfvpr.checkpoints.files import load
from mfvpr.checkpoints.networks import blueprint, network_of
from mfvpr.utils import InputError

NAME, CANDIDATES, KEYPOINTS, SIZE = "aliked_lightglue", 50, 700, 320
COMMON = 200  # keypoints of the query that a candidate has as well
DEPTHS = {"": None, ", early stop": 0.95}

Made = tuple[Features, Features]  # the query [1, N, ...] and the candidates [C, N, ...], NumPy


def run(rounds: int | None, out: Path, peer: Path | None = None) -> None:
    """A pair, and a query with all candidates; `peer` is a clone of https://github.com/cvg/LightGlue."""
    arrays = load(NAME)
    lineup = Lineup(
        title=f"1 query x {CANDIDATES} candidates, {KEYPOINTS} keypoints each",
        setting={"candidates": CANDIDATES, "keypoints": KEYPOINTS, "weights": NAME},
        entries=[*entries(made_up(), arrays, peer)],
        rounds=3,
        remarks=_remarks,
    )
    compete(lineup, rounds, out)


def made_up(seed: int = 0) -> Made:
    """Images of which each candidate shows a part of the query, moved and disturbed."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, SIZE, (1 + CANDIDATES, KEYPOINTS, 2))
    descriptors = rng.normal(size=(1 + CANDIDATES, KEYPOINTS, 128))
    points[1:, :COMMON] = points[0, :COMMON] + rng.uniform(-20, 20, (CANDIDATES, 1, 2))
    descriptors[1:, :COMMON] = descriptors[0, :COMMON] + rng.normal(0, 0.3, (CANDIDATES, COMMON, 128))
    descriptors /= np.linalg.norm(descriptors, axis=2, keepdims=True)
    ones = np.ones((1 + CANDIDATES, KEYPOINTS))
    sizes = np.full((1 + CANDIDATES, 2), SIZE)
    points, descriptors, ones, sizes = (array.astype(np.float32) for array in (points, descriptors, ones, sizes))
    images = Features(points, descriptors, ones, ones.astype(bool), sizes)
    return jax.tree.map(lambda leaf: leaf[:1], images), jax.tree.map(lambda leaf: leaf[1:], images)


def entries(made: Made, arrays: Any, peer: Path | None) -> Iterator[Entry]:
    """Each returns the matches of every pair, `[n, 2]`."""
    network = blueprint(entry_of(NAME)).filled(arrays)
    theirs = None if peer is None else _public(peer, arrays)
    for stop, depth in DEPTHS.items():
        matcher = LightGlueMatching.of(network, depth_confidence=depth)  # pyright: ignore[reportArgumentType]
        for step, count in (("a pair", 1), (f"a query of {CANDIDATES}", CANDIDATES)):
            yield f"{step}{stop}", "mfvpr", partial(_ours, matcher, jax.device_put(made), count)
            if theirs is not None:
                yield f"{step}{stop}", "public code, torch", partial(_theirs, theirs(depth), made, count)


def _ours(matcher: LightGlueMatching, made: Made, count: int) -> list[np.ndarray]:
    pairs = np.stack([np.zeros(count, np.int32), np.arange(count, dtype=np.int32)], axis=1)
    found = mfvpr.match_pairs(*made, pairs, count, matcher)
    real, rows = np.asarray(found.mask), np.stack([np.asarray(found.index0), np.asarray(found.index1)], axis=2)
    return [rows[place, real[place]] for place in range(count)]


def _public(peer: Path, arrays: Any) -> Callable[[float | None], Any]:
    """The public network with the same weights, by its early stop, without pruning."""
    if not (peer / "lightglue" / "lightglue.py").is_file():
        raise InputError(f"{peer}: expected a clone of https://github.com/cvg/LightGlue")
    sys.path.insert(0, str(peer / "lightglue"))  # one file: the package asks for the libraries of all extractors
    import torch

    from experiments.benchmark.torch_networks import published

    weight = published(arrays, network_of(entry_of(NAME)).table, "cpu", torch.contiguous_format)

    def network(depth: float | None) -> Any:
        options = {"depth_confidence": depth or -1, "width_confidence": -1}
        made = import_module("lightglue").LightGlue(None, input_dim=128, **options).eval()
        keys = [key for key in made.state_dict() if key != "confidence_thresholds"]
        made.load_state_dict({key: weight(key) for key in keys}, strict=False)
        return made

    return network


def _theirs(network: Any, made: Made, count: int) -> list[np.ndarray]:
    import torch

    def image(features: Features, row: int) -> dict[str, Any]:
        names = ("keypoints", "descriptors", "image_size")
        return {name: torch.from_numpy(getattr(features, name)[row : row + 1]) for name in names}

    query, candidates = made
    with torch.inference_mode():
        found = [network({"image0": image(query, 0), "image1": image(candidates, row)}) for row in range(count)]
    return [one["matches"][0].numpy() for one in found]


def _remarks(_: Seconds, results: Results) -> Iterable[str]:
    for (step, who), theirs in results.items():
        if who != "mfvpr":
            ours = results[step, "mfvpr"]
            same = sum(np.array_equal(one, other) for one, other in zip(ours, theirs, strict=True))
            yield f"{step}: {same} of {len(ours)} pairs have the same matches, {np.mean([*map(len, ours)]):.0f} a pair"
