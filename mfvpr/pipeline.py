"""The whole way over a data set: extract, describe, shortlist, match, score, rank.

Files and threads stay on the host; each computation is one compiled program per shape, called for every query. Here is
where `jit` lives. `track` wraps the iterable of a stage: a progress bar, or nothing.
"""

import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeVar

import jax
import numpy as np

from mfvpr import matching, reranking, retrieval
from mfvpr.data.datasets import ImageFolder
from mfvpr.data.images import Interpolation, ordered_map, read_image, resize
from mfvpr.errors import InputError
from mfvpr.features import GlobalExtractor, LocalExtractor
from mfvpr.matching import CrossCheck
from mfvpr.numerics import pad_rows, round_up
from mfvpr.scoring import HistogramOfShifts, Scorer, ShiftHistogram
from mfvpr.types import Array, Features, Matches, Shortlist
from mfvpr.weighting import match_weights

Item = TypeVar("Item")
Track = Callable[[Iterable[Any], int], Iterable[Any]]

DECODING_THREADS = 4
MAX_BINS = 1024  # per axis: the histograms of 50 candidates then take 200 MB
_PER_MATCH = ("points0", "points1", "distance", "scores0", "scores1")


def untracked(items: Iterable[Item], total: int) -> Iterable[Item]:
    """No progress bar."""
    return items


@dataclass(frozen=True)
class FeatureSet:
    """Local features of all images of a folder.

    Attributes:
        features: `[M, N, ...]`, padded, NumPy.
        bad: reason by row, for images that gave no usable features; their masks are all False.
    """

    features: Features
    bad: Mapping[int, str]

    def __len__(self) -> int:
        return len(self.features.mask)

    def __getitem__(self, row: int) -> Features:
        """Features `[N, ...]` of one image."""
        return jax.tree.map(lambda field: field[row], self.features)


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


def extract(
    folder: ImageFolder, extractor: LocalExtractor, *, skip_bad: bool = False, track: Track = untracked
) -> FeatureSet:
    """Local features of every image; decoding runs on threads meanwhile.

    Args:
        folder: the images.
        extractor: what turns images into Features.
        skip_bad: list unreadable images in `bad` and go on, instead of raising. An image whose features are not
            finite is always listed.
        track: progress.

    Raises:
        InputError: an image cannot be read (unless `skip_bad`), or none can.
    """
    found: dict[int, Features] = {}
    bad: dict[int, str] = {}
    for rows, images in _image_batches(folder, extractor, skip_bad, bad, track):
        for row, features in zip(rows, extractor(images), strict=True):
            if all(np.isfinite(getattr(features, field.name)).all() for field in fields(features)):
                found[row] = features
            else:
                bad[row] = f"{folder.paths[row]}: features are not finite (NaN or infinite); the image ranks last"
    if not found:
        raise InputError(f"{folder.root}: none of {len(folder)} images can be used; the first: {bad[min(bad)]}")
    return FeatureSet(_stack(found, len(folder)), bad)


def describe(
    folder: ImageFolder,
    feature_set: FeatureSet,
    extractor: GlobalExtractor,
    *,
    skip_bad: bool = False,
    track: Track = untracked,
) -> np.ndarray:
    """Global descriptors `[M, D]` float32 of every image; NaN for bad ones, which no shortlist contains."""
    batches: Iterable[tuple[Sequence[int], np.ndarray | None]]
    if extractor.image_size is None:
        batches = ((rows, None) for rows in _batches(track(range(len(folder)), len(folder)), extractor.batch_size))
    else:
        batches = _image_batches(folder, extractor, skip_bad, dict(feature_set.bad), track)
    descriptors = None
    for rows, images in batches:
        batch = extractor(images, [feature_set[row] for row in rows])
        if descriptors is None:
            descriptors = np.full((len(folder), batch.shape[1]), np.nan, np.float32)
        descriptors[list(rows)] = batch
    if descriptors is None:
        raise InputError(f"{folder.root}: none of {len(folder)} images can be described")
    descriptors[list(feature_set.bad)] = np.nan
    return descriptors


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


def _image_batches(
    folder: ImageFolder,
    extractor: LocalExtractor | GlobalExtractor,
    skip_bad: bool,
    bad: dict[int, str],
    track: Track,
) -> Iterator[tuple[list[int], np.ndarray]]:
    """(rows, images `[B, H, W, 3]`) of the readable images; the reasons of the others go into `bad`."""
    if extractor.image_size is None:
        raise ValueError(f"{type(extractor).__name__} reads no images")
    load = partial(_load, size=extractor.image_size, interpolation=extractor.interpolation)

    def readable() -> Iterator[tuple[int, np.ndarray]]:
        for row, image in enumerate(track(ordered_map(load, folder.paths, workers=DECODING_THREADS), len(folder))):
            if isinstance(image, InputError):
                if not skip_bad:
                    raise InputError(f"{image} (or set on_bad_image=skip)")
                bad[row] = str(image)
            else:
                yield row, image

    for batch in _batches(readable(), extractor.batch_size):
        rows, images = zip(*batch, strict=True)
        yield list(rows), np.stack(images)


def _load(path: Path, *, size: tuple[int, int], interpolation: Interpolation) -> np.ndarray | InputError:
    try:
        return resize(read_image(path), size, interpolation)
    except InputError as error:
        return error


def _batches(items: Iterable[Item], size: int) -> Iterator[list[Item]]:
    iterator = iter(items)
    while batch := list(itertools.islice(iterator, size)):
        yield batch


def _stack(found: Mapping[int, Features], num_images: int) -> Features:
    """Padded features of all rows; those not found are empty."""
    sample = next(iter(found.values()))
    empty = jax.tree.map(lambda field: field[:0], replace(sample, image_size=None))
    empty = replace(empty, image_size=sample.image_size)
    rows = [found.get(row, empty) for row in range(num_images)]
    capacity = round_up(max(len(features.mask) for features in rows), 32)

    def padded(name: str) -> np.ndarray:
        return np.stack([pad_rows(getattr(features, name), capacity) for features in rows])

    per_keypoint = {name: padded(name) for name in ("keypoints", "descriptors", "scores", "mask")}
    return Features(**per_keypoint, image_size=np.stack([features.image_size for features in rows]))
