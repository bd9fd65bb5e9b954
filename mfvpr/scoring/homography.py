"""Homography by RANSAC, SSM-RAN's re-ranking (paper, section IV): how many matches one plane's motion explains.

The geometric model that the paper compares with. A homography through four matches maps the candidate's points to the
query's; of many, the one with the most inliers counts. It says what OpenCV's findHomography says, up to the luck of the
samples: those of a round are solved and counted at once, and what comes after the sample where OpenCV stops counts not.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from mfvpr.scoring import planes, quads
from mfvpr.scoring.fields import check_choices, choice, flag, number, whole
from mfvpr.scoring.shifts import query_features
from mfvpr.scoring.weights import match_confidence
from mfvpr.types import Array, Matches, value
from mfvpr.utils.numerics import at_least_single, masked, where_finite, without_gradient

_TOGETHER = 16  # matches that all models of a round are compared with in one step
_ROUNDS = 8  # as many as the samples need, before degenerate draws end the search


class Estimate(NamedTuple):
    """What RANSAC gives of one pair.

    matrix: `[3, 3]` maps (x, y, 1) of the candidate to the query's, px, with 1 as its last number; NaN = there is none.
    inliers: `[K]` bool.
    score: `[]`.
    samples: `[]` int32, how many were looked at before the search stopped.
    """

    matrix: Array
    inliers: Array
    score: Array
    samples: Array


@value
class Homography:
    """s = number of matches whose point of the candidate lands within `threshold` of the query's, by the best model.

    A pair's samples depend on its matches alone: the score is the same whatever is scored beside it, on any number of
    devices, and whatever the order of the matches. Each match counts with its confidence. There is no gradient.

    Attributes:
        threshold: of an inlier, px of the query's image; the paper's are 8 and 24.
        max_iterations: samples, at most; less than 1 scores NaN. Degenerate draws do not count, but where almost all
            are (49 of 50), the search ends before.
        confidence: RANSAC stops after so many samples that one of them was all inliers with this probability, if there
            are as many inliers as the best model has; from 1 it never stops early, not above 0 scores NaN.
        measure: `inliers` counts them; `msac` sums 1 - (error / threshold)^2 (Torr & Zisserman, CVIU 2000).
        refit: fit the best model to its inliers by least squares, and count again, as OpenCV 5 does. OpenCV 4, of the
            paper's time, refines the homography after it has counted.
        few: score of less than 4 matches, `count` (re-ranking-for-VPR) or `zero` (Patch-NetVLAD); 4 score 4.
        per_feature: divide by the number of the query's keypoints, matched or not, as Patch-NetVLAD does.
        seed: of the samples.
    """

    threshold: float | Array = number(24.0, "px")
    max_iterations: float | Array = number(2000.0, "samples", "at most", bounds=(1.0, 1e6))
    confidence: float | Array = number(0.995, "", "that a sample was all inliers", bounds=(1e-6, 0.999999))
    measure: str = choice("inliers", "msac")
    refit: bool = flag(False, "count again after least squares")
    few: str = choice("count", "zero", note="less than 4 matches")
    per_feature: bool = flag(False)
    seed: int = whole(0, "", "of the samples", bounds=(0, 2**31 - 1), swept=False)

    def __post_init__(self) -> None:
        check_choices(self)

    def __call__(self, matches: Matches) -> Array:
        """Score of one pair, `[]` float32."""
        return self.estimate(matches).score

    def estimate(self, matches: Matches) -> Estimate:
        """The model of one pair, its inliers and its score."""
        points = jnp.concatenate([at_least_single(matches.points1), at_least_single(matches.points0)], axis=-1)
        points, counts, *limits = without_gradient(
            "homography: the number of inliers has no gradient; take a score that has one, such as HistogramOfShifts",
            (points, match_confidence(matches), self.threshold, self.max_iterations, self.confidence),
        )
        threshold, max_iterations, sureness = (jnp.asarray(limit, points.dtype) for limit in limits)
        sureness = jnp.minimum(sureness, 1.0)  # as OpenCV
        counts = counts.astype(points.dtype)
        real = counts > 0
        if len(real) == 0:
            return Estimate(jnp.full((3, 3), jnp.nan, points.dtype), real, jnp.sum(counts), jnp.zeros((), jnp.int32))
        frame = planes.Frame.of(
            *(jnp.asarray(size, points.dtype) for size in (matches.image_size1, matches.image_size0))
        )
        inside = masked(frame.inside(points), real, jnp.nan)  # NaN is nobody's inlier
        threshold = threshold / frame.scale[1]
        order = quads.canonical_order(masked(points, real), real)
        number = jnp.sum(real, dtype=jnp.int32)
        search = _Search(
            self.measure, matches.confidence is None, inside[order], counts[order], number, threshold, max_iterations,
            sureness,
        )  # fmt: skip
        # Other generators draw otherwise in a batch than alone.
        model, samples = search(jax.random.key(self.seed, impl="threefry2x32"))
        if self.refit:
            model = planes.least_squares(
                model, masked(inside, real), masked(counts, planes.is_inlier(model, inside, threshold))
            )
        inliers = jnp.where(number == 4, real, planes.is_inlier(model, inside, threshold))
        score = jnp.sum(masked(search.worth(model, inside), inliers) * counts)
        few = jnp.sum(counts) if self.few == "count" else jnp.zeros_like(score)
        score = jnp.where(number == 4, jnp.sum(counts), jnp.where(number < 4, few, score))
        score = score / query_features(matches) if self.per_feature else score
        finite = where_finite(score, masked(points, real), counts)
        usable = (threshold >= 0) & (max_iterations >= 1) & (sureness > 0)
        return Estimate(frame.outside(model), inliers, jnp.where(usable, finite, jnp.nan), samples)


class _Search(NamedTuple):
    """RANSAC among matches `[K]` in the order that samples are drawn from, in the coordinates of a frame."""

    measure: str
    each_counts_one: bool
    points: Array  # [K, 4]
    counts: Array  # [K]
    number: Array  # of real matches
    threshold: Array
    max_iterations: Array
    confidence: Array

    def __call__(self, key: Array) -> tuple[Array, Array]:
        """The best model `[9]`, NaN where there is none, and how many samples were looked at."""
        dtype = self.points.dtype
        rounds = _ROUNDS * jnp.ceil(self.max_iterations / quads.ROUND).astype(jnp.int32)

        def goes_on(state: _State) -> Array:
            return state.some & (state.samples < self._needed(state.inliers)) & (state.round < rounds)

        def one_round(state: _State) -> _State:
            four, drawn = quads.accepted(self.points, key, state.round, jnp.maximum(self.number, 4))
            models, place = planes.through(four), jnp.arange(quads.ROUND, dtype=jnp.int32)
            quality, inliers, number = self._compare(models)
            quality = jnp.where((place < drawn) & (number > 3), quality, 0.0)
            # As one after the other: what comes after the sample where that search stops was not looked at.
            leading = masked(inliers, quality > _before(quality, state.quality))  # of each model that was the best
            known = _before(leading, state.inliers)
            looked = (place < drawn) & (state.samples + place < self._needed(known))
            quality = masked(quality, looked)
            best = jnp.argmax(quality)
            return _State(
                round=state.round + 1,
                samples=state.samples + jnp.sum(looked, dtype=jnp.int32),
                quality=jnp.maximum(quality[best], state.quality),
                inliers=jnp.maximum(jnp.max(masked(leading, looked)), state.inliers),
                model=jnp.where(quality[best] > state.quality, models[:, best], state.model),
                some=drawn > 0,
            )

        nothing = jnp.zeros((), dtype)
        start = jnp.zeros((), jnp.int32)
        state = _State(start, start, nothing, nothing, jnp.full(9, jnp.nan, dtype), self.number >= 4)
        state = jax.lax.while_loop(goes_on, one_round, state)
        return state.model, state.samples

    def worth(self, model: Array, points: Array) -> Array:
        """`[K]` what matches that are inliers of a model add to its quality."""
        if self.measure == "inliers":
            return jnp.ones_like(points[:, 0])
        return _closeness(*planes.miss(model, points, self.threshold))

    def _compare(self, models: Array) -> tuple[Array, Array, Array]:
        """(quality `[R]`, inliers `[R]`) of models `[9, R]`, each match with its count; and the inliers' number `[R]`.

        Some matches at a time: all would leave the cache, and one would be a step too short.
        """
        padding = (0, -len(self.counts) % _TOGETHER)
        points = jnp.pad(self.points, (padding, (0, 0)), constant_values=jnp.nan).reshape(-1, _TOGETHER, 4)
        counts = jnp.pad(self.counts, padding).reshape(-1, _TOGETHER)

        def some(step: Array, sums: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            quality, inliers, number = sums
            for point, count in zip(points[step], counts[step], strict=True):
                error, limit = planes.miss(models, point, self.threshold)
                inlier = error <= limit
                inliers = inliers + jnp.where(inlier, count, 0.0)
                if not self.each_counts_one:
                    number = number + inlier.astype(number.dtype)
                if self.measure == "msac":
                    quality = quality + jnp.where(inlier, count * _closeness(error, limit), 0.0)
            return quality, inliers, number

        none = jnp.zeros_like(models[0])
        quality, inliers, number = jax.lax.fori_loop(0, len(points), some, (none, none, none))
        return inliers if self.measure == "inliers" else quality, inliers, inliers if self.each_counts_one else number

    def _needed(self, inliers: Array) -> Array:
        """Samples after which one of them was all inliers with the confidence, at most `max_iterations`."""
        share = inliers / jnp.maximum(jnp.sum(self.counts), 1e-6)
        wrong = jnp.log1p(-(jnp.minimum(share, 1.0) ** 4))  # the logarithm of the share of samples that are not
        samples = jnp.round(jnp.log1p(-self.confidence) / jnp.where(wrong < 0, wrong, -1.0))
        samples = jnp.where(wrong < 0, jnp.minimum(samples, self.max_iterations), self.max_iterations)
        return samples.astype(jnp.int32)


def _closeness(error: Array, limit: Array) -> Array:
    """1 of no error, 0 of one at the threshold; both squared, and in one unit."""
    return 1.0 - error / jnp.where(limit > 0, limit, 1.0)


class _State(NamedTuple):
    round: Array
    samples: Array
    quality: Array
    inliers: Array  # the most of any model that was the best
    model: Array  # [9]
    some: Array  # whether the last round had a sample


def _before(values: Array, start: Array) -> Array:
    """`[R]` the largest of `start` and the values before each."""
    return jnp.maximum(jnp.concatenate([jnp.zeros_like(values[:1]), jax.lax.cummax(values)[:-1]]), start)
