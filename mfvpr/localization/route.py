"""Where a robot is that drives along a map: a discrete Bayes filter over the rows, in the order of the drive.

    route = Route(Drive(advance=1))
    for image in images:                       # in their order; nothing is known of those that come
        found = route(known.localize(image), known.there)

From one image to the next the belief moves along the rows, and of a small part of it nobody knows where: the robot may
have been carried away. What an image says is how probable a row is if nothing else were known: the answer is right with
p, shared among the candidates by how far their scores are above the mean of them all; otherwise it is any row. Rows
that are not next to each other on the road are no map for this.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mfvpr.localization.answers import Answer
from mfvpr.types import Array
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import compiled

FIRST_ROWS = 1024  # rows; twice as many whenever they do not suffice, and a program for each
_REACH = 4  # standard deviations of the motion
MOST = 10_000  # rows from one image to the next
NEAR = 2  # rows beside a place that are taken for it


@dataclass(frozen=True)
class Drive:
    """How a robot moves, and what its images say; what is given here was chosen on one drawn street and its seasons.

    Attributes:
        advance: rows, by which an image is further than the one before, on average; below 0 = against the order.
        spread: rows, the standard deviation of that.
        kidnapped: probability that it may be anywhere, at each image.
        p_right: of answers that have none of their own.
        sharpness: the power of a candidate's score above the mean to which its share is proportional.
    """

    advance: float = 1.0
    spread: float = 1.0
    kidnapped: float = 0.03
    p_right: float = 0.35
    sharpness: float = 2.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.advance) and 0 < self.spread < math.inf and 0 < self.sharpness < math.inf):
            raise InputError(f"Drive(advance={self.advance}, spread={self.spread}, sharpness={self.sharpness}): "
                             "expected finite numbers, the latter two above 0")  # fmt: skip
        if abs(self.advance) > MOST or not MOST**-1 <= self.spread <= MOST:
            raise InputError(f"Drive(advance={self.advance}, spread={self.spread}): expected up to {MOST} rows an "
                             f"image, and a spread of {MOST**-1:g} at least")  # fmt: skip
        if not (0 <= self.kidnapped <= 1 and 0 <= self.p_right <= 1):
            raise InputError(f"Drive(kidnapped={self.kidnapped}, p_right={self.p_right}): expected from 0 to 1")


class Located(NamedTuple):
    """Where the robot is.

    row: of the map, the most probable one.
    p: that it is there, or within `NEAR` rows.
    """

    row: int
    p: float


class Route:
    """The belief, which every image moves on; any number of rows may be added to the map between two."""

    def __init__(self, drive: Drive) -> None:
        """It may be anywhere."""
        self._drive, self.belief = drive, np.zeros(FIRST_ROWS, np.float32)
        self._motion = motion(drive.advance, drive.spread)

    def __call__(self, answer: Answer | None, there: np.ndarray) -> Located | None:
        """Where it is now; None where there is no row.

        Args:
            answer: of the next image; None = it says nothing, but the robot has moved on.
            there: `[R]` bool, rows where it may be.
        """
        if not there.any():
            return None
        found = () if answer is None else answer.alternatives
        if (last := max((one.row for one in found), default=-1)) >= len(there):
            raise InputError(f"there: expected the rows of the map that answered, up to {last} at least, got "
                             f"{len(there)}")  # fmt: skip
        while len(there) > len(self.belief):
            self.belief = np.concatenate([self.belief, np.zeros_like(self.belief)])
        drive, allowed = self._drive, np.zeros(len(self.belief), bool)
        allowed[: len(there)] = there
        says = np.zeros(len(self.belief), np.float32)
        if found:
            rows, scores = np.array([one.row for one in found]), np.array([one.score for one in found])
            says[rows] = shares(scores, drive.sharpness)
        p = drive.p_right if answer is None or answer.p_right is None else answer.p_right
        belief = step(self.belief, allowed, self._motion, np.float32(drive.kidnapped), says, np.float32(p))
        self.belief = np.asarray(belief)
        row = int(np.argmax(self.belief))
        return Located(row, min(1.0, float(self.belief[max(0, row - NEAR) : row + NEAR + 1].sum())))


def motion(advance: float, spread: float) -> np.ndarray:
    """`[2 R + 1]` probabilities of a motion by -R .. R rows, a Gaussian up to four of its standard deviations."""
    reach = math.ceil(abs(advance) + _REACH * spread)
    steps = np.arange(-reach, reach + 1)
    exponents = -((steps - advance) ** 2) / (2 * spread**2)
    weights = np.where(np.abs(steps - advance) <= max(_REACH * spread, 0.5), np.exp(exponents - exponents.max()), 0)
    return (weights / weights.sum()).astype(np.float32)


def shares(scores: np.ndarray, sharpness: float) -> np.ndarray:
    """`[C]` of a query's candidates: (score - their mean)^sharpness, 0 below the mean, over the sum of all.

    Equal ones where all scores are equal; scores that are not finite have none. 0 where no score is finite.
    """
    some = np.isfinite(scores)
    if not some.any():
        return np.zeros(len(scores))
    above = np.where(some, scores - scores[some].mean(), 0.0)
    above = np.maximum(above, 0) / max(above.max(), np.finfo(np.float64).tiny)  # no power is too large, or too small
    powers = above**sharpness
    return powers / powers.sum() if powers.any() else some / some.sum()


@compiled
def step(belief: Array, there: Array, motion: Array, kidnapped: Array, says: Array, p_right: Array) -> Array:
    """The belief after the next image.

    Args:
        belief: `[N]` after the one before, all 0 = nothing is known yet.
        there: `[N]` bool, rows where the robot may be.
        motion: `[2 R + 1]` probabilities of -R .. R rows. What leaves the map is shared by those that stay.
        kidnapped: `[]` probability that it may be anywhere.
        says: `[N]` shares of rows, as the image's answer says, if that is right; all 0 = it says nothing.
        p_right: `[]` that it is.

    Returns:
        `[N]` with the sum 1, where any row is there. Where image and motion exclude each other, what the motion says.
    """
    anywhere = there.astype(belief.dtype)
    anywhere /= jnp.maximum(anywhere.sum(), 1)
    reach = len(motion) // 2
    moved = jnp.convolve(belief, motion, precision=jax.lax.Precision.HIGHEST)[reach : reach + len(belief)]
    before = (1 - kidnapped) * _normalized(jnp.where(there, moved, 0), anywhere) + kidnapped * anywhere
    image = _normalized(jnp.where(there, says, 0), anywhere)
    likelihood = p_right * image + (1 - p_right) * anywhere  # of rows alike before, what the image makes of them
    return _normalized(before * likelihood, before)


def _normalized(values: Array, otherwise: Array) -> Array:
    """With the sum 1; others where all are 0. Divided by the largest first, as small ones may have no product."""
    largest = values.max()
    scaled = values / jnp.where(largest > 0, largest, 1)
    return jnp.where(largest > 0, scaled / jnp.where(largest > 0, scaled.sum(), 1), otherwise)
