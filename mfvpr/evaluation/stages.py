"""The stages of re-ranking a data set: match, score, explain. `mfvpr.evaluation.fusion` fuses and ranks.

Files and threads stay on the host; each computation is one compiled program per shape.
"""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from mfvpr.core.batch import BIN_STEP
from mfvpr.core.histogram import HistogramOfShifts, ShiftHistogram
from mfvpr.core.parameters import with_capacity
from mfvpr.core.types import Array, Matches, Shortlist
from mfvpr.core.weights import match_weights
from mfvpr.evaluation.batched_scoring import score
from mfvpr.features.feature_set import FeatureSet, memory_budget
from mfvpr.matchers import batched_matching as batched
from mfvpr.matchers import host_matcher as host
from mfvpr.matchers.host_matcher import PairSource, Side
from mfvpr.matchers.match_set import MatchSet, QueryMatches, Scales
from mfvpr.matchers.matcher import NEIGHBORS, Matcher
from mfvpr.storage.matches import MatchStore, StoredMatches
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import Device, at_least_single, compiled, device_of
from mfvpr.utils.progress import Track, no_progress
from mfvpr.utils.runtime import DEFAULT_RUNTIME, Runtime

__all__ = ["Explanation", "FeatureSet", "MatchSet", "Scales", "explain", "match", "score", "stored_matches"]

SHIFTS_AT_ONCE = 64  # pairs
STORE_BATCH = 8  # queries whose matches may be lost when a run is killed
# Half the width of the 95 % interval of a shift if all votes agree, as a share of the image's longer side: near and
# far things move differently, and matches on one wall err together. Chosen on the synthetic street of seed 0.
SHIFT_FLOOR = 0.03
WORKER_MEMORY = 2.0  # GB, as several workers may share a machine
Limits = tuple[float | None, Sequence[Device] | None]  # of memory, GB, and devices


def match(
    queries: Side, database: Side, candidates: Shortlist, matcher: Matcher | PairSource = NEIGHBORS, *,
    store: MatchStore | None = None, rows: Sequence[int] | None = None, runtime: Runtime = DEFAULT_RUNTIME,
) -> MatchSet:  # fmt: skip
    """Match every query with its candidates. Matches of compiled matchers include their ratio, which some weights use.

    Args:
        queries: features of Q images; or the images, if that is what the matcher takes.
        database: likewise, of M images.
        candidates: `[Q, C]` rows of the database.
        matcher: of one pair; one that runs on the host takes no part in a cluster.
        store: of these features, candidates and matcher. Queries that it lacks are matched and written in small
            batches; the result is read from it.
        rows: of the queries that are matched and returned; None = all.
        runtime: devices that share the queries, memory, progress over queries, and workers that match for a store.

    Raises:
        InputError: the two sides' descriptors have different lengths; or the store cannot be used or has other
            candidates, and then nothing is written.
    """
    if isinstance(queries, FeatureSet) and isinstance(database, FeatureSet):
        _require_same_dimensions(queries, database)
    sides, requested = (queries, database, candidates), range(len(queries)) if rows is None else rows
    if store is None:
        pairs = _match_queries(sides, requested, matcher, (runtime.memory, runtime.devices))
        matched = [query for _, query in runtime.progress("matching")(pairs, len(requested))]
        shape = len(matched), candidates.indices.shape[1]
        counts = np.array([query.counts for query in matched], np.int32).reshape(shape)
        return MatchSet.of([query.matches for query in matched], counts)
    if missing := [row for row in requested if not store.done[row]]:
        stored = {row: query.indices for row, query in store.read()}
        _require_candidates(store, candidates, stored)  # before anything is written
        runtime = replace(runtime, cluster=None) if isinstance(matcher, PairSource) else runtime
        here, at_workers = (runtime.memory, runtime.devices), (runtime.memory or WORKER_MEMORY, None)
        shared = sides, matcher, here if runtime.cluster is None else at_workers, store
        for block, counts in runtime.map(_match_rows, shared, missing, "matching", batched.QUERIES):
            store.counts[block] = counts
    match_set, shortlist = stored_matches(store, rows, memory=runtime.memory)
    if not missing:
        _require_candidates(store, candidates, dict(zip(requested, shortlist.indices, strict=True)))
    return match_set


def _match_rows(
    sides: tuple[Side, Side, Shortlist], matcher: Matcher | PairSource, limits: Limits, store: MatchStore,
    rows: Sequence[int], track: Track = no_progress,
) -> tuple[Sequence[int], np.ndarray]:  # fmt: skip
    """Write the matches of queries to a store within limits of memory and devices; returns rows and numbers."""
    missing = [row for row in rows if not store.done[row]]
    tracked = iter(track(_match_queries(sides, missing, matcher, limits), len(missing)))
    together = 1 if isinstance(matcher, PairSource) else STORE_BATCH  # on the host, a query may take minutes
    while batch := dict(itertools.islice(tracked, together)):
        store.write(batch)
    return rows, store.counts[rows]


def _match_queries(
    sides: tuple[Any, Any, Shortlist], rows: Sequence[int], matcher: Matcher | PairSource, limits: Limits
) -> Iterator[tuple[int, QueryMatches]]:
    """(row, matches) of queries, in the order of `rows`."""
    if isinstance(matcher, PairSource):
        return host.match_queries(*sides, rows, matcher)
    memory, devices = limits
    return batched.match_queries(*sides, rows, matcher, memory=memory, devices=devices or [device_of(())])


def _require_same_dimensions(queries: FeatureSet, database: FeatureSet) -> None:
    if (queries.counts > 0).any() and (database.counts > 0).any() and queries.dimension != database.dimension:
        raise InputError(f"features: expected as many dimensions on both sides, got {queries.dimension} "
                         f"and {database.dimension} (database); extract all images alike")  # fmt: skip


def _require_candidates(store: MatchStore, candidates: Shortlist, stored: Mapping[int, np.ndarray]) -> None:
    """Raise unless the candidates of the stored rows are `candidates`."""
    same_shape = candidates.indices.shape == tuple(store.sizes.values())
    if not same_shape or any((indices != candidates.indices[row]).any() for row, indices in stored.items()):
        raise InputError(
            f"{store.folder}: expected matches of these candidates, got those of another shortlist; choose another "
            "path, or delete this folder"
        )


def stored_matches(
    store: MatchStore, rows: Sequence[int] | None = None, *, memory: float | None = None
) -> tuple[MatchSet, Shortlist]:
    """Matches and shortlist from a store, NumPy; more than `memory` GB (None: a third of what is free) stay on disk."""
    rows = range(len(store.done)) if rows is None else rows
    if not (done := store.done[[*rows]]).all():
        raise InputError(
            f"{store.folder}: expected the matches of all {len(done)} queries, got {done.sum()}; finish the matching "
            "first"
        )
    left, matches = memory_budget(memory, jax.local_devices(backend="cpu")[:1]), []
    shape = len(rows), store.sizes["num_candidates"]
    counts, indices, scores = (np.zeros(shape, dtype) for dtype in (np.int32, np.int32, np.float32))
    for place, (_, row) in enumerate(store.read(rows)):
        left -= sum(leaf.nbytes for leaf in jax.tree.leaves(row.matches))
        matches.append(row.matches)
        if left < 0:
            matches.clear()
        counts[place], indices[place], scores[place] = row.counts, row.indices, row.filter_scores
    shortlist = Shortlist(indices=indices, scores=scores, mask=indices >= 0)
    return MatchSet.of(matches or StoredMatches(store, rows), counts), shortlist


@dataclass(frozen=True)
class Explanation:
    """The histogram of one pair and its parts, NumPy."""

    histogram: ShiftHistogram  # all bins (-inf beyond the range of shifts) with their centers, px
    score: Float[Array, ""]  # the tallest bin
    shift: Float[Array, "2"]  # its center (x, y), px
    peak: Float[Array, "2"]  # the refined peak between bin centers, px
    weights: Float[Array, " slots"]
    agrees: Bool[Array, " slots"]  # whether a shift lies within two standard deviations of the peak along both axes
    direction: str  # of the shifts, as the scorer defines it


def explain(scorer: HistogramOfShifts, matches: Matches) -> Explanation:
    """The parts of one pair's score, for figures and for steering; one program for all pairs."""
    fitted = with_capacity(scorer, matches.image_size0, matches.image_size1, multiple=BIN_STEP)
    return Explanation(*jax.tree.map(np.asarray, _explain(fitted, matches)), direction=scorer.direction)


@compiled
def _explain(scorer: HistogramOfShifts, matches: Matches) -> tuple[Any, ...]:
    shift, peak = scorer.dominant_shift(matches), scorer.dominant_shift(matches, refine=True)
    weights = match_weights(scorer.weight, matches)
    return scorer.histogram(matches), scorer(matches), shift, peak, weights, scorer.agrees(matches, peak)


def dominant_shifts(
    scorer: HistogramOfShifts, match_set: MatchSet,
    queries: Int[np.ndarray, " pairs"], places: Int[np.ndarray, " pairs"],
) -> tuple[Float[np.ndarray, "pairs 2"], Float[np.ndarray, "pairs 2 2"], Float[np.ndarray, "pairs 2"]]:  # fmt: skip
    """Shifts from the center of a query to the same point in a candidate, with their intervals; one program.

    Returns:
        Refined dominant shifts (candidate minus query), and their 95 % intervals (low, high); NaN if no match votes.
        Half the width of an interval is that of `HistogramOfShifts.shift_interval` and `SHIFT_FLOOR` of the resized
        query's longer side, in quadrature. At last the sizes (width, height) of the resized queries, to whose px they
        refer.
    """
    fitted = with_capacity(scorer, *match_set.image_sizes, multiple=BIN_STEP)
    parts = [(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros((0, 2)))]
    for start in range(0, len(queries), SHIFTS_AT_ONCE):
        part = slice(start, start + SHIFTS_AT_ONCE)
        pairs = match_set.pairs(queries[part], places[part], match_set.capacity, total=SHIFTS_AT_ONCE)
        values = (*pair_shifts(fitted, pairs), np.asarray(pairs.image_size0))
        shifts, intervals, sizes = (each[: len(queries[part])] for each in values)
        parts.append((shifts, intervals, sizes))
    shifts, intervals, sizes = map(np.concatenate, zip(*parts, strict=True))
    return shifts, intervals, sizes


def pair_shifts(
    scorer: HistogramOfShifts, matches: Matches
) -> tuple[Float[np.ndarray, "pairs 2"], Float[np.ndarray, "pairs 2 2"]]:
    """`dominant_shifts` of matches `[P, K, ...]`, by a scorer with the capacity for their images."""
    votes, *values = jax.tree.map(np.array, _pair_shifts(scorer, matches))
    for of_pairs in values:  # the host makes the NaN: `jax_debug_nans` stops at those of programs
        of_pairs[~votes] = np.nan
    shifts, intervals = values
    return shifts, intervals


@compiled
def _pair_shifts(scorer: HistogramOfShifts, matches: Matches) -> tuple[Array, Array, Array]:
    """Whether any match votes `[P]`, and `pair_shifts`, 0 without votes."""

    def of_pair(pair: Matches) -> tuple[Array, Array, Array]:
        votes = scorer(pair) > 0
        shifts = jnp.concatenate([scorer.dominant_shift(pair, refine=True)[None], scorer.shift_interval(pair)])
        if scorer.direction == "query_minus_candidate":
            shifts = -shifts[jnp.array([0, 2, 1])]
        shifts = jnp.where(votes, shifts, 0.0)
        interval = _widened(shifts[1:], SHIFT_FLOOR * at_least_single(pair.image_size0).max())
        return votes, shifts[0], interval

    return jax.vmap(of_pair)(matches)


def _widened(interval: Float[Array, "2 2"], floor: Float[Array, ""]) -> Float[Array, "2 2"]:
    """An interval (low, high) whose half widths, (x, y), are added to `floor` in quadrature."""
    low, high = interval
    half = jnp.sqrt(((high - low) / 2) ** 2 + floor**2)
    return (low + high)[None] / 2 + jnp.stack([-half, half])
