"""What an evaluation is asked for, and what filters of others give: told in one line, before it costs anything."""

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, get_args

import numpy as np

from mfvpr.data.datasets import ImageFolder
from mfvpr.declaration import declared
from mfvpr.errors import InputError
from mfvpr.reranking import Ties
from mfvpr.results import FILTER, Matched, Ranked
from mfvpr.scoring import SCORERS
from mfvpr.sources import FeatureSet
from mfvpr.types import Shortlist


def check_request(
    candidates: Any, scorers: Mapping[str, Any], fused: Collection[str], ties: Any, memory: float | None
) -> None:
    """The arguments of `mfvpr.evaluate`.

    Raises:
        InputError: one cannot be used.
    """
    whole = isinstance(candidates, int | np.integer) and not isinstance(candidates, bool)
    if candidates != "all" and not (whole and candidates >= 1):
        raise InputError(f"candidates={candidates!r}: expected a whole number from 1, or 'all'")
    if ties not in get_args(Ties):
        raise InputError(f"ties={ties!r}: expected one of {', '.join(get_args(Ties))}")
    if memory is not None and not 0 < memory < math.inf:
        raise InputError(f"memory={memory!r}: expected GB above 0, or None")
    if unknown := [name for name in fused if name not in scorers]:
        raise InputError(
            f"fused: expected names of scorers ({', '.join(scorers) or 'there are none'}), got {unknown[0]}"
        )
    if taken := [name for name in scorers if name in {FILTER, *(f"{other} + {FILTER}" for other in fused)}]:
        raise InputError(f"scorers: {taken[0]} is the name of another system; choose another one")
    for name, scorer in scorers.items():
        if type(scorer) in SCORERS.values():
            _check_numbers(name, scorer)


def _check_numbers(name: str, scorer: Any) -> None:
    for field, parameter in declared(scorer).items():
        value, (low, high) = getattr(scorer, field), parameter.bounds
        if parameter.choices or value is None:
            continue
        values, low = np.ravel(np.asarray(value, float)), 0 if parameter.length else low
        if not ((values >= low) & (values <= high) | (values == parameter.none)).all():
            raise InputError(f"{name}: {field}={value}: expected numbers from {low:g} to {high:g}")


def check_shortlist(shortlist: Any, who: str, num_queries: int, num_database: int, num_candidates: int) -> Shortlist:
    """Candidates as a filter of somebody's own gives them, with -1 and 0 as padding.

    Args:
        shortlist: of the filter.
        who: the filter's name.
        num_queries: Q.
        num_database: N.
        num_candidates: C.

    Raises:
        InputError: no Shortlist `[Q, C]`, rows that the database lacks, or a row twice for one query.
    """
    if not isinstance(shortlist, Shortlist):
        raise InputError(f"{who}: expected a Shortlist as the candidates of Filtered, got {type(shortlist).__name__}")
    indices, scores, mask = (np.asarray(part) for part in (shortlist.indices, shortlist.scores, shortlist.mask))
    expected = (num_queries, num_candidates)
    if {indices.shape, scores.shape, mask.shape} != {expected} or mask.dtype != bool or indices.dtype.kind not in "iu":
        shapes = f"{list(indices.shape)}, {list(scores.shape)} and {list(mask.shape)}"
        raise InputError(f"{who}: expected indices (whole), scores and mask (bool) of {list(expected)} each, got "
                         f"{shapes}; pad with -1")  # fmt: skip
    if not ((indices[mask] >= 0) & (indices[mask] < num_database)).all():
        raise InputError(f"{who}: expected rows of the database from 0 to {num_database - 1}, got "
                         f"{indices[mask].min()} to {indices[mask].max()}")  # fmt: skip
    ordered = np.sort(np.where(mask, indices, -1), axis=1)
    if (twice := (ordered[:, 1:] == ordered[:, :-1]) & (ordered[:, 1:] >= 0)).any():
        query, place = np.argwhere(twice)[0]
        raise InputError(f"{who}: expected every row of the database once, got {ordered[query, place]} twice for query "
                         f"{query}")  # fmt: skip
    if not np.isfinite(scores[mask]).all():
        raise InputError(f"{who}: expected finite scores")
    return Shortlist(np.where(mask, indices, -1).astype(np.int32), np.where(mask, scores, 0).astype(np.float32), mask)


def wrong_with(folder: ImageFolder, features: FeatureSet, bad: Mapping[int, str]) -> Iterator[str]:
    """What is wrong with some images, which rank last, or have no matches."""
    yield from bad.values()
    counts = np.asarray(features.source.counts)
    if empty := [row for row in np.flatnonzero(counts == 0).tolist() if row not in bad]:
        yield (f"{folder.paths[empty[0]]}: no keypoints, so no matches ({len(empty)} such images of {len(folder)}); "
               "scores are 0")  # fmt: skip


def nan_scores(matched: Sequence[Matched], ranked: Sequence[Mapping[str, Ranked]]) -> Iterator[str]:
    """Scorers of one's own may divide by 0."""
    for sequence, systems in zip(matched, ranked, strict=True):
        for name, system in systems.items():
            if number := int(np.isnan(system.scores[system.rows >= 0]).sum()):
                yield f"{sequence.sequence.name}: {number} scores of {name} are NaN, and rank last"
