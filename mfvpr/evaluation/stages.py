"""The stages of re-ranking a data set: match, score, explain. `mfvpr.evaluation.fusion` fuses and ranks.

Files and threads stay on the host; each computation is one compiled program per shape.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from mfvpr.core.batch import BIN_STEP
from mfvpr.core.histogram import HistogramOfShifts, ShiftHistogram
from mfvpr.core.scorer import fit_capacities
from mfvpr.core.types import Array, Matches, Shortlist
from mfvpr.core.weights import match_weights
from mfvpr.evaluation.batched_scoring import score
from mfvpr.features.feature_set import FeatureSet, memory_budget
from mfvpr.matchers import batched_matching as batched
from mfvpr.matchers import host_matcher as host
from mfvpr.matchers.host_matcher import PairSource, Side
from mfvpr.matchers.match_set import MatchSet, QueryMatches, Scales
from mfvpr.matchers.matcher import NEIGHBORS, Matcher
from mfvpr.storage.cache_files import MatchStore, StoredMatches
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import Device, at_least_single, compiled, device_of
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
    queries: Side,
    database: Side,
    candidates: Shortlist,
    matcher: Matcher | PairSource = NEIGHBORS,
    *,
    store: MatchStore | None = None,
    rows: Sequence[int] | None = None,
    runtime: Runtime = DEFAULT_RUNTIME,
) -> MatchSet:
    """Match every query with its candidates. Matches of compiled matchers include their ratio, which some weights use.

    Args:
        queries: features of Q images; or the images, if that is what the matcher takes.
        database: likewise, of M images.
        candidates: `[Q, C]` rows of the database.
        matcher: of one pair; one that runs on the host takes no part in a cluster.
        store: of these features, candidates and matcher. Queries that it lacks, or has with other candidates, are
            matched and written in small batches; the result is read from it.
        rows: of the queries that are matched and returned; None = all.
        runtime: devices that share the queries, memory, progress over queries, and workers that match for a store.

    Raises:
        InputError: the two sides' descriptors have different lengths, or the disk cannot be used.
    """
    if isinstance(queries, FeatureSet) and isinstance(database, FeatureSet):
        _require_same_dimensions(queries, database)
    sides, requested = (queries, database, candidates), range(len(queries)) if rows is None else rows
    limits = runtime.memory, runtime.devices
    if store is None:
        results = replace(runtime, cluster=None).map(
            _match_queries, (*sides, matcher, limits), requested, "matching", batched.QUERIES
        )
        matched = [query for _, query in results]
        shape = len(matched), candidates.indices.shape[1]
        counts = np.array([query.counts for query in matched], np.int32).reshape(shape)
        return MatchSet.of([query.matches for query in matched], counts)
    missing = [
        row
        for row, query in store.read(requested)
        if query is None or not np.array_equal(query.indices, candidates.indices[row])
    ]
    if missing:
        if isinstance(matcher, PairSource):
            runtime = replace(runtime, cluster=None)
        if runtime.cluster is not None:
            limits = runtime.memory or WORKER_MEMORY, None
        results = runtime.map(_match_queries, (*sides, matcher, limits), missing, "matching", batched.QUERIES)
        together = 1 if isinstance(matcher, PairSource) else STORE_BATCH  # on the host, a query may take minutes
        while batch := dict(itertools.islice(results, together)):
            store.write(batch)
    if (stored := stored_matches(store, rows, memory=runtime.memory)) is None:
        raise InputError(f"{store.folder}: matches were removed or damaged meanwhile; run again")
    return stored[0]


def _match_queries(
    queries: Any,
    database: Any,
    candidates: Shortlist,
    matcher: Matcher | PairSource,
    limits: Limits,
    rows: Sequence[int],
) -> Iterator[tuple[int, QueryMatches]]:
    """(row, matches) of queries, in the order of `rows`, within limits of memory and devices."""
    sides, (memory, devices) = (queries, database, candidates), limits
    if isinstance(matcher, PairSource):
        return host.match_queries(*sides, rows, matcher)
    return batched.match_queries(*sides, rows, matcher, memory=memory, devices=devices or [device_of(())])


def _require_same_dimensions(queries: FeatureSet, database: FeatureSet) -> None:
    if (queries.counts > 0).any() and (database.counts > 0).any() and queries.dimension != database.dimension:
        got = f"{queries.dimension} and {database.dimension} (database); extract all images alike"
        raise InputError(f"features: expected as many dimensions on both sides, got {got}")


def stored_matches(
    store: MatchStore, rows: Sequence[int] | None = None, *, memory: float | None = None
) -> tuple[MatchSet, Shortlist] | None:
    """Matches and shortlist from a store, NumPy; None if some are missing or damaged.

    Matches of more than `memory` GB (None: a third of what is free) stay on disk.
    """
    rows, matches, shortlist = range(store.num_queries) if rows is None else rows, list[Matches](), list[Any]()
    left = memory_budget(memory, jax.local_devices(backend="cpu")[:1])
    for _, query in store.read(rows):
        if query is None:
            return None
        left -= sum(leaf.nbytes for leaf in jax.tree.leaves(query.matches))
        matches.append(query.matches)
        if left < 0:
            matches.clear()
        shortlist.append((query.counts, query.indices, query.filter_scores))
    counts, indices, scores = (np.stack(values) for values in zip(*shortlist, strict=True))
    return MatchSet.of(matches or StoredMatches(store, rows), counts), Shortlist(indices, scores, indices >= 0)


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
    fitted = fit_capacities(scorer, matches.image_size0, matches.image_size1, multiple=BIN_STEP)
    return Explanation(*jax.tree.map(np.asarray, _explain(fitted, matches)), direction=scorer.direction)


@compiled
def _explain(scorer: HistogramOfShifts, matches: Matches) -> tuple[Any, ...]:
    shift, peak = scorer.dominant_shift(matches), scorer.dominant_shift(matches, refine=True)
    weights = match_weights(scorer.weight, matches)
    return scorer.histogram(matches), scorer(matches), shift, peak, weights, scorer.agrees(matches, peak)


def dominant_shifts(
    scorer: HistogramOfShifts,
    match_set: MatchSet,
    queries: Int[np.ndarray, " pairs"],
    places: Int[np.ndarray, " pairs"],
) -> tuple[Float[np.ndarray, "pairs 2"], Float[np.ndarray, "pairs 2 2"], Float[np.ndarray, "pairs 2"]]:
    """Shifts from the center of a query to the same point in a candidate, with their intervals; one program.

    Returns:
        Refined dominant shifts (candidate minus query), and their 95 % intervals (low, high); NaN if no match votes.
        Half the width of an interval is that of `HistogramOfShifts.shift_interval` and `SHIFT_FLOOR` of the resized
        query's longer side, in quadrature. At last the sizes (width, height) of the resized queries, to whose px they
        refer.
    """
    fitted = fit_capacities(scorer, *match_set.image_sizes, multiple=BIN_STEP)
    shifts, intervals, sizes = (np.zeros((len(queries), *shape)) for shape in ((2,), (2, 2), (2,)))
    for start in range(0, len(queries), SHIFTS_AT_ONCE):
        part = slice(start, min(start + SHIFTS_AT_ONCE, len(queries)))
        pairs = match_set.pairs(queries[part], places[part], match_set.capacity, total=SHIFTS_AT_ONCE)
        number = part.stop - start
        shifts[part], intervals[part] = (values[:number] for values in pair_shifts(fitted, pairs))
        sizes[part] = pairs.image_size0[:number]
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
        shift, low, high = shifts
        floor = SHIFT_FLOOR * at_least_single(pair.image_size0).max()
        half = jnp.sqrt(((high - low) / 2) ** 2 + floor**2)
        return votes, shift, (low + high)[None] / 2 + jnp.stack([-half, half])

    return jax.vmap(of_pair)(matches)
