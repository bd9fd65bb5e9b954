"""Results of localizing an image in a map."""

import math
from dataclasses import asdict, dataclass, field, replace
from typing import Any, NamedTuple

from mfvpr.core.types import Matches
from mfvpr.evaluation.dataset_ranking import Reason
from mfvpr.localization.query_steps import Described
from mfvpr.utils.errors import InputError


class Located(NamedTuple):
    """The position of a robot on a route."""

    row: int | None  # of the map, the most probable one; None = the robot is off the map
    p: float  # probability that the robot is there or at most 2 rows away
    advance: float  # mean motion from one image to the next, rows
    off: float  # probability that the robot is not on the map


@dataclass(frozen=True)
class Alternative:
    """A candidate: the name and the place of the image in a row of the map, and its score; larger = more similar."""

    row: int
    name: str
    place: Any
    score: float


@dataclass(frozen=True)
class Prediction:
    """The place of an image, with its confidence and the alternatives.

    Attributes:
        place: of the best candidate; None = no place, and `reason` says why.
        alternatives: all candidates, best first; empty if there is no place for another reason than "low confidence" or
            "off the map".
        score: of the best candidate; 0 if there is none.
        confidence: probability that the top prediction is correct; None without a confidence or without candidates.
        shift: (x, y) px of the query image as it was given, from its center to the same point in the best candidate,
            as if both images had the size of the query; None without a place, if no match votes, or if the score is no
            histogram of shifts.
        shift_interval: its 95 % interval (low, high), each (x, y); None likewise.
        reason: why there is no place; None if there is one.
        image_width: of the query image, px.
        located: position on the route, if there is one.
    """

    place: Any = None
    alternatives: tuple[Alternative, ...] = field(default=(), repr=False)
    score: float = 0.0
    confidence: float | None = None
    shift: tuple[float, float] | None = None
    shift_interval: tuple[tuple[float, float], tuple[float, float]] | None = None
    reason: Reason | None = None
    image_width: int = 0
    located: Located | None = None

    @property
    def shift_fraction(self) -> tuple[float, float] | None:
        """`shift` in widths of the image, along both axes."""
        return self.shift and (self.shift[0] / self.image_width, self.shift[1] / self.image_width)

    def shift_angles(self, field_of_view: float) -> tuple[float, float, float] | None:
        """Horizontal angles in degrees of `shift` and of both ends of its interval, of a pinhole camera.

        `field_of_view` is the horizontal one of the camera, in degrees, from 5 and below 180.
        """
        if not 5 <= field_of_view < 180:
            raise InputError(f"field_of_view={field_of_view}: expected degrees from 5 and below 180, not radians")
        if self.shift is None or self.shift_interval is None:
            return None
        focal = self.image_width / 2 / math.tan(math.radians(field_of_view) / 2)
        shift, low, high = (math.degrees(math.atan(x / focal)) for x, _ in (self.shift, *self.shift_interval))
        return shift, low, high

    def without_place(self, reason: Reason) -> "Prediction":
        """The prediction without place and shift; candidates, score and confidence stay."""
        return replace(self, place=None, shift=None, shift_interval=None, reason=reason)

    def as_json(self, most: int = 5) -> dict[str, Any]:
        """JSON values, with at most `most` alternatives and without the position on a route."""
        values = asdict(replace(self, alternatives=self.alternatives[:most]))
        del values["located"]
        values["shift_fraction"] = self.shift_fraction
        for scored in (values, *values["alternatives"]):
            scored["score"] = scored["score"] if math.isfinite(scored["score"]) else None
        return values


class Localization(NamedTuple):
    """A prediction with the features and matches that led to it."""

    prediction: Prediction
    described: Described  # features and global descriptor of the query, with which it can be added to the map
    matches: Matches | None  # with the best candidate, `[K, ...]`, NumPy; None if there is none
