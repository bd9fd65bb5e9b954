"""The whole way over a data set: extract and describe (`mfvpr.extraction`), shortlist, match, score, rank.

Files and threads stay on the host; each computation is one compiled program per shape, called for every query. Here is
where `jit` lives. `track` wraps the iterable of a stage: a progress bar, or nothing.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import jax
import numpy as np

from mfvpr import matching, reranking, retrieval
from mfvpr.errors import InputError
from mfvpr.extraction import FeatureSet, Track, describe, extract, untracked
from mfvpr.matching import CrossCheck
from mfvpr.numerics import round_up
from mfvpr.scoring import HistogramOfShifts, Scorer, ShiftHistogram
from mfvpr.types import Array, Features, Matches, Shortlist
from mfvpr.weighting import match_weights

__all__ = ["Explanation", "FeatureSet", "MatchSet", "Track", "describe", "explain", "extract", "fuse", "match", "rank",
           "score", "shortlist", "untracked"]  # fmt: skip

MAX_BINS = 1024  # per axis: the histograms of 50 candidates then take 200 MB
_PER_MATCH = ("points0", "points1", "distance", "scores0", "scores1")


@dataclass(frozen=True)
class MatchSet:
    """Matches of every query with its candidates, without padding.

    Attributes:
        matches: per query, the real matches of all candidates one after the other; image sizes `[C, 2]`.
        counts: `[Q, C]` matches of each candidate.
        capacity: slots that hold every pair's matches.
    """

    matches: Sequence[Matches]
    counts: np.ndarray
    capacity: int

    def __getitem__(self, query: int) -> Matches:
        """Matches `[C, K, ...]` of one query, padded with zeros to the capacity."""
        mask = np.arange(self.capacity) < self.counts[query][:, None]
        flat = self.matches[query]

        def padded(values: np.ndarray) -> np.ndarray:
            slots = np.zeros((*mask.shape, *values.shape[1:]), values.dtype)
            slots[mask] = values
            return slots

        return replace(flat, mask=mask, **{name: padded(getattr(flat, name)) for name in _PER_MATCH})


def shortlist(query_descriptors: np.ndarray, database_descriptors: np.ndarray, num_candidates: int) -> Shortlist:
    """The filter's candidates of all queries `[Q, C]`, NumPy."""
    return jax.tree.map(np.asarray, _retrieve(query_descriptors, database_descriptors, num_candidates=num_candidates))


def match(
    queries: FeatureSet,
    database: FeatureSet,
    candidates: Shortlist,
    *,
    cross_check: CrossCheck = "mutual",
    max_distance: float | None = None,
    max_matches: int | None = None,
    chunk_size: int | None = None,
    track: Track = untracked,
) -> MatchSet:
    """Matches of every query with its candidates; options as in `mfvpr.matching`."""
    device_database = jax.device_put(database.features)
    options = {"cross_check": cross_check, "max_matches": max_matches, "chunk_size": chunk_size}
    flat, counts = [], []
    for row in track(range(len(queries)), len(queries)):
        found = _match(queries[row], device_database, candidates.indices[row], max_distance, **options)
        found = jax.tree.map(np.asarray, found)
        counts.append(found.mask.sum(axis=1))
        flat.append(replace(found, **{name: getattr(found, name)[found.mask] for name in _PER_MATCH}))
    counts = np.array(counts)
    return MatchSet(flat, counts, round_up(int(counts.max(initial=0)), 64))


def score(
    scorers: Mapping[str, Scorer], match_set: MatchSet, candidates: Shortlist, *, track: Track = untracked
) -> dict[str, np.ndarray]:
    """Scores `[Q, C]` of every query's candidates by each scorer; NaN where there is no candidate.

    All scorers are one program, which other parameter values use again (histograms: within a capacity of 16 bins).
    """
    first = match_set.matches[0]
    prepared = {name: _prepare(scorer, first) for name, scorer in scorers.items()}
    queries = range(len(match_set.matches))
    rows = [_score(prepared, match_set[query]) for query in track(queries, len(queries))]
    scores = {name: np.array([row[name] for row in rows]) for name in scorers}
    return {name: np.where(candidates.mask, values, np.nan) for name, values in scores.items()}


@dataclass(frozen=True)
class Explanation:
    """What a histogram says of one pair, NumPy.

    Attributes:
        histogram: all bins `[B, B]` (-inf beyond the range of shifts) with their centers, px.
        score: the tallest bin.
        shift: `[2]` its center (x, y), px.
        peak: `[2]` the refined peak between bin centers, px.
        weights: `[K]` of the matches.
        agrees: `[K]` whether a match's shift lies within two standard deviations of the peak along both axes.
    """

    histogram: ShiftHistogram
    score: Array
    shift: Array
    peak: Array
    weights: Array
    agrees: Array


def explain(scorer: HistogramOfShifts, matches: Matches) -> Explanation:
    """The parts of one pair's score, for figures and for steering; one program for all pairs."""
    return Explanation(*jax.tree.map(np.asarray, _explain(_prepare(scorer, matches), matches)))


def fuse(candidates: Shortlist, scores: np.ndarray, c: float | None, *, euclidean: bool = False) -> np.ndarray:
    """Combined scores `[Q, C]` of filter and re-ranking.

    Args:
        candidates: the filter's, with their cosine similarities.
        scores: `[Q, C]` of the re-ranking.
        c: weight of the filter; None balances the spread of both per query.
        euclidean: the filter's score is minus the Euclidean distance of the unit descriptors instead.
    """
    cosine = candidates.scores
    filter_scores = -np.sqrt(np.maximum(2 - 2 * cosine, 0)) if euclidean else cosine
    return np.asarray(_fuse(filter_scores, scores, candidates.mask, c))


def rank(candidates: Shortlist, scores: np.ndarray, *, ties: Literal["filter", "index"] = "filter") -> np.ndarray:
    """Positions `[Q, C]` into the shortlist, best first, those without a candidate last.

    Equal scores keep the filter's order, or go by database index.
    """
    return np.asarray(_rank(scores, candidates.mask, tie_break=candidates.indices if ties == "index" else None))


_retrieve = jax.jit(retrieval.retrieve, static_argnames="num_candidates")
_rank = jax.jit(reranking.rank)


@partial(jax.jit, static_argnames=("cross_check", "max_matches", "chunk_size"))
def _match(
    query: Features,
    database: Features,
    indices: Array,
    max_distance: Array | None,
    *,
    cross_check: CrossCheck,
    max_matches: int | None,
    chunk_size: int | None,
) -> Matches:
    found = matching.match_shortlist(query, database, indices, cross_check=cross_check, chunk_size=chunk_size)
    keep = partial(matching.filter_matches, max_distance=max_distance, max_matches=max_matches)
    return jax.vmap(keep)(found)


@jax.jit
def _score(scorers: dict[str, Scorer], matches: Matches) -> dict[str, Array]:
    return {name: reranking.score_candidates(scorer, matches) for name, scorer in scorers.items()}


@jax.jit
def _fuse(filter_scores: Array, scores: Array, mask: Array, c: Array | None) -> Array:
    if c is None:
        c = jax.vmap(reranking.balancing_c)(filter_scores, scores, mask)[:, None]
    return reranking.combine(filter_scores, scores, c=c)


@jax.jit
def _explain(scorer: HistogramOfShifts, matches: Matches) -> tuple[Any, ...]:
    shift, peak = scorer.dominant_shift(matches), scorer.dominant_shift(matches, refine=True)
    weights = match_weights(scorer.weight, matches)
    return scorer.histogram(matches), scorer(matches), shift, peak, weights, scorer.agrees(matches, peak)


def _prepare(scorer: Any, matches: Matches) -> Any:
    """A scorer whose numbers are float32 arrays (one type, one program) and whose histogram has a capacity."""
    if isinstance(scorer, HistogramOfShifts):
        needed = scorer.with_capacity(matches.image_size0, matches.image_size1).max_bins or 1
        if needed > MAX_BINS:
            raise InputError(
                f"bin_size={scorer.bin_size}: expected at most {MAX_BINS} bins per axis, these images need {needed}; "
                "use larger bins"
            )
        if scorer.max_bins is None:
            scorer = replace(scorer, max_bins=round_up(needed, 16))
        elif scorer.max_bins < needed:
            raise InputError(f"max_bins={scorer.max_bins}: expected at least {needed}, which these images need")
    return jax.tree.map(np.float32, scorer)
