"""Scores of whole data sets: matches go pair by pair, whatever query they belong to, in batches on all devices."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from functools import partial
from threading import Lock
from typing import Any

import jax
import numpy as np

from mfvpr.matching.match_set import MatchSet, Scales, batches, partition, queries_that_fit, scales
from mfvpr.reranking.grids import score_settings
from mfvpr.reranking.ranking import BIN_STEP, fuse_scales
from mfvpr.scoring.parameters import fit
from mfvpr.scoring.scorer import Scorer, check_host, on_host, score_pairs
from mfvpr.types import Array, Matches, Shortlist
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import Device, available_cpus, compiled, held, knows_own_context
from mfvpr.utils.progress import Track, untracked
from mfvpr.utils.threads import ordered_map

PaddedBatch = tuple[np.ndarray, Matches]  # places [n] of its pairs, and their Matches [P, K, ...]


def score(
    scorers: Mapping[str, Scorer], match_set: MatchSet | Scales, candidates: Shortlist, *,
    devices: Sequence[Device] | None = None, track: Track = untracked,
) -> dict[str, np.ndarray]:  # fmt: skip
    """Scores `[Q, C]` float32 of every query's candidates by each scorer; NaN where there is no candidate.

    All scorers are one program for each shape of a batch, which other parameter values use again (histograms: within a
    capacity of 8 bins). A pair without matches scores 0.

    Args:
        scorers: by name.
        match_set: matches of Q queries with C candidates; those of several scales are scored one by one and fused.
        candidates: their shortlist.
        devices: that share the batches, which changes no bit of the scores; None = the one that JAX takes.
        track: progress, over batches.
    """
    if not scorers:
        return {}
    for scorer in scorers.values():
        check_host(scorer)
    num_queries, sets = len(candidates.mask), scales(match_set)
    size = queries_that_fit(match_set, len(scorers))
    parts = [range(start, min(start + size, num_queries)) for start in range(0, num_queries, size)]
    fitted = held(fit(dict(scorers), *match_set.image_sizes, multiple=BIN_STEP))
    scores = {name: np.zeros((len(sets), *candidates.mask.shape), np.float32) for name in scorers}

    def made() -> Iterator[tuple[range, np.ndarray, dict[str, np.ndarray]]]:
        for part in parts:
            part_batches = all_batches(match_set, part, settings=1)
            for places, values in scored(_score_all, (fitted,), part_batches, devices=devices):
                yield part, places, values

    total = sum(len(partition(one, part, settings=1)) for one in sets for part in parts)
    for part, places, values in track(made(), total):
        scale, query, place = np.unravel_index(places, (len(sets), len(part), candidates.mask.shape[1]))
        for name, of_pairs in values.items():
            scores[name][scale, part.start + query, place] = of_pairs
    fused = {name: fuse_all(match_set, by_scale, candidates.mask) for name, by_scale in scores.items()}
    return {name: np.where(candidates.mask, values, np.nan) for name, values in fused.items()}


def all_batches(match_set: MatchSet | Scales, queries: range, *, settings: float) -> Iterator[PaddedBatch]:
    """Those of some q queries and every scale, see `match_sets.batches`; places are in the flattened `[S, q, C]`."""
    for scale, one in enumerate(scales(match_set)):
        pairs = len(queries) * one.counts.shape[1]
        for places, matches in batches(one, queries, settings=settings):
            yield scale * pairs + places, matches


def scored(
    program: Callable[..., Any], inputs: tuple, batches: Iterable[PaddedBatch], *, devices: Sequence[Device] | None
) -> Iterator[tuple[np.ndarray, Any]]:
    """(places `[n]`, arrays `[..., n]`) of every batch, in their order, NumPy.

    Args:
        program: of Matches `[P, K, ...]` and the inputs, gives arrays `[..., P]`.
        inputs: arrays, and what holds some.
        batches: of few shapes; only a few are held at a time.
        devices: that take turns; None = the one that JAX takes.
    """
    turns = [partial(jax.device_put, device=device) for device in devices or ()] or [_as_it_is]
    own = [put(inputs) for put in turns]
    known: set[tuple] = set()
    compiling: dict[tuple, Lock] = {}

    def score(numbered: tuple[int, PaddedBatch]) -> tuple[np.ndarray, Any]:
        number, (places, matches) = numbered
        turn = number % len(turns)
        key = turn, matches.mask.shape
        # The first batch of a shape compiles: those that come meanwhile wait for it.
        with nullcontext() if key in known else compiling.setdefault(key, Lock()):
            values = program(turns[turn](matches), *own[turn])
        known.add(key)
        return places, jax.tree.map(lambda of_pairs: np.asarray(of_pairs)[..., : len(places)], values)

    # Products this small keep one core busy: as many batches at a time as there are cores.
    workers = max(available_cpus(), len(turns))
    spread = partial(ordered_map, workers=workers) if knows_own_context() else map
    return iter(spread(score, enumerate(batches)))


def fuse_all(match_set: MatchSet | Scales, scores: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Scores `[..., Q, C]` of candidates `mask` `[Q, C]`, out of those of every scale `[S, ..., Q, C]`."""
    if not isinstance(match_set, Scales):
        return scores[0]
    weights = None if match_set.weights is None else np.asarray(match_set.weights, np.float32)
    return np.asarray(fuse_scales(np.moveaxis(scores, 0, -1), mask, weights, normalize=match_set.normalize))


def _score_all(matches: Matches, scorers: dict[str, Scorer]) -> dict[str, Array]:
    elsewhere = {name: scorer for name, scorer in scorers.items() if on_host(scorer)}
    scores = _in_jax(matches, {name: scorer for name, scorer in scorers.items() if name not in elsewhere})
    return scores | {name: score_pairs(scorer, matches) for name, scorer in elsewhere.items()}


@compiled
def _in_jax(matches: Matches, scorers: dict[str, Scorer]) -> dict[str, Array]:
    scores = {name: score_settings(scorer, matches, {}, {})[0, 0] for name, scorer in scorers.items()}
    for name, values in scores.items():
        if values.shape != matches.mask.shape[:1]:
            raise InputError(f"{name}: expected a number for each pair, got an array {list(values.shape[1:])}")
    return scores


def _as_it_is(tree: Any) -> Any:
    return tree
