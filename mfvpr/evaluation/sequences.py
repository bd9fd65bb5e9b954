"""Rankings of a whole drive: each query is ranked with the help of the queries before it, or of all queries."""

import itertools
import math
from dataclasses import dataclass
from functools import partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from mfvpr.core.types import Array
from mfvpr.evaluation.drives import DEFAULT_DRIVE, Drive, DriveModel, Evidence, off_the_map
from mfvpr.evaluation.rankings import SEQUENCE, Ranked
from mfvpr.utils.errors import InputError, require_word
from mfvpr.utils.numerics import compiled

Method = Literal["causal", "lagged", "smoothed"]
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

    Attributes:
        method: "causal" uses the queries before, "lagged" also the next 5, "smoothed" all.
        drive: motion of the robot.
    """

    method: Method = "causal"
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
        size = ranked.rows.shape[1]
        left_out = 0 if excluded is None else int(excluded.sum(axis=1).max(initial=0))
        followed = follow(Evidence.of(ranked), self.drive, np.ones(num_rows, bool), self.method, size + left_out)
        rows, p = followed.rows, followed.p * (1 - followed.off[:, None])
        if excluded is None:
            return Ranked(rows, p)
        is_left_out = np.take_along_axis(excluded, rows, axis=1)
        order = np.argsort(is_left_out, axis=1, kind="stable")[:, :size]
        values = np.where(is_left_out, -1, rows), np.where(is_left_out, np.nan, p)
        return Ranked(*(np.take_along_axis(each, order, axis=1) for each in values))


def follow(
    evidence: Evidence,
    drive: Drive,
    there: Bool[np.ndarray, " rows"],
    method: Method = "causal",
    depth: int | None = None,
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
        is_image = (np.arange(padded.odds.size) < images).reshape(-1, length)
        smoothed = _smoothed(parts, is_image, model, depth=depth)
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
def _smoothed(
    parts: Evidence, is_image: Bool[Array, "parts images"], drive: DriveModel, *, depth: int
) -> tuple[Array, Array]:
    """The best rows of each image, from all images, and their probabilities.

    Beliefs are kept at the start of each part, and computed again.
    """

    def forward(belief: Array, image: Evidence) -> tuple[Array, tuple[Array, Array]]:
        here = drive.likelihood(image)
        belief, _ = drive.after(belief, here)
        return belief, (belief, here)

    def forward_part(belief: Array, part: Evidence) -> tuple[Array, Array]:
        return jax.lax.scan(lambda belief, image: (forward(belief, image)[0], None), belief, part)[0], belief

    def backward(later: Array, image: tuple[Array, Array, Array]) -> tuple[Array, tuple[Array, Array]]:
        belief, here, is_image = image
        return jnp.where(is_image, drive.before(later, here), later), _best_rows(belief, later, drive, depth)

    def backward_part(later: Array, part: tuple[Array, Evidence, Array]) -> tuple[Array, tuple[Array, Array]]:
        start, images, is_image = part
        _, beliefs_and_likelihoods = jax.lax.scan(forward, start, images)
        return jax.lax.scan(backward, later, (*beliefs_and_likelihoods, is_image), reverse=True)

    _, starts = jax.lax.scan(forward_part, drive.anywhere, parts)
    return jax.lax.scan(backward_part, jnp.ones_like(drive.anywhere), (starts, parts, is_image), reverse=True)[1]


def _best_rows(belief: Array, later: Array, drive: DriveModel, depth: int) -> tuple[Array, Array]:
    """The most probable rows and their probabilities, from the images up to one and those after it."""
    both, _ = drive.normalize(belief * later)
    p, rows = jax.lax.top_k(jnp.where(drive.there, drive.by_row(both), -1.0), depth)
    return rows, p
