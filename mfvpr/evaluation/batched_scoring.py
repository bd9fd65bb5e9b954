"""Scores of whole data sets: batches of pairs of any query, on all devices."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from functools import partial
from threading import Lock
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float, Int, Num

from mfvpr.core.batch import BIN_STEP, score_settings
from mfvpr.core.scorer import (
    Scorer,
    check_host,
    fit_capacities,
    on_host,
    require_scores,
    score_pairs,
    with_static_functions,
)
from mfvpr.core.types import Array, Matches, Shortlist
from mfvpr.evaluation.shortlist_scores import Scores, fuse_scales
from mfvpr.matchers.match_set import MatchSet, Scales, batches, partition, queries_that_fit, scales
from mfvpr.utils.numerics import Device, available_cpus, compiled, knows_own_context
from mfvpr.utils.runtime import DEFAULT_RUNTIME, Runtime, ordered_map

PaddedBatch = tuple[Int[np.ndarray, " _"], Matches]  # positions of its pairs, and their Matches [P, K, ...]


def score(
    scorers: Mapping[str, Scorer],
    match_set: MatchSet | Scales,
    candidates: Shortlist,
    *,
    runtime: Runtime = DEFAULT_RUNTIME,
) -> dict[str, Scores]:
    """Scores, float32, by name of the scorer; NaN without a candidate, 0 without matches.

    All scorers together are one program for each shape of a batch, which is reused for other parameter values
    (histograms: up to the next multiple of 8 bins). Several scales are scored one by one and fused. The devices of
    `runtime` share the batches, without effect on the bits of the scores.
    """
    if not scorers:
        return {}
    for scorer in scorers.values():
        check_host(scorer)
    num_queries, sets = len(candidates.mask), scales(match_set)
    size = queries_that_fit(match_set, len(scorers))
    parts = [range(start, min(start + size, num_queries)) for start in range(0, num_queries, size)]
    fitted = with_static_functions(fit_capacities(dict(scorers), *match_set.image_sizes, multiple=BIN_STEP))
    scores = {name: np.zeros((len(sets), *candidates.mask.shape), np.float32) for name in scorers}

    def score_parts() -> Iterator[tuple[range, np.ndarray, dict[str, np.ndarray]]]:
        for part in parts:
            part_batches = all_batches(match_set, part, settings=1)
            for places, values in run_batches(_score_all, (fitted,), part_batches, devices=runtime.devices):
                yield part, places, values

    total = sum(len(partition(scale_set, part, settings=1)) for scale_set in sets for part in parts)
    for part, places, values in runtime.progress("scores")(score_parts(), total):
        scale, query, place = np.unravel_index(places, (len(sets), len(part), candidates.mask.shape[1]))
        for name, pair_scores in values.items():
            scores[name][scale, part.start + query, place] = pair_scores
    fused = {name: fuse_all(match_set, by_scale, candidates.mask) for name, by_scale in scores.items()}
    return {name: np.where(candidates.mask, values, np.nan) for name, values in fused.items()}


def all_batches(match_set: MatchSet | Scales, queries: range, *, settings: float) -> Iterator[PaddedBatch]:
    """`match_set.batches` of q queries at every scale; positions are in the flattened `[S, q, C]`."""
    for scale, scale_set in enumerate(scales(match_set)):
        pairs = len(queries) * scale_set.counts.shape[1]
        for places, matches in batches(scale_set, queries, settings=settings):
            yield scale * pairs + places, matches


def run_batches(
    program: Callable[..., Any], inputs: tuple, batches: Iterable[PaddedBatch], *, devices: Sequence[Device] | None
) -> Iterator[tuple[np.ndarray, Any]]:
    """Run a program on every batch: (positions `[n]`, arrays `[..., n]`) in order, NumPy; devices take turns.

    `program` takes Matches `[P, K, ...]` and the inputs, and returns arrays `[..., P]`.
    """
    to_device = [partial(jax.device_put, device=device) for device in devices or ()] or [lambda tree: tree]
    device_inputs = [put(inputs) for put in to_device]
    compiled_shapes: set[tuple] = set()
    compiling: dict[tuple, Lock] = {}

    def run_batch(numbered: tuple[int, PaddedBatch]) -> tuple[np.ndarray, Any]:
        number, (places, matches) = numbered
        device = number % len(to_device)
        key = device, matches.mask.shape
        # The first batch of a shape compiles; batches of the same shape wait for it.
        with nullcontext() if key in compiled_shapes else compiling.setdefault(key, Lock()):
            values = program(to_device[device](matches), *device_inputs[device])
        compiled_shapes.add(key)
        return places, jax.tree.map(lambda leaf: np.asarray(leaf)[..., : len(places)], values)

    # A batch keeps only one core busy, so that one batch per core runs at the same time.
    workers = max(available_cpus(), len(to_device))
    run_all = partial(ordered_map, workers=workers) if knows_own_context() else map
    return iter(run_all(run_batch, enumerate(batches)))


def fuse_all(
    match_set: MatchSet | Scales,
    scores: Num[np.ndarray, "scales *batch queries candidates"],
    mask: Bool[np.ndarray, "queries candidates"],
) -> Float[np.ndarray, "*batch queries candidates"]:
    """Fused scores of all scales."""
    if not isinstance(match_set, Scales):
        return scores[0]
    weights = None if match_set.weights is None else np.asarray(match_set.weights, np.float32)
    return np.asarray(fuse_scales(np.moveaxis(scores, 0, -1), mask, weights, normalize=match_set.normalize))


def _score_all(matches: Matches, scorers: dict[str, Scorer]) -> dict[str, Array]:
    host_scorers = {name: scorer for name, scorer in scorers.items() if on_host(scorer)}
    scores = _in_jax(matches, {name: scorer for name, scorer in scorers.items() if name not in host_scorers})
    return scores | {name: score_pairs(scorer, matches) for name, scorer in host_scorers.items()}


@compiled
def _in_jax(matches: Matches, scorers: dict[str, Scorer]) -> dict[str, Array]:
    scores = {name: score_settings(scorer, matches, {}, {})[0, 0] for name, scorer in scorers.items()}
    for name, values in scores.items():
        require_scores(name, values, len(matches.mask))
    return scores
