"""Several data sets joined to one: learn on some of them, report on the others."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from mfvpr.core.types import Matches, Shortlist, per_pair
from mfvpr.datasets.positives import join_positives
from mfvpr.evaluation.protocol import EvaluationProtocol
from mfvpr.evaluation.selection import Half
from mfvpr.matchers.match_set import MatchSet
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import repeat_last


@dataclass(frozen=True)
class Part:
    """One data set: ground truth, matches and shortlist of all queries."""

    name: str
    protocol: EvaluationProtocol
    match_set: MatchSet
    candidates: Shortlist


def join_data_sets(teach: Sequence[Part], report: Sequence[Part]) -> Part:
    """Join data sets to one, whose protocol learns on the first sets and reports on the others.

    Args:
        teach: sets to learn on, each from its first query to its last.
        report: sets to report on, of which learning sees nothing.

    Raises:
        InputError: `teach` or `report` is empty, two sets have the same name, or units or thresholds differ.
    """
    parts = [*teach, *report]
    if not teach or not report:
        raise InputError(f"expected data sets to learn on and to report on, got {len(teach)} and {len(report)}")
    names = [part.name for part in parts]
    if len({*names}) < len(names):
        raise InputError(f"expected data sets of different names, got {', '.join(names)}")
    for part in parts[1:]:
        for what in ("unit", "thresholds"):
            expected, got = getattr(parts[0].protocol, what), getattr(part.protocol, what)
            if expected != got:
                raise InputError(
                    f"{part.name}: expected the {what} of {names[0]}, {expected}, got {got}; compare sets "
                    "whose ground truth is of one kind"
                )
    sizes, databases = ([len(part.match_set) for part in parts], [part.protocol.places.num_database for part in parts])
    split = sum(sizes[: len(teach)])
    half = Half(
        np.arange(split),
        np.arange(split, sum(sizes)),
        np.arange(sum(databases)) < sum(databases[: len(teach)]),
        tuple(sizes[: len(teach)]),
    )
    protocol = replace(
        parts[0].protocol,
        positives=[join_positives(sets) for sets in zip(*(part.protocol.positives for part in parts), strict=True)],
        places=join_positives([part.protocol.places for part in parts]),
        halves=[half],
        split="other sets",
        reported_sets={part.name: len(part.match_set) for part in report},
    )
    width = max(part.match_set.counts.shape[1] for part in parts)
    starts = np.cumsum([0, *databases[:-1]])
    match_set = MatchSet(
        _Chain([part.match_set.matches for part in parts], width),
        np.concatenate([_pad(part.match_set.counts, width, 0) for part in parts]),
        max(part.match_set.capacity for part in parts),
    )
    shortlists = []
    for candidates, start in zip([part.candidates for part in parts], starts, strict=True):
        indices = np.where(candidates.indices >= 0, candidates.indices + start, -1).astype(np.int32)
        scores, mask = np.asarray(candidates.scores), np.asarray(candidates.mask)
        shortlists.append(Shortlist(_pad(indices, width, -1), _pad(scores, width, 0), _pad(mask, width, False)))
    return Part(" ".join(names), protocol, match_set, jax.tree.map(lambda *rows: np.concatenate(rows), *shortlists))


def _pad(values: np.ndarray, width: int, fill: Any) -> np.ndarray:
    return np.pad(values, [(0, 0), (0, width - values.shape[1])], constant_values=fill)


class _Chain(Sequence[Matches]):
    """Matches of the queries of several sets, one set after the other; padded candidates have no matches."""

    def __init__(self, parts: Sequence[Sequence[Matches]], width: int) -> None:
        self._parts, self._width = parts, width
        self._ends = np.cumsum([len(part) for part in parts])

    def __len__(self) -> int:
        return int(self._ends[-1])

    def __getitem__(self, query: Any) -> Matches:
        """Matches of one query; slices are not supported."""
        query = range(len(self))[query]
        number = int(np.searchsorted(self._ends, query, side="right"))
        part = self._parts[number]
        matches = part[query - int(self._ends[number]) + len(part)]
        of_candidates = {name: values for name, values in per_pair(matches).items() if name.endswith("1")}
        return replace(matches, **{name: repeat_last(values, self._width) for name, values in of_candidates.items()})
