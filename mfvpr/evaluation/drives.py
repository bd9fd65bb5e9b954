"""Rankings along a drive: a hidden Markov model over the rows of the database, which are in the order of a drive.

The state is a row and a speed. From one image to the next the speed may change, and the robot moves by it. A small part
of the probability spreads over all rows and speeds, as the robot may have been carried away; so does what moves beyond
an end of the map. The likelihood of an image at a row, relative to an image that shows nothing of the map, is

    correct * odds * share + 1 - correct,

where `correct` is the probability of a correct top prediction on the map, `share` the row's part of the candidates'
scores, relative to equal parts, and `odds` says how much more likely the scores are if the top prediction is correct.
Each candidate also speaks for the rows next to it. Whether the robot is on the map at all is a second model of two
states: an image is as likely as the first model says, or shows nothing of the map.
"""

import itertools
import math
import sys
from dataclasses import dataclass, field
from functools import partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from mfvpr.core.types import Array, value
from mfvpr.evaluation.confidence import Confidence
from mfvpr.evaluation.rankings import SEQUENCE, Ranked
from mfvpr.utils.errors import InputError, require_word
from mfvpr.utils.numerics import compiled

# Chosen on synthetic streets (`dataset=streets_seasons`), as the defaults of `Drive`.
SPEEDS = tuple(range(-8, 9))  # rows from one image to the next that are learned
_SHARPNESS = 2  # a candidate's part is its score above the mean to this power
_ANY = 0.02  # probability that the speed becomes any other
_STEADY = 0.95  # otherwise, probability that it stays; else it changes by a few rows
_BESIDE = 1.0  # rows, standard deviation: candidates speak for the rows next to them
_MOST_ODDS = 50.0  # of a correct prediction: images may look like those of another place
_REACH = 4  # standard deviations of the motion
_EXACT = jax.lax.Precision.HIGHEST

# Confidence that a top prediction is correct, if half of the queries show a place that is not in the database: fitted
# on the drives of `dataset=streets_seasons`, `scorer=demo`, by `python -m experiments.sequences --fit`.
STREETS = Confidence((1.288, 1.852), (0.998, 0.662), (0.740, 3.306), 0.474)


@dataclass(frozen=True)
class Drive:
    """Motion of a robot along the rows of a map; probabilities are for each image.

        drive = mfvpr.Drive(advance=1.0, spread=0.5)  # as fast as the drive of the map

    `advance` is the mean motion from one image to the next, rows; below 0 = against the order of the map. None =
    learned from the images, between -8 and 8, and it may change on the way.
    """

    advance: float | None = None
    spread: float = 0.7  # standard deviation of the motion, rows
    kidnapped: float = 0.03  # probability that the robot may be anywhere on the map
    leaves: float = 0.02  # probability that the robot leaves the map
    returns: float = 0.1  # probability that a robot that left the map is on it again
    correct: float = 0.75  # probability that the top prediction is correct while the robot is on the map

    def __post_init__(self) -> None:
        if not all(isinstance(each, int | float | None) for each in vars(self).values()):
            raise InputError(f"{self}: expected numbers")
        if not (abs(self.advance or 0) <= 10_000 and 1e-4 <= self.spread <= 100):
            raise InputError(f"{self}: expected at most 10000 rows, and a spread from 0.0001 to 100")
        if not all(0 <= p <= 1 for p in (self.kidnapped, self.leaves, self.correct)) or not 0 < self.returns <= 1:
            raise InputError(f"{self}: expected probabilities from 0 to 1, and returns above 0")

    @property
    def off(self) -> float:
        """Probability that the robot is not on the map, before any image."""
        return self.leaves / (self.leaves + self.returns)


DEFAULT_DRIVE = Drive()


class Evidence(NamedTuple):
    """Evidence of an image: its candidates' rows (-1 = none), their shares of sum 1 (all 0 = none), and the odds."""

    rows: Int[Array, "*images candidates"]
    shares: Float[Array, "*images candidates"]
    odds: Float[Array, "*images"]

    @classmethod
    def of(cls, ranked: Ranked, confidence: Float[np.ndarray, " images"] | None = None) -> "Evidence":
        """Evidence of a ranking's images; `confidence` is that of `STREETS` by default."""
        p = np.nan_to_num(STREETS(ranked) if confidence is None else confidence, nan=0.0)
        odds = np.clip(p / np.maximum(1 - p, 1e-9), 1 / _MOST_ODDS, _MOST_ODDS)
        # Shares: the square of the score above the mean; 0 if it is not finite.
        finite = (ranked.rows >= 0) & np.isfinite(ranked.scores)
        values = np.where(finite, ranked.scores, 0.0).astype(np.float64)
        mean = values.sum(axis=1, keepdims=True) / np.maximum(finite.sum(axis=1), 1)[:, None]
        powers = np.maximum(np.where(finite, values - mean, 0), 0) ** _SHARPNESS
        powers = np.where(powers.any(axis=1, keepdims=True), powers, finite)  # all scores are equal
        shares = (powers / np.maximum(powers.sum(axis=1, keepdims=True), 1e-300)).astype(np.float32)
        return cls(ranked.rows.astype(np.int32), shares, odds.astype(np.float32))


@value
class DriveModel:
    """A drive along the rows of a map, as arrays. A belief has the probabilities of all speeds and rows.

    From one image to the next, the row changes by the shift of the speed and by -R .. R rows.
    """

    there: Bool[Array, " rows"]  # others are gaps, or beyond the end of the map
    speeds: Float[Array, " speeds"]
    shifts: Int[Array, " speeds"]  # rows
    steps: Float[Array, "speeds steps"]  # probabilities of -R .. R rows
    changes: Float[Array, "speeds speeds"]  # probabilities of each next speed (columns) after each speed (rows)
    kidnapped: Float[Array, ""]
    correct: Float[Array, ""]
    reach: int = field(metadata={"static": True})  # rows; at least the largest change of the row

    @classmethod
    def of(cls, drive: Drive, there: Bool[np.ndarray, " rows"]) -> "DriveModel":
        """The model of a drive along the rows that are there."""
        speeds = np.array(SPEEDS if drive.advance is None else [drive.advance], np.float32)
        shifts = np.round(speeds).astype(np.int32)
        steps = np.stack([_gaussian(part, drive.spread) for part in (speeds - shifts).tolist()])
        changes = np.ones((1, 1), np.float32)
        if len(speeds) > 1:
            few = np.exp(-((speeds[:, None] - speeds) ** 2) / 2) * (speeds[:, None] != speeds)
            few /= few.sum(axis=1, keepdims=True)
            changes = (1 - _ANY) * (_STEADY * np.eye(len(speeds)) + (1 - _STEADY) * few) + _ANY / len(speeds)
            changes = changes.astype(np.float32)
        kidnapped, correct = np.float32(drive.kidnapped), np.float32(drive.correct)
        reach = 16 * math.ceil((np.abs(shifts).max() + steps.shape[1] // 2) / 16)  # few sizes, so few programs
        return cls(there, speeds, shifts, steps, changes, kidnapped, correct, reach)

    @property
    def anywhere(self) -> Float[Array, "speeds rows"]:
        """The belief before the first image."""
        there = jnp.asarray(self.there, self.steps.dtype)
        states = len(self.speeds) * jnp.maximum(there.sum(), 1)
        return jnp.broadcast_to(there / states, (len(self.speeds), len(there)))

    def after(
        self, belief: Float[Array, "speeds rows"], here: Float[Array, " rows"]
    ) -> tuple[Float[Array, "speeds rows"], Float[Array, ""]]:
        """The belief after the next image, of total 1, and the image's probability, from its likelihood."""
        reach, size = self.reach, len(self.there)
        wide = jnp.pad(jnp.matmul(self.changes.T, belief, precision=_EXACT), ((0, 0), (2 * reach, 2 * reach)))
        starts = reach - self.shifts - self.steps.shape[1] // 2
        moved = (1 - self.kidnapped) * self._convolve(wide, self.steps[:, ::-1], starts, size + 2 * reach)
        outside = jnp.where(self._is_inside, 0.0, moved).sum()
        carried = self.kidnapped * belief.sum() + outside  # who moves beyond an end may be anywhere on the map
        inside = jnp.where(self._is_inside, moved, 0.0)[:, reach : reach + size]
        return self.normalize((inside + carried * self.anywhere) * here[None])

    def before(self, later: Float[Array, "speeds rows"], here: Float[Array, " rows"]) -> Float[Array, "speeds rows"]:
        """Relative probabilities of an image and those after it, by the state before: the transpose of `after`."""
        later = later * here[None]
        anywhere = (later * self.anywhere).sum()
        wide = jnp.where(self._is_inside, jnp.pad(later, ((0, 0), (self.reach, self.reach))), anywhere)
        starts = self.reach + self.shifts - self.steps.shape[1] // 2
        moved = jnp.matmul(self.changes, self._convolve(wide, self.steps, starts, len(self.there)), precision=_EXACT)
        seen = (1 - self.kidnapped) * moved + self.kidnapped * anywhere
        return jnp.where(seen.max() > 0, seen / jnp.where(seen.max() > 0, seen.max(), 1.0), 1.0)

    def likelihood(self, evidence: Evidence) -> Float[Array, " rows"]:
        """Likelihood of an image at each row, relative to that of an image that shows nothing of the map."""
        size, beside = len(self.there), _gaussian(0.0, _BESIDE)
        places = jnp.where(evidence.rows < 0, size, evidence.rows)  # beyond the end: dropped
        shares = jnp.zeros(size).at[places].add(evidence.shares, mode="drop")
        shares = jnp.convolve(shares, beside, precision=_EXACT)[len(beside) // 2 :][:size]
        near = jnp.where(self.there, shares, 0.0)
        total = near.sum()
        relative = near * jnp.sum(self.there, dtype=near.dtype) / jnp.where(total > 0, total, 1.0)
        return jnp.where(self.there & (total > 0), self.correct * evidence.odds * relative + 1 - self.correct, 1.0)

    def normalize(self, belief: Float[Array, "speeds rows"]) -> tuple[Float[Array, "speeds rows"], Float[Array, ""]]:
        """A belief of total 1, and its total before; if images and motion exclude each other, nothing is known."""
        total = belief.sum()
        return jnp.where(total > 0, belief / jnp.where(total > 0, total, 1.0), self.anywhere), total

    @property
    def _is_inside(self) -> Bool[Array, "1 wide"]:
        """Whether rows from -reach to size + reach are on the map or in a gap."""
        rows = jnp.arange(-self.reach, len(self.there) + self.reach)
        return ((rows >= 0) & (rows < len(self.there) - jnp.argmax(self.there[::-1])))[None]

    def _convolve(self, values: Array, steps: Array, starts: Array, size: int) -> Array:
        """Totals over k of steps[v, k] * values[v, starts[v] + k + row], for `size` rows."""
        number = steps.shape[1]
        cut = lambda row, start: jax.lax.dynamic_slice(row, (start,), (size + number - 1,))  # noqa: E731
        aligned = jax.vmap(cut)(values, starts)
        step = lambda k: steps[:, k, None] * jax.lax.dynamic_slice_in_dim(aligned, k, size, axis=1)  # noqa: E731
        return jax.lax.fori_loop(0, number, lambda k, total: total + step(k), jnp.zeros((len(values), size)))


def _gaussian(mean: float, spread: float) -> Float[np.ndarray, " steps"]:
    """Probabilities of -R .. R rows, up to four standard deviations around the mean."""
    reach = math.ceil(_REACH * spread + 0.5)
    steps = np.arange(-reach, reach + 1)
    exponents = -((steps - mean) ** 2) / (2 * spread**2)
    near = np.abs(steps - mean) <= max(_REACH * spread, 0.5)
    weights = np.where(near, np.exp(exponents - exponents.max(where=near, initial=-np.inf)), 0)
    return (weights / weights.sum()).astype(np.float32)


def off_the_map(drive: Drive, off: float, chance: float) -> float:
    """Probability that the robot is not on the map after an image, from that before it.

    `chance` is the probability of the image on the map, relative to an image that shows nothing of it.
    """
    moved = off * (1 - drive.returns) + (1 - off) * drive.leaves
    return moved / max(moved + (1 - moved) * chance, sys.float_info.min)


Method = Literal["causal", "lagged", "smoothed"]
Rows = Bool[np.ndarray, " rows"]  # of the database, that are there
LAG = 5  # images


class Followed(NamedTuple):
    """Rows of each image by their probability if the robot is on the map, best first, and that it is not on it."""

    rows: Int[Array, "images candidates"]
    p: Float[Array, "images candidates"]
    off: Float[Array, " images"]


@dataclass(frozen=True)
class DriveFilter:
    """Rankings of the queries of a drive by a model of its motion, see `mfvpr.evaluation.drives`.

    systems = {"mine": mfvpr.System(pipeline, scorers, sequences={"histogram": (DriveFilter("smoothed"),)})}
    """

    method: Method = "causal"  # uses the queries before; "lagged": also the next 5; "smoothed": all
    drive: Drive = DEFAULT_DRIVE

    def __post_init__(self) -> None:
        require_word("method", self.method, Method)
        if not isinstance(self.drive, Drive):
            raise InputError(f"drive: expected Drive(...), got {self.drive!r}")

    @property
    def name(self) -> str:
        """Its part in the name of a ranking, such as `causal sequence`."""
        return f"{self.method} {SEQUENCE}"

    def __call__(
        self, ranked: Ranked, num_rows: int, excluded: Bool[np.ndarray, "queries rows"] | None = None
    ) -> Ranked:
        """Rank all rows of the database, from rankings of the queries in their order; as many rows as candidates.

        Scores are probabilities of the rows, small if the query seems to show a place that is not in the database.
        Rows that a query has in `excluded` are not ranked.
        """
        hidden = np.zeros((len(ranked.rows), num_rows), bool) if excluded is None else excluded
        size, most_hidden = ranked.rows.shape[1], int(hidden.sum(axis=1).max(initial=0))
        followed = follow(Evidence.of(ranked), self.drive, np.ones(num_rows, bool), self.method, size + most_hidden)
        ranking = Ranked(followed.rows, followed.p * (1 - followed.off[:, None]))
        ranking = ranking.without(np.take_along_axis(hidden, followed.rows, axis=1))
        return Ranked(ranking.rows[:, :size], ranking.scores[:, :size])


def follow(
    evidence: Evidence, drive: Drive, there: Rows, method: Method = "causal", depth: int | None = None
) -> Followed:
    """The first `depth` rows of each image of a drive, None = as many as candidates; see `DriveFilter`."""
    images, candidates = evidence.rows.shape
    depth = min(candidates if depth is None else depth, len(there))
    if not images or not depth:
        return Followed(np.full((images, candidates), -1), np.zeros((images, candidates)), np.zeros(images))
    model = DriveModel.of(drive, there)
    rows, p, chances = _lagged(evidence, model, lag=0, depth=depth)
    step = lambda off, chance: off_the_map(drive, off, chance)  # noqa: E731
    off = np.array([*itertools.accumulate(np.asarray(chances).tolist(), step, initial=drive.off)][1:])
    if method == "lagged":
        rows, p = (values[LAG:] for values in _lagged(_pad(evidence, LAG), model, lag=LAG, depth=depth)[:2])
    if method == "smoothed":
        length = math.isqrt(images - 1) + 1
        padded = _pad(evidence, -images % length)
        parts = jax.tree.map(lambda values: values.reshape(-1, length, *values.shape[1:]), padded)
        smoothed = _smoothed(parts, model, depth=depth)
        rows, p = (values.reshape(-1, depth)[:images] for values in smoothed)
    return Followed(np.asarray(rows), np.asarray(p), off)


def _pad(evidence: Evidence, number: int) -> Evidence:
    """Evidence with further images that say nothing."""
    return jax.tree.map(lambda values: np.pad(values, ((0, number), *[(0, 0)] * (values.ndim - 1))), evidence)


@partial(compiled, static_argnames=("lag", "depth"))
def _lagged(evidence: Evidence, drive: DriveModel, *, lag: int, depth: int) -> tuple[Array, Array, Array]:
    """The best rows of the image `lag` images before each one, their probabilities, and that of each image."""

    def advance(last: tuple[Array, Array], image: Evidence) -> tuple[tuple[Array, Array], tuple[Array, Array, Array]]:
        beliefs, likelihoods = last
        here, push = drive.likelihood(image), lambda values, value: jnp.concatenate([values[1:], value[None]])
        after, chance = drive.after(beliefs[-1], here)
        beliefs, likelihoods = push(beliefs, after), push(likelihoods, here)
        later = jnp.ones_like(after)
        for next_likelihood in likelihoods[:0:-1]:
            later = drive.before(later, next_likelihood)
        return (beliefs, likelihoods), (*_best_rows(beliefs[0], later, drive, depth), chance)

    beliefs = jnp.broadcast_to(drive.anywhere, (lag + 1, *drive.anywhere.shape))
    return jax.lax.scan(advance, (beliefs, jnp.ones((lag + 1, len(drive.there)))), evidence)[1]


@partial(compiled, static_argnames="depth")
def _smoothed(parts: Evidence, drive: DriveModel, *, depth: int) -> tuple[Array, Array]:
    """The best rows of each image, from all images, and their probabilities.

    Beliefs are kept at the start of each part, and computed again.
    """

    def forward(belief: Array, image: Evidence) -> tuple[Array, tuple[Array, Array, Array]]:
        here = drive.likelihood(image)
        belief, _ = drive.after(belief, here)
        return belief, (belief, here, image.odds > 0)  # padding has no odds

    def forward_part(belief: Array, part: Evidence) -> tuple[Array, Array]:
        return jax.lax.scan(forward, belief, part)[0], belief

    def backward(later: Array, image: tuple[Array, Array, Array]) -> tuple[Array, tuple[Array, Array]]:
        belief, here, is_image = image
        return jnp.where(is_image, drive.before(later, here), later), _best_rows(belief, later, drive, depth)

    def backward_part(later: Array, part: tuple[Array, Evidence]) -> tuple[Array, tuple[Array, Array]]:
        return jax.lax.scan(backward, later, jax.lax.scan(forward, *part)[1], reverse=True)

    _, starts = jax.lax.scan(forward_part, drive.anywhere, parts)
    return jax.lax.scan(backward_part, jnp.ones_like(drive.anywhere), (starts, parts), reverse=True)[1]


def _best_rows(belief: Array, later: Array, drive: DriveModel, depth: int) -> tuple[Array, Array]:
    """The most probable rows and their probabilities, from the images up to one and those after it."""
    both, _ = drive.normalize(belief * later)
    p, rows = jax.lax.top_k(jnp.where(drive.there, both.sum(axis=0), -1.0), depth)
    return rows, p
