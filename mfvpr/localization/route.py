"""Localization along a drive: a discrete Bayes filter over the rows of a map, in the order of the drive.

    route = Route(Drive(advance=1))
    for image in images:                       # in their order; later images are not used
        located = route(known.localize(image), known.there)

From one image to the next the belief moves along the rows. A small part of it spreads over all rows: the robot may have
been carried away. The likelihood of an image is p, shared among the candidates by how far their scores are above the
mean of all candidates, plus 1 - p, shared among all rows. Neighboring rows must be neighbors on the road.
"""

import math
from dataclasses import dataclass
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


@dataclass(frozen=True)
class Drive:
    """Motion of a robot and reliability of its images; defaults were chosen on one synthetic street and its seasons.

    Attributes:
        advance: mean motion from one image to the next, rows; below 0 = against the order of the map.
        spread: standard deviation of the motion, rows.
        kidnapped: probability at each image that the robot may be anywhere.
        confidence: probability that the top prediction is correct, for predictions without their own.
        sharpness: exponent of a candidate's share, which is its score above the mean to this power.
    """

    advance: float = 1.0
    spread: float = 1.0
    kidnapped: float = 0.03
    confidence: float = 0.35
    sharpness: float = 2.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.advance) and 0 < self.spread < math.inf and 0 < self.sharpness < math.inf):
            raise InputError(f"Drive(advance={self.advance}, spread={self.spread}, sharpness={self.sharpness}): "
                             "expected finite numbers, the latter two above 0")  # fmt: skip
        if abs(self.advance) > MOST or not MOST**-1 <= self.spread <= MOST:
            raise InputError(f"Drive(advance={self.advance}, spread={self.spread}): expected up to {MOST} rows an "
                             f"image, and a spread of {MOST**-1:g} at least")  # fmt: skip
        if not (0 <= self.kidnapped <= 1 and 0 <= self.confidence <= 1):
            raise InputError(f"Drive(kidnapped={self.kidnapped}, confidence={self.confidence}): expected from 0 to 1")


class Located(NamedTuple):
    """The position of the robot.

    row: of the map, the most probable one.
    p: probability that the robot is there or within `NEAR` rows.
    """

    row: int
    p: float


class Route:
    """The belief, updated with every image. Rows may be added to the map between two images."""

    def __init__(self, drive: Drive) -> None:
        self._drive, self.belief = drive, np.zeros(FIRST_ROWS, np.float32)
        self._motion = motion(drive.advance, drive.spread)

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
        while len(there) > len(self.belief):
            self.belief = np.concatenate([self.belief, np.zeros_like(self.belief)])
        drive, allowed = self._drive, np.zeros(len(self.belief), bool)
        allowed[: len(there)] = there
        share = np.zeros(len(self.belief), np.float32)
        if alternatives:
            rows, scores = map(np.array, zip(*((each.row, each.score) for each in alternatives), strict=True))
            share[rows] = shares(scores, drive.sharpness)
        p = drive.confidence if prediction is None or prediction.confidence is None else prediction.confidence
        belief = step(self.belief, allowed, self._motion, np.float32(drive.kidnapped), share, np.float32(p))
        self.belief = np.asarray(belief)
        row = int(np.argmax(self.belief))
        return Located(row, min(1.0, float(self.belief[max(0, row - NEAR) : row + NEAR + 1].sum())))


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
    belief: Float[Array, " rows"], there: Bool[Array, " rows"], motion: Float[Array, " steps"],
    kidnapped: Float[Array, ""], share: Float[Array, " rows"], confidence: Float[Array, ""],
) -> Float[Array, " rows"]:  # fmt: skip
    """The belief after the next image.

    Args:
        belief: after the previous image; all 0 = nothing is known yet.
        there: rows where the robot may be.
        motion: probabilities of -R .. R rows, 2 R + 1 steps. Belief that leaves the map is shared by the rest.
        kidnapped: probability that the robot may be anywhere.
        share: shares of the rows if the image's prediction is correct; all 0 = no evidence.
        confidence: probability that the prediction is correct.

    Returns:
        Belief with the sum 1, if there is any row. If image and motion exclude each other, the motion decides.
    """
    anywhere = there.astype(belief.dtype)
    anywhere /= jnp.maximum(anywhere.sum(), 1)
    reach = len(motion) // 2
    moved = jnp.convolve(belief, motion, precision=jax.lax.Precision.HIGHEST)[reach : reach + len(belief)]
    before = (1 - kidnapped) * _normalize(jnp.where(there, moved, 0), anywhere) + kidnapped * anywhere
    image = _normalize(jnp.where(there, share, 0), anywhere)
    likelihood = confidence * image + (1 - confidence) * anywhere
    return _normalize(before * likelihood, before)


def _normalize(values: Array, otherwise: Array) -> Array:
    """`values` with the sum 1, or `otherwise` if all are 0; divided by the largest first, against underflow."""
    largest = values.max()
    scaled = values / jnp.where(largest > 0, largest, 1)
    return jnp.where(largest > 0, scaled / jnp.where(largest > 0, scaled.sum(), 1), otherwise)
