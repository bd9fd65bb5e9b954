"""Checks of an evaluation: its arguments, candidates of user-defined retrievals, scores, and images."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from mfvpr.datasets.datasets import ImageFolder
from mfvpr.features.extractor import Extractor, Source
from mfvpr.features.feature_set import FeatureSet
from mfvpr.features.sift import Sift
from mfvpr.matching.lightglue import LightGlueMatcher
from mfvpr.matching.matcher import Matcher, NearestNeighborMatcher
from mfvpr.matching.nearest_neighbors import CrossCheck
from mfvpr.reranking.fusion import Fusion
from mfvpr.reranking.ranking import Ties
from mfvpr.reranking.results import COHORT, FRAMES, RETRIEVAL, Matched, Ranked
from mfvpr.retrieval.retriever import RetrievalResult
from mfvpr.scoring.fields import check_bounds
from mfvpr.scoring.registry import SCORERS
from mfvpr.types import Shortlist
from mfvpr.utils.errors import InputError, require_word


def check_request(
    scorers: Mapping[str, Any], fused: Mapping[str, Fusion], correlated: Iterable[str], ties: Ties,
    memory: float | None, *, cohort: bool = False,
) -> None:  # fmt: skip
    """Raise `InputError` if an argument of `mfvpr.evaluate` that concerns scores cannot be used.

    `cohort` = whether there is one.
    """
    require_word("ties", ties, Ties)
    if memory is not None and not 0 < memory < math.inf:
        raise InputError(f"memory={memory!r}: expected GB above 0, or None")
    with_cohort = [f"{name} + {COHORT}" for name in scorers] if cohort else []
    alone = [*scorers, *with_cohort]
    for name, how in fused.items():
        how.check(name, alone)
    combined = [how.system(name) for name, how in fused.items()]
    several = {*alone, *combined}
    if unknown := [name for name in correlated if name not in several]:
        raise InputError(f"correlated: expected names of scorers ({', '.join(several) or 'there are none'}), got "
                         f"{unknown[0]}")  # fmt: skip
    reserved = {RETRIEVAL, *with_cohort, *combined, *(f"{system} + {FRAMES}" for system in correlated)}
    for name, scorer in scorers.items():
        if name in reserved:
            raise InputError(f"scorers: {name} is the name of another system; choose another one")
        if isinstance(scorer, type) or not callable(scorer):
            got = f"the class {scorer.__name__}; write {scorer.__name__}(...)" if isinstance(scorer, type) else scorer
            raise InputError(f"scorers: expected {name} to map Matches to a score, got {got}")
        if type(scorer) in SCORERS.values():
            check_bounds(scorer)


def check_matching(candidates: Any, extractor: Extractor | Source, matcher: Matcher) -> None:
    """Raise `InputError` if an argument of `mfvpr.evaluate` that concerns matches cannot be used."""
    is_whole = isinstance(candidates, int | np.integer) and not isinstance(candidates, bool)
    if candidates != "all" and not (is_whole and candidates >= 1):
        raise InputError(f"candidates={candidates!r}: expected a whole number from 1, or 'all'")
    if not extractor.scales:
        raise InputError(f"{type(extractor).__name__}: gives no local features; expected an extractor that does")
    if isinstance(matcher, type) or not callable(matcher):
        got = f"the class {matcher.__name__}" if isinstance(matcher, type) else repr(matcher)
        raise InputError(f"matcher: expected what maps the features of two images to Matches, got {got}; see "
                         "mfvpr.Matcher")  # fmt: skip
    if isinstance(matcher, NearestNeighborMatcher):
        require_word("cross_check", matcher.cross_check, CrossCheck)
    if isinstance(matcher, LightGlueMatcher):
        for name in ("filter_threshold", "depth_confidence"):
            if (share := getattr(matcher, name)) is not None and not 0 <= share <= 1:
                raise InputError(f"{name}={share}: expected a number from 0 to 1")
        dimensions = [scale.dimension for scale in extractor.scales if scale.dimension]  # 0 = not known
        if isinstance(extractor, Sift) or {*dimensions} - {matcher.dimension}:
            got = f"{type(extractor).__name__} of {', '.join(map(str, dimensions))}"
            raise InputError(f"LightGlue: expected ALIKED's features, of {matcher.dimension} dimensions, got {got}; "
                             "extract these, or match nearest neighbors")  # fmt: skip


def validate_candidates(
    retrieved: Any, name: str, num_queries: int, num_database: int, num_candidates: int
) -> RetrievalResult:
    """Check the candidates of a retrieval, which may be user-defined; return them padded with -1 and 0.

    Raises:
        InputError: no RetrievalResult, or no Shortlist of the expected shape in it, rows that the database lacks, or a
            row twice for one query. The error has the `name` of the retrieval.
    """
    if not isinstance(retrieved, RetrievalResult):
        raise InputError(f"{name}: expected a RetrievalResult, got {type(retrieved).__name__}; return "
                         "RetrievalResult(shortlist, {}, {})")  # fmt: skip
    shortlist = retrieved.candidates
    if not isinstance(shortlist, Shortlist):
        raise InputError(
            f"{name}: expected a Shortlist as the candidates of RetrievalResult, got {type(shortlist).__name__}"
        )
    indices, scores, mask = (np.asarray(part) for part in (shortlist.indices, shortlist.scores, shortlist.mask))
    expected = (num_queries, num_candidates)
    if {indices.shape, scores.shape, mask.shape} != {expected} or mask.dtype != bool or indices.dtype.kind not in "iu":
        shapes = f"{list(indices.shape)}, {list(scores.shape)} and {list(mask.shape)}"
        raise InputError(f"{name}: expected indices (whole), scores and mask (bool) of {list(expected)} each, got "
                         f"{shapes}; pad with -1")  # fmt: skip
    if not ((indices[mask] >= 0) & (indices[mask] < num_database)).all():
        raise InputError(f"{name}: expected rows of the database from 0 to {num_database - 1}, got "
                         f"{indices[mask].min()} to {indices[mask].max()}")  # fmt: skip
    ordered = np.sort(np.where(mask, indices, -1), axis=1)
    if (is_repeated := (ordered[:, 1:] == ordered[:, :-1]) & (ordered[:, 1:] >= 0)).any():
        query, place = np.argwhere(is_repeated)[0]
        raise InputError(f"{name}: expected every row of the database once, got {ordered[query, place]} twice for "
                         f"query {query}")  # fmt: skip
    if not np.isfinite(scores[mask]).all():
        raise InputError(f"{name}: expected finite scores")
    indices, scores = np.where(mask, indices, -1).astype(np.int32), np.where(mask, scores, 0).astype(np.float32)
    return retrieved._replace(candidates=Shortlist(indices, scores, mask))


def image_warnings(folder: ImageFolder, features: FeatureSet, bad: Mapping[int, str]) -> Iterator[str]:
    """Warnings of bad images, which rank last, and of images without keypoints, which have no matches."""
    yield from bad.values()
    counts = np.asarray(features.source.counts)
    if empty := [row for row in np.flatnonzero(counts == 0).tolist() if row not in bad]:
        yield (f"{folder.paths[empty[0]]}: no keypoints, so no matches ({len(empty)} such images of {len(folder)}); "
               "scores are 0")  # fmt: skip


def score_warnings(
    matched: Sequence[Matched], ranked: Sequence[Mapping[str, Ranked]], scorers: Iterable[str]
) -> Iterator[str]:
    """Warnings of NaN and infinite scores of every sequence, for example if a user-defined scorer divides by 0.

    Raises:
        InputError: every score of a scorer is NaN, infinite, or 0, the score of pairs without matches.
    """
    for name in scorers:
        values = np.concatenate([systems[name].scores[systems[name].rows >= 0] for systems in ranked])
        if not np.isfinite(values).all() and not values[np.isfinite(values)].any():
            raise InputError(f"{name}: every score of a pair that has matches is NaN or infinite; check what the "
                             "scorer expects of features and sizes")  # fmt: skip
    for sequence, systems in zip(matched, ranked, strict=True):
        for name, system in systems.items():
            values = system.scores[system.rows >= 0]
            if number := int(np.isnan(values).sum()):
                yield f"{sequence.sequence.name}: {number} scores of {name} are NaN, and rank last"
            if number := int(np.isinf(values).sum()):
                yield f"{sequence.sequence.name}: {number} scores of {name} are infinite"
