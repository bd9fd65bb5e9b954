"""Checks of an evaluation: its arguments, candidates of user-defined retrievals, scores, and images."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from mfvpr.core.types import Shortlist
from mfvpr.datasets.datasets import ImageFolder
from mfvpr.evaluation.rankings import Matched, Ranked
from mfvpr.features.feature_set import FeatureSet
from mfvpr.retrieval.retriever import RetrievalResult
from mfvpr.utils.errors import InputError


def validate_candidates(
    retrieved: Any, name: str, num_queries: int, num_database: int, num_candidates: int
) -> RetrievalResult:
    """Check the candidates of the retrieval `name`, which may be user-defined; return them padded with -1 and 0."""
    if not isinstance(retrieved, RetrievalResult):
        raise InputError(f"{name}: expected RetrievalResult(shortlist, {{}}, {{}}), got {type(retrieved).__name__}")
    shortlist = retrieved.candidates
    if not isinstance(shortlist, Shortlist):
        raise InputError(f"{name}: expected a Shortlist in RetrievalResult, got {type(shortlist).__name__}")
    indices, scores, mask = (np.asarray(part) for part in (shortlist.indices, shortlist.scores, shortlist.mask))
    expected = (num_queries, num_candidates)
    if {indices.shape, scores.shape, mask.shape} != {expected} or mask.dtype != bool or indices.dtype.kind not in "iu":
        shapes = f"{list(indices.shape)}, {list(scores.shape)} and {list(mask.shape)}"
        parts = f"indices (whole), scores and mask (bool) of {list(expected)} each"
        raise InputError(f"{name}: expected {parts}, got {shapes}; pad with -1")
    if not ((indices[mask] >= 0) & (indices[mask] < num_database)).all():
        got = f"{indices[mask].min()} to {indices[mask].max()}"
        raise InputError(f"{name}: expected rows of the database from 0 to {num_database - 1}, got {got}")
    ordered = np.sort(np.where(mask, indices, -1), axis=1)
    if (is_repeated := (ordered[:, 1:] == ordered[:, :-1]) & (ordered[:, 1:] >= 0)).any():
        query, place = np.argwhere(is_repeated)[0]
        got = f"{ordered[query, place]} twice for query {query}"
        raise InputError(f"{name}: expected every row of the database once, got {got}")
    if not np.isfinite(scores[mask]).all():
        raise InputError(f"{name}: expected finite scores")
    indices, scores = np.where(mask, indices, -1).astype(np.int32), np.where(mask, scores, 0).astype(np.float32)
    return retrieved._replace(candidates=Shortlist(indices, scores, mask))


def image_warnings(folder: ImageFolder, features: FeatureSet, bad: Mapping[int, str]) -> Iterator[str]:
    """Warnings of bad images, which rank last, and of images without keypoints, which have no matches."""
    yield from bad.values()
    counts = np.asarray(features.source.counts)
    if empty := [row for row in np.flatnonzero(counts == 0).tolist() if row not in bad]:
        number = f"{len(empty)} such images of {len(folder)}"
        yield f"{folder.paths[empty[0]]}: no keypoints, so no matches ({number}); scores are 0"


def empty_pairs_warning(name: str, matched: Matched) -> Iterator[str]:
    """Warning if half of the pairs or more have no matches."""
    real = matched.candidates.mask
    empty = int((real & (matched.matches[0].counts == 0)).sum())
    if empty and 2 * empty >= real.sum():
        yield f"{name}: {empty} of {real.sum()} pairs have no matches; they score 0"


def require_finite(name: str, scores: np.ndarray) -> None:
    """Raise an InputError if every score of a scorer is NaN, infinite, or 0, the score of pairs without matches."""
    if not np.isfinite(scores).all() and not scores[np.isfinite(scores)].any():
        fix = "check what the scorer expects of features and sizes"
        raise InputError(f"{name}: every score of a pair that has matches is NaN or infinite; {fix}")


def score_warnings(
    matched: Sequence[Matched], systems: Mapping[str, Sequence[Ranked]], scorers: Iterable[str]
) -> Iterator[str]:
    """Warnings of NaN and infinite scores of every sequence; see also `require_finite`."""
    for name in scorers:
        require_finite(name, np.concatenate([ranked.scores[ranked.rows >= 0] for ranked in systems[name]]))
    for number, sequence in enumerate(matched):
        for name, rankings in systems.items():
            values = rankings[number].scores[rankings[number].rows >= 0]
            if count := int(np.isnan(values).sum()):
                yield f"{sequence.sequence.name}: {count} scores of {name} are NaN, and rank last"
            if count := int(np.isinf(values).sum()):
                yield f"{sequence.sequence.name}: {count} scores of {name} are infinite"
