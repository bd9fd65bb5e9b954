"""The stages of re-ranking a data set: match, score in batches on all devices, explain. `rankings` fuses and ranks.

Files and threads stay on the host; each computation is one compiled program per shape.
"""

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from threading import Lock
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, Num

from mfvpr.core.batch import BIN_STEP, score_settings
from mfvpr.core.histogram import HistogramOfShifts, ShiftHistogram
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
from mfvpr.core.weights import match_weights
from mfvpr.evaluation.rankings import Scores, fuse_scales
from mfvpr.features.feature_set import memory_budget
from mfvpr.matchers import host_matcher as host
from mfvpr.matchers.host_matcher import PairSource, Side
from mfvpr.matchers.match_set import (
    QUERIES,
    MatchSet,
    QueryMatches,
    Scales,
    batches,
    match_queries,
    partition,
    queries_that_fit,
    scales,
)
from mfvpr.matchers.matcher import NEIGHBORS, Matcher
from mfvpr.storage.cache_files import MatchStore
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import Device, at_least_single, available_cpus, compiled, device_of, knows_own_context
from mfvpr.utils.runtime import DEFAULT_RUNTIME, Runtime, ordered_map

SHIFTS_AT_ONCE = 64  # pairs
STORE_BATCH = 8  # queries whose matches may be lost when a run is killed
# Half the width of the 95 % interval of a shift if all votes agree, as a share of the image's longer side: near and
# far things move differently, and matches on one wall err together. Chosen on the synthetic street of seed 0.
SHIFT_FLOOR = 0.03
WORKER_MEMORY = 2.0  # GB, as several workers may share a machine

Mask = Bool[np.ndarray, "queries candidates"]
PaddedBatch = tuple[Int[np.ndarray, " _"], Matches]  # positions of its pairs, and their Matches [P, K, ...]


def score(
    scorers: Mapping[str, Scorer],
    match_set: MatchSet | Scales,
    candidates: Shortlist,
    *,
    runtime: Runtime = DEFAULT_RUNTIME,
) -> dict[str, Scores]:
    """Scores, float32, by name of the scorer; NaN without a candidate, 0 without matches.

    All scorers together are one program for each shape of a batch, also for other parameter values (histograms: up to
    the next multiple of 8 bins). Several scales are fused. Devices share the batches without effect on the bits.
    """
    if not scorers:
        return {}
    for scorer in scorers.values():
        check_host(scorer)
    sets, (num_queries, width) = scales(match_set), candidates.mask.shape
    size = queries_that_fit(match_set, len(scorers))
    parts = [range(start, min(start + size, num_queries)) for start in range(0, num_queries, size)]
    fitted = with_static_functions(fit_capacities(dict(scorers), *match_set.image_sizes, multiple=BIN_STEP))
    total = sum(len(partition(scale_set, part, settings=1)) for scale_set in sets for part in parts)
    ticks = iter(runtime.progress("scores")(range(total), total))
    scores = np.zeros((len(scorers), len(sets), num_queries, width), np.float32)
    program = partial(_score_all, [*scorers])
    for part in parts:
        padded, of_part = all_batches(match_set, part, settings=1), scores[:, :, part.start : part.stop]
        of_part[:] = pair_scores(program, (fitted,), padded, of_part.shape, runtime.devices, ticks)
    next(ticks, None)  # ends the progress
    fused = np.where(candidates.mask, fuse_all(match_set, scores, candidates.mask), np.nan)
    return dict(zip(scorers, fused, strict=True))


def pair_scores(
    program: Callable[..., Any],
    inputs: tuple,
    batches: Iterable[PaddedBatch],
    shape: tuple[int, ...],
    devices: Sequence[Device] | None,
    ticks: Iterator[Any],
) -> Float[np.ndarray, "rows scales queries candidates"]:
    """Scores by a program that maps Matches `[P, K, ...]` and inputs to `[..., P]`, R rows; 0 without matches.

    Devices take turns, and each batch takes a tick.
    """
    to_device = [partial(jax.device_put, device=device) for device in devices or ()] or [lambda tree: tree]
    device_inputs = [put(inputs) for put in to_device]
    compiled_shapes: set[tuple] = set()
    compiling: dict[tuple, Lock] = {}

    def run_batch(numbered: tuple[int, PaddedBatch]) -> tuple[np.ndarray, np.ndarray]:
        number, (places, matches) = numbered
        device = number % len(to_device)
        key = device, matches.mask.shape
        # The first batch of a shape compiles; batches of the same shape wait for it.
        with nullcontext() if key in compiled_shapes else compiling.setdefault(key, Lock()):
            values = program(to_device[device](matches), *device_inputs[device])
        compiled_shapes.add(key)
        return places, np.asarray(values)[..., : len(places)].reshape(shape[0], len(places))

    # A batch keeps only one core busy, so that one batch per core runs at the same time.
    workers = max(available_cpus(), len(to_device))
    run_all = partial(ordered_map, workers=workers) if knows_own_context() else map
    scores = np.zeros((shape[0], math.prod(shape[1:])), np.float32)
    for places, values in run_all(run_batch, enumerate(batches)):
        next(ticks, None)
        scores[:, places] = values
    return scores.reshape(shape)


def all_batches(match_set: MatchSet | Scales, queries: range, *, settings: float) -> Iterator[PaddedBatch]:
    """`match_set.batches` of q queries at every scale; positions are in the flattened `[S, q, C]`."""
    for scale, scale_set in enumerate(scales(match_set)):
        first = scale * len(queries) * scale_set.counts.shape[1]
        for places, matches in batches(scale_set, queries, settings=settings):
            yield first + places, matches


def fuse_all(
    match_set: MatchSet | Scales, scores: Num[np.ndarray, "*batch scales queries candidates"], mask: Mask
) -> Float[np.ndarray, "*batch queries candidates"]:
    """Fused scores of all scales."""
    if not isinstance(match_set, Scales):
        return scores[..., 0, :, :]
    weights = None if match_set.weights is None else np.asarray(match_set.weights, np.float32)
    return np.asarray(fuse_scales(np.moveaxis(scores, -3, -1), mask, weights))


def _score_all(
    names: Sequence[str], matches: Matches, scorers: dict[str, Scorer]
) -> Float[np.ndarray, "scorers pairs"]:
    """Scores in the order of the names, which JAX sorts in dictionaries."""
    host_scorers = {name: scorer for name, scorer in scorers.items() if on_host(scorer)}
    scores = _in_jax(matches, {name: scorer for name, scorer in scorers.items() if name not in host_scorers})
    scores |= {name: score_pairs(scorer, matches) for name, scorer in host_scorers.items()}
    return np.stack([np.asarray(scores[name], np.float32) for name in names])


@compiled
def _in_jax(matches: Matches, scorers: dict[str, Scorer]) -> dict[str, Array]:
    scores = {name: score_settings(scorer, matches, {}, {})[0, 0] for name, scorer in scorers.items()}
    for name, values in scores.items():
        require_scores(name, values, len(matches.mask))
    return scores


def match(
    queries: Side,
    database: Side,
    candidates: Shortlist,
    matcher: Matcher | PairSource = NEIGHBORS,
    *,
    store: MatchStore | None = None,
    runtime: Runtime = DEFAULT_RUNTIME,
) -> MatchSet:
    """Match every query with its candidates. Matches of compiled matchers include their ratio, which some weights use.

    Args:
        queries: features of Q images; or the images, if that is what the matcher takes. The database likewise.
        matcher: of one pair; one that runs on the host takes no part in a cluster.
        store: of these features, candidates and matcher. Queries that it lacks, or has with other candidates, are
            matched and written in small batches; the result is read from it.

    Raises:
        InputError: the two sides' descriptors have different lengths, or the disk cannot be used.
    """
    is_on_host = isinstance(matcher, PairSource)
    if store is None or is_on_host:
        runtime = replace(runtime, cluster=None)
    memory, devices = runtime.memory, runtime.devices
    if runtime.cluster is not None:
        memory, devices = runtime.memory or WORKER_MEMORY, None
    shared = queries, database, candidates, matcher, memory, devices
    if store is None:
        results = runtime.map(_match_queries, shared, range(len(queries)), "matching", QUERIES)
        matched = [query for _, query in results]
        counts = np.array([query.counts for query in matched], np.int32).reshape(candidates.indices.shape)
        return MatchSet.of([query.matches for query in matched], counts)
    stored, indices = store.read(), candidates.indices
    missing = [
        row for row, query in enumerate(stored) if query is None or not np.array_equal(query.indices, indices[row])
    ]
    if missing:
        results = runtime.map(_match_queries, shared, missing, "matching", QUERIES)
        together = 1 if is_on_host else STORE_BATCH  # on the host, a query may take minutes
        while batch := dict(itertools.islice(results, together)):
            store.write(batch)
    if (complete := stored_matches(store, memory=runtime.memory)) is None:
        raise InputError(f"{store.folder}: matches were removed or damaged meanwhile; run again")
    return complete[0]


def _match_queries(
    queries: Any,
    database: Any,
    candidates: Shortlist,
    matcher: Any,
    memory: float | None,
    devices: Sequence[Device] | None,
    rows: Sequence[int],
) -> Iterator[tuple[int, QueryMatches]]:
    """(row, matches) of queries, in the order of `rows`, within limits of memory (GB) and devices."""
    if isinstance(matcher, PairSource):
        return host.match_queries(queries, database, candidates, rows, matcher)
    devices = devices or [device_of(())]
    return match_queries(queries, database, candidates, rows, matcher, memory=memory, devices=devices)


def stored_matches(store: MatchStore, *, memory: float | None = None) -> tuple[MatchSet, Shortlist] | None:
    """Matches and shortlist from a store, NumPy; None if some are missing or damaged.

    Matches of more than `memory` GB (None: a third of what is free) stay on disk.
    """
    matches, shortlist = list[Matches](), list[Any]()
    left = memory_budget(memory, jax.local_devices(backend="cpu")[:1])
    for query in store.read():
        if query is None:
            return None
        left -= sum(leaf.nbytes for leaf in jax.tree.leaves(query.matches))
        matches.append(query.matches)
        if left < 0:
            matches.clear()
        shortlist.append((query.counts, query.indices, query.filter_scores))
    counts, indices, scores = (np.stack(values) for values in zip(*shortlist, strict=True))
    return MatchSet.of(matches or store, counts), Shortlist(indices, scores, indices >= 0)


class Explanation(NamedTuple):
    """The histogram of one pair and its parts, NumPy."""

    histogram: ShiftHistogram  # all bins (-inf beyond the range of shifts) with their centers, px
    score: Float[Array, ""]  # the tallest bin
    shift: Float[Array, "2"]  # its center (x, y), px
    peak: Float[Array, "2"]  # the refined peak between bin centers, px
    weights: Float[Array, " slots"]
    agrees: Bool[Array, " slots"]  # whether a shift lies within two standard deviations of the peak along both axes
    direction: Any  # of the shifts, as the scorer defines it


def explain(scorer: HistogramOfShifts, matches: Matches) -> Explanation:
    """The parts of one pair's score, for figures and for steering; one program for all pairs."""
    fitted = fit_capacities(scorer, matches.image_size0, matches.image_size1, multiple=BIN_STEP)
    return jax.tree.map(np.asarray, _explain(fitted, matches))._replace(direction=scorer.direction)


@compiled
def _explain(scorer: HistogramOfShifts, matches: Matches) -> Explanation:
    shift, peak = scorer.dominant_shift(matches), scorer.dominant_shift(matches, refine=True)
    weights, agrees = match_weights(scorer.weight, matches), scorer.agrees(matches, peak)
    return Explanation(scorer.histogram(matches), scorer(matches), shift, peak, weights, agrees, None)


def dominant_shifts(
    scorer: HistogramOfShifts,
    match_set: MatchSet,
    queries: Int[np.ndarray, " pairs"],
    places: Int[np.ndarray, " pairs"],
) -> tuple[Float[np.ndarray, "pairs 2"], Float[np.ndarray, "pairs 2 2"], Float[np.ndarray, "pairs 2"]]:
    """Shifts from the center of a query to the same point in a candidate, with their intervals; one program.

    Returns:
        Refined dominant shifts (candidate minus query), and their 95 % intervals (low, high), NaN if no match votes:
        `HistogramOfShifts.shift_interval` and `SHIFT_FLOOR` in quadrature. Sizes of the resized queries, px.
    """
    fitted = fit_capacities(scorer, *match_set.image_sizes, multiple=BIN_STEP)
    parts = [(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros((0, 2)))]
    for start in range(0, len(queries), SHIFTS_AT_ONCE):
        part = slice(start, start + SHIFTS_AT_ONCE)
        pairs = match_set.pairs(queries[part], places[part], match_set.capacity, total=SHIFTS_AT_ONCE)
        parts.append((*pair_shifts(fitted, pairs), pairs.image_size0))
    shifts, intervals, sizes = (np.concatenate(values)[: len(queries)] for values in zip(*parts, strict=True))
    return shifts, intervals, sizes


@compiled
def pair_shifts(
    scorer: HistogramOfShifts, matches: Matches
) -> tuple[Float[Array, "pairs 2"], Float[Array, "pairs 2 2"]]:
    """`dominant_shifts` of matches `[P, K, ...]`, by a scorer with the capacity for their images."""

    def of_pair(pair: Matches) -> tuple[Array, Array]:
        shifts = jnp.concatenate([scorer.dominant_shift(pair, refine=True)[None], scorer.shift_interval(pair)])
        if scorer.direction == "query_minus_candidate":
            shifts = -shifts[jnp.array([0, 2, 1])]
        shift, low, high = jnp.where(scorer(pair) > 0, shifts, jnp.nan)
        floor = SHIFT_FLOOR * at_least_single(pair.image_size0).max()
        half = jnp.sqrt(((high - low) / 2) ** 2 + floor**2)
        return shift, (low + high)[None] / 2 + jnp.stack([-half, half])

    return jax.vmap(of_pair)(matches)


def require_finite(name: str, scores: np.ndarray) -> None:
    """Raise an InputError if every score of a scorer is NaN, infinite, or 0, the score of pairs without matches."""
    if not np.isfinite(scores).all() and not scores[np.isfinite(scores)].any():
        fix = "check what the scorer expects of features and sizes"
        raise InputError(f"{name}: every score of a pair that has matches is NaN or infinite; {fix}")
