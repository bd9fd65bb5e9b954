"""Several data sets as one: learned on some of them, reported on the others."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, overload

import numpy as np

from mfvpr.datasets.positives import side_by_side
from mfvpr.evaluation.protocol import Judge
from mfvpr.evaluation.selection import Half
from mfvpr.matching.match_set import MatchSet
from mfvpr.types import Matches, Shortlist, per_pair
from mfvpr.utils.errors import InputError


@dataclass(frozen=True)
class Part:
    """One data set.

    Attributes:
        name: of its own.
        judge: what is right, all queries.
        match_set: matches of Q queries with C candidates.
        candidates: their shortlist.
    """

    name: str
    judge: Judge
    match_set: MatchSet
    candidates: Shortlist


def joined(teach: Sequence[Part], report: Sequence[Part]) -> Part:
    """All queries and databases side by side, with a judge that has the first sets teach, and reports on the others.

    Args:
        teach: learned on, each from its first query to its last.
        report: of which learning sees nothing.

    Raises:
        InputError: there are none of either, two have one name, or what is right differs in unit or thresholds.
    """
    parts = [*teach, *report]
    if not teach or not report:
        raise InputError(f"expected data sets to learn on and to report on, got {len(teach)} and {len(report)}")
    names = [part.name for part in parts]
    if len({*names}) < len(names):
        raise InputError(f"expected data sets of different names, got {', '.join(names)}")
    for part in parts[1:]:
        for what in ("unit", "thresholds"):
            first, own = (getattr(one.judge, what) for one in (parts[0], part))
            if first != own:
                raise InputError(f"{part.name}: expected the {what} of {names[0]}, {first}, got {own}; compare sets "
                                 "whose ground truth is of one kind")  # fmt: skip
    sizes, databases = ([len(part.match_set) for part in parts], [part.judge.places.num_database for part in parts])
    split = sum(sizes[: len(teach)])
    half = Half(
        np.arange(split), np.arange(split, sum(sizes)), np.arange(sum(databases)) < sum(databases[: len(teach)]),
        tuple(sizes[: len(teach)]),
    )  # fmt: skip
    judge = replace(
        parts[0].judge,
        positives=[side_by_side(same) for same in zip(*(part.judge.positives for part in parts), strict=True)],
        places=side_by_side([part.judge.places for part in parts]),
        halves=[half], split="other sets", reported_sets={part.name: len(part.match_set) for part in report},
    )  # fmt: skip
    width = max(part.match_set.counts.shape[1] for part in parts)
    starts = np.cumsum([0, *databases[:-1]])
    match_set = MatchSet(
        _Chain([part.match_set.matches for part in parts], width),
        np.concatenate([_widened(part.match_set.counts, width, 0) for part in parts]),
        max(part.match_set.capacity for part in parts),
    )
    candidates = [_moved(part.candidates, int(start), width) for part, start in zip(parts, starts, strict=True)]
    columns = {
        name: np.concatenate([getattr(one, name) for one in candidates]) for name in ("indices", "scores", "mask")
    }
    return Part(" ".join(names), judge, match_set, Shortlist(**columns))


def _moved(candidates: Shortlist, start: int, width: int) -> Shortlist:
    """Of a database whose first row is `start`."""
    indices = np.where(candidates.indices >= 0, candidates.indices + start, -1).astype(np.int32)
    return Shortlist(
        indices=_widened(indices, width, -1),
        scores=_widened(np.asarray(candidates.scores), width, 0),
        mask=_widened(np.asarray(candidates.mask), width, False),
    )


def _widened(values: np.ndarray, width: int, fill: Any) -> np.ndarray:
    """`[Q, width]` of `[Q, C]`."""
    return np.pad(values, [(0, 0), (0, width - values.shape[1])], constant_values=fill)


class _Chain(Sequence[Matches]):
    """The queries of several sets, one behind the other; candidates that are not there have no matches."""

    def __init__(self, parts: Sequence[Sequence[Matches]], width: int) -> None:
        self._parts, self._width = parts, width
        self._ends = np.cumsum([len(part) for part in parts])

    def __len__(self) -> int:
        return int(self._ends[-1])

    @overload
    def __getitem__(self, query: int) -> Matches: ...
    @overload
    def __getitem__(self, query: slice) -> Sequence[Matches]: ...
    def __getitem__(self, query: int | slice) -> Matches | Sequence[Matches]:
        if isinstance(query, slice):
            return [self[one] for one in range(*query.indices(len(self)))]
        query = range(len(self))[query]
        number = int(np.searchsorted(self._ends, query, side="right"))
        part = self._parts[number]
        matches = part[query - int(self._ends[number]) + len(part)]
        of_candidates = {name: values for name, values in per_pair(matches).items() if name.endswith("1")}
        return replace(matches, **{name: self._filled(values) for name, values in of_candidates.items()})

    def _filled(self, values: np.ndarray) -> np.ndarray:
        """`[width, ...]` of `[C, ...]`: the image of the last candidate again."""
        return np.pad(values, [(0, self._width - len(values)), *[(0, 0)] * (values.ndim - 1)], mode="edge")
