"""Localization along a drive: a discrete Bayes filter over the rows of a map, in the order of the drive.

    route = Route(Drive())
    for image in images:                       # in their order; later images are not used
        located = route(known.localize(image), known.there)

The belief is over rows and speeds, unless the speed is given. From one image to the next the speed may change, and the
belief moves along the rows by it. A small part spreads over all rows and speeds: the robot may have been carried away.
The likelihood of an image is p, shared among the candidates and the rows next to them by how far their scores are
above the mean of all candidates, plus 1 - p, shared among all rows. Neighboring rows must be neighbors on the road.
"""

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from mfvpr.localization.predictions import Prediction
from mfvpr.types import Array
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import compiled

FIRST_ROWS = 1024  # rows; twice as many whenever they do not suffice, and a program for each
_REACH = 4  # standard deviations of the motion
MOST = 10_000  # rows from one image to the next
NEAR = 2  # rows beside a row that count as the same place

# Chosen on synthetic streets, as the defaults of `Drive`.
SPEEDS = tuple(range(-8, 9))  # rows from one image to the next that are learned
_STEADY, _ANY = (
    0.95,
    0.02,
)  # probabilities that the speed stays, and that it becomes any other; else it changes by a few
_BESIDE = 1.0  # rows, standard deviation: candidates speak for the rows next to them
_ODDS, _ODDS_OF_ONE = math.log(1000), math.log(10)  # for another speed than the given one: of a warning, of an image


@dataclass(frozen=True)
class Drive:
    """Motion of a robot and reliability of its images.

    Attributes:
        advance: mean motion from one image to the next, rows; below 0 = against the order of the map. None = learned
            from the images, between -8 and 8, and it may change on the way.
        spread: standard deviation of the motion, rows.
        kidnapped: probability at each image that the robot may be anywhere.
        confidence: probability that the top prediction is correct, for predictions without their own.
        sharpness: exponent of a candidate's share, which is its score above the mean to this power.
    """

    advance: float | None = None
    spread: float = 0.7
    kidnapped: float = 0.03
    confidence: float = 0.75
    sharpness: float = 2.0

    def __post_init__(self) -> None:
        advance = self.advance or 0.0
        if not (math.isfinite(advance) and 0 < self.spread < math.inf and 0 < self.sharpness < math.inf):
            raise InputError(f"Drive(advance={self.advance}, spread={self.spread}, sharpness={self.sharpness}): "
                             "expected finite numbers, the latter two above 0")  # fmt: skip
        if abs(advance) > MOST or not MOST**-1 <= self.spread <= MOST:
            raise InputError(f"Drive(advance={self.advance}, spread={self.spread}): expected up to {MOST} rows an "
                             f"image, and a spread of {MOST**-1:g} at least")  # fmt: skip
        if not (0 <= self.kidnapped <= 1 and 0 <= self.confidence <= 1):
            raise InputError(f"Drive(kidnapped={self.kidnapped}, confidence={self.confidence}): expected from 0 to 1")


class Located(NamedTuple):
    """The position of the robot.

    row: of the map, the most probable one.
    p: probability that the robot is there or within `NEAR` rows.
    advance: mean motion from one image to the next, rows.
    """

    row: int
    p: float
    advance: float


class Route:
    """The belief, updated with every image. Rows may be added to the map between two images.

    `warn` is called once if the images fit another speed much better than the given one.
    """

    def __init__(self, drive: Drive, *, warn: Callable[[str], object] = warnings.warn) -> None:
        self._drive, self._warn, self._filter, self._lead = drive, warn, _Filter(drive), 0.0
        self._other = None if drive.advance is None else _Filter(replace(drive, advance=None))

    @property
    def belief(self) -> Float[np.ndarray, " rows"]:
        """Probability of each row."""
        return self._filter.belief.sum(axis=1)

    def __call__(self, prediction: Prediction | None, there: Bool[np.ndarray, " rows"]) -> Located | None:
        """Update the belief with the next image; return the position, or None if there is no row.

        Args:
            prediction: of the next image; None = the image gives no evidence, but the robot has moved.
            there: rows where the robot may be.
        """
        if not there.any():
            return None
        alternatives = () if prediction is None else prediction.alternatives
        if (last := max((alternative.row for alternative in alternatives), default=-1)) >= len(there):
            raise InputError(f"there: expected the rows of the map of the prediction, up to {last} at least, got "
                             f"{len(there)}")  # fmt: skip
        share = np.zeros(len(there), np.float32)
        if alternatives:
            rows, scores = map(np.array, zip(*((each.row, each.score) for each in alternatives), strict=True))
            share[rows] = shares(scores, self._drive.sharpness)
            share = np.convolve(share, motion(0.0, _BESIDE))[_REACH : _REACH + len(share)]
        p = self._drive.confidence if prediction is None or prediction.confidence is None else prediction.confidence
        evidence = self._filter.update(there, share, p)
        if self._other is not None:
            odds = self._other.update(there, share, p) - evidence
            self._lead = max(0.0, self._lead + min(odds, _ODDS_OF_ONE))
            if self._lead > _ODDS:
                self._warn(f"the images fit {self._other.advance:.1f} rows from one to the next far better than "
                           f"{self._drive.advance:g}; set that, or let it be learned")  # fmt: skip
                self._other = None
        belief = self.belief
        row = int(np.argmax(belief))
        return Located(row, min(1.0, float(belief[max(0, row - NEAR) : row + NEAR + 1].sum())), self._filter.advance)


class _Filter:
    """A belief over rows and speeds."""

    def __init__(self, drive: Drive) -> None:
        self._speeds = np.array(SPEEDS if drive.advance is None else [drive.advance], float)
        motions = [motion(speed, drive.spread) for speed in self._speeds]
        longest = max(map(len, motions))
        self._motions = np.stack([np.pad(each, (longest - len(each)) // 2) for each in motions])
        self._changes, self._kidnapped = _speed_changes(self._speeds), np.float32(drive.kidnapped)
        self.belief = np.zeros((FIRST_ROWS, len(self._speeds)), np.float32)

    @property
    def advance(self) -> float:
        """The mean speed."""
        return float(self.belief.sum(axis=0) @ self._speeds)

    def update(self, there: Bool[np.ndarray, " rows"], share: Float[np.ndarray, " rows"], p: float) -> float:
        """Update the belief with an image; return the logarithm of the image's probability, up to a constant."""
        while len(there) > len(self.belief):
            self.belief = np.concatenate([self.belief, np.zeros_like(self.belief)])
        pad = (0, len(self.belief) - len(there))
        image = np.pad(there, pad), self._motions, self._changes, self._kidnapped, np.pad(share, pad), np.float32(p)
        belief, evidence = step(self.belief, *image)
        self.belief = np.asarray(belief)
        return math.log(max(float(evidence), np.finfo(np.float32).tiny))


def _speed_changes(speeds: Float[np.ndarray, " speeds"]) -> Float[np.ndarray, "speeds speeds"]:
    """Probabilities of each next speed (columns) after each speed (rows)."""
    if len(speeds) == 1:
        return np.ones((1, 1), np.float32)
    few = np.exp(-((speeds[:, None] - speeds) ** 2) / 2) * (speeds[:, None] != speeds)
    few /= few.sum(axis=1, keepdims=True)
    changes = (1 - _ANY) * (_STEADY * np.eye(len(speeds)) + (1 - _STEADY) * few) + _ANY / len(speeds)
    return changes.astype(np.float32)


def motion(advance: float, spread: float) -> Float[np.ndarray, " steps"]:
    """Probabilities of a motion by -R .. R rows, a Gaussian up to four of its standard deviations."""
    reach = math.ceil(abs(advance) + _REACH * spread)
    steps = np.arange(-reach, reach + 1)
    exponents = -((steps - advance) ** 2) / (2 * spread**2)
    weights = np.where(np.abs(steps - advance) <= max(_REACH * spread, 0.5), np.exp(exponents - exponents.max()), 0)
    return (weights / weights.sum()).astype(np.float32)


def shares(scores: Float[np.ndarray, " candidates"], sharpness: float) -> Float[np.ndarray, " candidates"]:
    """Shares of a query's candidates, of sum 1: (score - mean)^sharpness; 0 below the mean, or if not finite."""
    finite = np.isfinite(scores)
    if not finite.any():
        return np.zeros(len(scores))
    above = np.where(finite, scores - scores[finite].mean(), 0.0)
    above = np.maximum(above, 0) / max(above.max(), np.finfo(np.float64).tiny)  # no power is too large, or too small
    powers = above**sharpness
    return powers / powers.sum() if powers.any() else finite / finite.sum()


@compiled
def step(
    belief: Float[Array, "rows speeds"], there: Bool[Array, " rows"], motions: Float[Array, "speeds steps"],
    changes: Float[Array, "speeds speeds"], kidnapped: Float[Array, ""], share: Float[Array, " rows"],
    confidence: Float[Array, ""],
) -> tuple[Float[Array, "rows speeds"], Float[Array, ""]]:  # fmt: skip
    """The belief after the next image, of sum 1 if there is any row, and the probability of the image.

    If image and motion exclude each other, the motion decides.

    Args:
        belief: after the previous image; all 0 = nothing is known yet.
        there: rows where the robot may be.
        motions: probabilities of -R .. R rows at each speed. Belief that leaves the map is shared by the rest.
        changes: probabilities of each next speed (columns) after each speed (rows).
        kidnapped: probability that the robot may be anywhere.
        share: shares of the rows if the image's prediction is correct; all 0 = no evidence.
        confidence: probability that the prediction is correct.
    """
    rows = there.astype(belief.dtype)[:, None]
    rows /= jnp.maximum(rows.sum(), 1)
    anywhere = jnp.broadcast_to(rows / len(motions), belief.shape)
    reach, changed = motions.shape[1] // 2, jnp.matmul(belief, changes, precision=jax.lax.Precision.HIGHEST)
    move = lambda belief, motion: jnp.convolve(belief, motion, precision=jax.lax.Precision.HIGHEST)  # noqa: E731
    moved = jax.vmap(move)(changed.T, motions)[:, reach : reach + len(belief)].T
    before = (1 - kidnapped) * _normalize(jnp.where(there[:, None], moved, 0), anywhere) + kidnapped * anywhere
    image = _normalize(jnp.where(there, share, 0)[:, None], rows)
    after = before * (confidence * image + (1 - confidence) * rows)
    return _normalize(after, before), after.sum()


def _normalize(values: Array, otherwise: Array) -> Array:
    """`values` with the sum 1, or `otherwise` if all are 0; divided by the largest first, against underflow."""
    largest = values.max()
    scaled = values / jnp.where(largest > 0, largest, 1)
    return jnp.where(largest > 0, scaled / jnp.where(largest > 0, scaled.sum(), 1), otherwise)
