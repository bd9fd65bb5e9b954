"""Localization along a drive: the causal filter of `mfvpr.evaluation.drives` over the rows of a map.

route = Route()
for image in images:  # in their order
    located = known.localize(image, route=route).located

An image that is refused, for lack of evidence for any place, says nothing of the row, but refusals are rarer on the
map. If the robot is off the map with probability m before the image, then after it

    off / (1 - off) = m / (1 - m) * min(share of refusals off the map / share on the map, 2.5),

with the shares that the calibration of the map measured, 0.5 and 0.2 without one: five refusals in a tunnel raise `off`
to 0.68, ten in another building to 0.92, and from 0.9 on there is no row.
"""

import math
import warnings
from collections.abc import Callable
from dataclasses import replace

import jax
import numpy as np
from jaxtyping import Bool, Float

from mfvpr.core.types import Array
from mfvpr.evaluation.confidence import REFUSALS
from mfvpr.evaluation.drives import DEFAULT_DRIVE, Drive, DriveModel, Evidence, off_the_map
from mfvpr.evaluation.rankings import Ranked
from mfvpr.localization.predictions import Located, Prediction
from mfvpr.retrieval.standardization import Moments
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import compiled, round_up

FIRST_ROWS = 1024  # rows; twice as many whenever they do not suffice, and a program for each
NEAR = 2  # rows beside a row that count as the same place
OFF = 0.9  # from this probability on, the robot counts as off the map
_MOST_REFUSALS = 2.5  # times as many off the map: on the map, they follow each other as well, in a tunnel
_CANDIDATES = 64  # evidence has a multiple of so many
_ODDS, _ODDS_OF_ONE = math.log(1000), math.log(10)  # for another speed than the given one: of a warning, of an image


class Route:
    """The belief, updated with every image. Rows may be added to the map between two images.

        street = mfvpr.Map.create("map", "day", system)
        route = mfvpr.Route(mfvpr.Drive(advance=1.0))
        located = street.localize("query.jpg", route=route).located

    Args:
        drive: motion of the robot; an InputError for anything else.
        warn: called once if the images fit another speed much better than the given one.
    """

    def __init__(self, drive: Drive = DEFAULT_DRIVE, *, warn: Callable[[str], object] = warnings.warn) -> None:
        if not isinstance(drive, Drive):
            raise InputError(f"Route: expected Drive(...), got {drive!r}")
        self._drive, self._warn, self._filter, self._lead = drive, warn, _Filter(drive), 0.0
        self.seen: Moments | None = None  # of the global descriptors of the drive so far
        self._other = None if drive.advance is None else _Filter(replace(drive, advance=None))

    @property
    def belief(self) -> Float[np.ndarray, " rows"]:
        """Probability of each row if the robot is on the map."""
        return self._filter.by_row

    def see(self, descriptor: Float[np.ndarray, " dimensions"]) -> None:
        """Count an image of the drive in the statistics by which descriptors are standardized."""
        if (image := Moments.of(descriptor[None])) is not None:
            self.seen = image.joined(self.seen)

    def __call__(
        self, prediction: Prediction | None, there: Bool[np.ndarray, " rows"], refusals: tuple[float, float] = REFUSALS
    ) -> Located | None:
        """Update the belief with the next image; return the position, or None if there is no row.

        Args:
            prediction: of the next image; None = the image gives no evidence, but the robot has moved.
            there: rows where the robot may be.
            refusals: shares of images without enough evidence on and off the map, see `Confidence`.
        """
        if not there.any():
            return None
        evidence = _evidence(prediction)
        if (last := evidence.rows.max(initial=-1)) >= len(there):
            raise InputError(f"there: expected the rows of the prediction's map, {last + 1} at least, got {len(there)}")
        on = 1.0  # probability of what the image lacks on the map, relative to that off it
        if prediction is not None and not prediction.alternatives and prediction.reason != "no candidates":
            on = min(1.0, max(1 / _MOST_REFUSALS, refusals[0] / max(refusals[1], 1e-9)))  # never evidence of the map
        chance = self._filter.update(there, evidence, on)
        if self._other is not None:
            odds = self._other.update(there, evidence) - chance
            self._lead = max(0.0, self._lead + min(odds, _ODDS_OF_ONE))
            if self._lead > _ODDS:
                better = f"fit {self._other.advance:.1f} rows from one to the next far better than"
                self._warn(f"the images {better} {self._drive.advance:g}; set that, or let it be learned")
                self._other = None
        by_row = np.where(there, self._filter.by_row[: len(there)], 0)
        row = int(np.argmax(by_row))
        p = min(1.0, float(by_row[max(0, row - NEAR) : row + NEAR + 1].sum())) * (1 - self._filter.off)
        return Located(row if self._filter.off < OFF else None, p, self._filter.advance, self._filter.off)


def _evidence(prediction: Prediction | None) -> Evidence:
    """Evidence of a prediction, which may have no candidates."""
    alternatives = () if prediction is None else prediction.alternatives
    number = round_up(max(1, len(alternatives)), _CANDIDATES)
    rows, scores = np.full((1, number), -1), np.zeros((1, number))
    if alternatives:
        rows[0, : len(alternatives)] = [each.row for each in alternatives]
        scores[0, : len(alternatives)] = [each.score for each in alternatives]
    p = None if prediction is None else prediction.confidence
    evidence = Evidence.of(Ranked(rows, scores), None if p is None else np.array([p]))
    return jax.tree.map(lambda values: values[0], evidence)


class _Filter:
    """A belief over rows and speeds."""

    def __init__(self, drive: Drive) -> None:
        self._drive, self._model = drive, DriveModel.of(drive, np.zeros(FIRST_ROWS, bool))
        self._belief, self.off = np.zeros((len(self._model.speeds), FIRST_ROWS), np.float32), drive.off

    @property
    def by_row(self) -> Float[np.ndarray, " rows"]:
        """Probability of each row if the robot is on the map."""
        return self._belief.sum(axis=0)

    @property
    def advance(self) -> float:
        """The mean speed."""
        return float(self._belief.sum(axis=1) @ self._model.speeds)

    def update(self, there: Bool[np.ndarray, " rows"], evidence: Evidence, on: float = 1) -> float:
        """Update the belief with an image; return the logarithm of the image's probability, up to a constant.

        `on` changes whether the robot is on the map, not where it is there.
        """
        rows = self._belief.shape[1]
        while rows < len(there):
            rows *= 2
        self._belief = np.pad(self._belief, ((0, 0), (0, rows - self._belief.shape[1])))
        self._model = replace(self._model, there=np.pad(there, (0, rows - len(there))))
        before = self._belief if self._belief.any() else np.asarray(self._model.anywhere)
        belief, chance = _step(self._model, before, evidence)
        self._belief, self.off = np.asarray(belief), off_the_map(self._drive, self.off, on * float(chance))
        return math.log(max(float(chance), np.finfo(np.float32).tiny))


@compiled
def _step(drive: DriveModel, belief: Array, evidence: Evidence) -> tuple[Array, Array]:
    """The belief after the next image, and the probability of the image."""
    return drive.after(belief, drive.likelihood(evidence))
