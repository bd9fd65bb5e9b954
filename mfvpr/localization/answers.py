"""What a map answers."""

import math
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

from mfvpr.evaluation.results import Reason
from mfvpr.localization.describing import Described
from mfvpr.types import Matches


@dataclass(frozen=True)
class Alternative:
    """A candidate.

    Attributes:
        row: of the map.
        name: of its image.
        place: where that was taken.
        score: its own; larger = more similar.
    """

    row: int
    name: str
    place: Any
    score: float


@dataclass(frozen=True)
class Answer:
    """Where an image was taken.

    Attributes:
        place: of the best candidate; None = no place, and `reason` says why.
        alternatives: the candidates, best first, the answer's own among them, also where p is below the threshold;
            none for every other reason.
        score: of the best candidate; 0 where there is none.
        p_right: how probably that is right; None where no confidence was given, or there is no candidate.
        shift: (x, y) px of the image that the detector saw, from what is at the query's center to where the candidate
            shows it; None where there is no place, nothing votes for one, or the score is no histogram of shifts.
        shift_interval: 95 %: (low, high), each (x, y); None likewise.
        scale: how much larger the candidate shows the place; None likewise.
        reason: why there is no place; None where there is one.
    """

    place: Any
    alternatives: tuple[Alternative, ...]
    score: float
    p_right: float | None
    shift: tuple[float, float] | None
    shift_interval: tuple[tuple[float, float], tuple[float, float]] | None
    scale: float | None
    reason: Reason | None = None

    @property
    def is_refused(self) -> bool:
        """Whether there is no place although the map has images to compare with."""
        return self.reason not in (None, "no candidates")

    def as_json(self, most: int = 5) -> dict[str, Any]:
        """JSON values, with so many alternatives."""
        values = asdict(replace(self, alternatives=self.alternatives[:most]))
        for one in (values, *values["alternatives"]):
            one["score"] = one["score"] if math.isfinite(one["score"]) else None
        return values


class Asked(NamedTuple):
    """An answer, and what it was found with.

    answer: to the image.
    described: the image's features and descriptor, with which it can be added to the map.
    matches: with the best candidate, `[K, ...]`, NumPy; None where there is none.
    """

    answer: Answer
    described: Described
    matches: Matches | None


def refusal(reason: Reason, described: Described) -> Asked:
    """An answer without place and candidates."""
    return Asked(Answer(None, (), 0.0, None, None, None, None, reason), described, None)
