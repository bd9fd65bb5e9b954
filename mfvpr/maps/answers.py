"""What a map answers."""

import math
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

from mfvpr.maps.describing import Described
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
        place: of the best candidate; None = no place: none was found, or it is too unsure.
        alternatives: the candidates, best first, the answer's own among them, also where there is no place.
        score: of the best candidate; 0 where there is none.
        p_right: how probably that is right; None where no confidence was given, or there is no candidate.
        shift: (x, y) px of the image that the detector saw, from what is at the query's center to where the candidate
            shows it; None where nothing votes for one, or the score is no histogram of shifts.
        shift_interval: 95 %: (low, high), each (x, y); None likewise.
        scale: how much larger the candidate shows the place; None likewise.
    """

    place: Any
    alternatives: tuple[Alternative, ...]
    score: float
    p_right: float | None
    shift: tuple[float, float] | None
    shift_interval: tuple[tuple[float, float], tuple[float, float]] | None
    scale: float | None

    @property
    def is_refused(self) -> bool:
        """Whether there was a candidate, and it is no answer."""
        return self.place is None and bool(self.alternatives)

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
