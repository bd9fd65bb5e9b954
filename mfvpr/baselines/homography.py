"""Homography by RANSAC, SSM-RAN's re-ranking (paper, section IV): how many matches one plane's motion explains.

`Homography` has the result of OpenCV's findHomography, up to the random samples: all samples of a round are solved and
counted at once, and samples after the one where OpenCV would stop do not count. `OpenCvHomography` calls OpenCV.
"""

from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from mfvpr.baselines import planes
from mfvpr.baselines.spatial_scores import query_features
from mfvpr.core.scorer import check_bounds
from mfvpr.core.types import Array, Matches, value
from mfvpr.core.weights import match_confidence, require_sizes
from mfvpr.utils.errors import InputError, NoGradientError
from mfvpr.utils.fields import FLAG, POSITIVE, check_fields, number, one_of, setting, whole
from mfvpr.utils.numerics import at_least_single, available_cpus, is_concrete, masked, where_finite

_MATCHES_PER_STEP = 16  # matches that all models of a round are compared with in one step
_ROUNDS = 8  # the search ends after so many times the rounds that samples without degenerate draws would need


class Estimate(NamedTuple):
    """Result of RANSAC for one pair, after a number of samples."""

    matrix: Float[Array, "3 3"]  # (x, y, 1) of the candidate -> query, px, last entry 1; NaN = no homography
    inliers: Bool[Array, " slots"]
    score: Float[Array, ""]
    samples: Int[Array, ""]


@value
class Homography:
    """Number of inliers of the best homography that RANSAC finds.

        mfvpr.Homography(threshold=24.0)(matches)

    An inlier is a match with its candidate point mapped to within `threshold` of its query point. The samples of a pair
    depend on its matches alone. Each match counts with its confidence. There is no gradient.

    Attributes:
        threshold: largest error of an inlier, px of the query; 8 and 24 in the paper.
        max_iterations: maximum number of samples; an array less than 1 scores NaN. Degenerate draws do not count, but
            the search ends early if almost all draws (49 of 50) are degenerate.
        confidence: RANSAC stops once a sample of inliers only was drawn with this probability, assuming as many inliers
            as the best model has; an array of 1 never stops early, one not above 0 scores NaN.
        refit: fit the best model to its inliers by least squares, and count again, as OpenCV 5 does. OpenCV 4, of the
            paper's time, refines the homography after the count.
        few: score of less than 4 matches, `count` (re-ranking-for-VPR) or `zero` (Patch-NetVLAD); 4 matches score 4.
        per_feature: divide by the number of the query's keypoints, matched or not, as Patch-NetVLAD does.
        seed: of the samples.
    """

    threshold: float | Array = setting(24.0, POSITIVE, unit="px")
    max_iterations: float | Array = setting(2000.0, number(1.0, 1000000.0), "at most", unit="samples")
    confidence: float | Array = setting(0.995, number(1e-06, 0.999999), "that a sample was all inliers")
    refit: bool = setting(False, FLAG, "count again after least squares", static=True)
    few: str = setting("count", one_of("count", "zero"), "less than 4 matches", static=True)
    per_feature: bool = setting(False, FLAG, static=True)
    seed: int = setting(0, whole(0, 2**31 - 1), "of the samples", swept=False, static=True)

    __post_init__ = check_fields

    def __call__(self, matches: Matches) -> Float[jax.Array, ""]:
        """Score of one pair `[K]`, float32."""
        return self.estimate(matches).score

    def estimate(self, matches: Matches) -> Estimate:
        """Homography of one pair, with its inliers and its score."""
        points = jnp.concatenate([at_least_single(matches.points1), at_least_single(matches.points0)], axis=-1)
        points, confidence, *limits = _without_gradient(
            "homography: the number of inliers has no gradient; take a score that has one, such as HistogramOfShifts",
            (points, match_confidence(matches), self.threshold, self.max_iterations, self.confidence),
        )
        threshold, max_iterations, probability = (jnp.asarray(limit, points.dtype) for limit in limits)
        probability = jnp.minimum(probability, 1.0)  # as OpenCV
        counts = confidence.astype(points.dtype)
        real = counts > 0
        if len(real) == 0:
            return Estimate(jnp.full((3, 3), jnp.nan, points.dtype), real, jnp.sum(counts), jnp.zeros((), jnp.int32))
        require_sizes(matches.image_size0, matches.image_size1)
        frame = planes.Frame.of(matches.image_size1, matches.image_size0, points.dtype)
        normalized = masked(frame.normalize(points), real, jnp.nan)  # NaN is never an inlier
        threshold = threshold / frame.scale[1]
        order = planes.canonical_order(masked(points, real), real)
        number = jnp.sum(real, dtype=jnp.int32)
        limits = threshold, max_iterations, probability
        search = _Search(matches.confidence is None, normalized[order], counts[order], number, *limits)
        # The generator is named, because others draw different numbers in a batch.
        model, samples = search(jax.random.key(self.seed, impl="threefry2x32"))
        if self.refit:
            model = planes.least_squares(
                model, masked(normalized, real), masked(counts, planes.is_inlier(model, normalized, threshold))
            )
        inliers = jnp.where(number == 4, real, planes.is_inlier(model, normalized, threshold))
        score = jnp.sum(masked(counts, inliers))
        few = jnp.sum(counts) if self.few == "count" else jnp.zeros_like(score)
        score = jnp.where(number == 4, jnp.sum(counts), jnp.where(number < 4, few, score))
        score = score / query_features(matches) if self.per_feature else score
        finite = where_finite(score, masked(points, real), counts)
        usable = (threshold >= 0) & (max_iterations >= 1) & (probability > 0)
        return Estimate(frame.to_pixels(model), inliers, jnp.where(usable, finite, jnp.nan), samples)


class _Search(NamedTuple):
    """RANSAC of one pair, with matches in canonical order and in the coordinates of a frame."""

    each_counts_one: bool
    points: Float[Array, "slots 4"]
    counts: Float[Array, " slots"]  # confidence of the matches
    number: Int[Array, ""]  # of real matches
    threshold: Float[Array, ""]
    max_iterations: Float[Array, ""]
    probability: Float[Array, ""]

    def __call__(self, key: Array) -> tuple[Float[Array, "9"], Int[Array, ""]]:
        """The best model, NaN if there is none, and the number of samples."""
        dtype = self.points.dtype
        rounds = _ROUNDS * jnp.ceil(self.max_iterations / planes.ROUND).astype(jnp.int32)

        def is_searching(state: _State) -> Array:
            return state.has_samples & (state.samples < self._count_samples(state.inliers)) & (state.round < rounds)

        def search_round(state: _State) -> _State:
            four, num_samples = planes.draw_samples(self.points, key, state.round, jnp.maximum(self.number, 4))
            models, place = planes.through(four), jnp.arange(planes.ROUND, dtype=jnp.int32)
            inliers, number = self._compare(models)
            inliers = jnp.where((place < num_samples) & (number > 3), inliers, 0.0)
            # As if samples came one after the other: samples after the one where that search stops do not count.
            before = jnp.concatenate([jnp.zeros_like(inliers[:1]), jax.lax.cummax(inliers)[:-1]])
            most_before = jnp.maximum(before, state.inliers)
            counted = (place < num_samples) & (state.samples + place < self._count_samples(most_before))
            inliers = masked(inliers, counted)
            best = jnp.argmax(inliers)
            return _State(
                round=state.round + 1,
                samples=state.samples + jnp.sum(counted, dtype=jnp.int32),
                inliers=jnp.maximum(inliers[best], state.inliers),
                model=jnp.where(inliers[best] > state.inliers, models[:, best], state.model),
                has_samples=num_samples > 0,
            )

        zero, start = jnp.zeros((), dtype), jnp.zeros((), jnp.int32)
        state = _State(start, start, zero, jnp.full(9, jnp.nan, dtype), self.number >= 4)
        state = jax.lax.while_loop(is_searching, search_round, state)
        return state.model, state.samples

    def _compare(self, models: Float[Array, "9 samples"]) -> tuple[Array, Array]:
        """Sum of the inliers' counts and number of inliers of each model, in steps that fit into the cache."""
        padding = (0, -len(self.counts) % _MATCHES_PER_STEP)
        points = jnp.pad(self.points, (padding, (0, 0)), constant_values=jnp.nan).reshape(-1, _MATCHES_PER_STEP, 4)
        counts = jnp.pad(self.counts, padding).reshape(-1, _MATCHES_PER_STEP)

        def compare_step(step: Array, sums: tuple[Array, Array]) -> tuple[Array, Array]:
            inliers, number = sums
            for point, count in zip(points[step], counts[step], strict=True):
                inlier = planes.is_inlier(models, point, self.threshold)
                inliers = inliers + jnp.where(inlier, count, 0.0)
                if not self.each_counts_one:
                    number = number + inlier.astype(number.dtype)
            return inliers, number

        zeros = jnp.zeros_like(models[0])
        inliers, number = jax.lax.fori_loop(0, len(points), compare_step, (zeros, zeros))
        return inliers, inliers if self.each_counts_one else number

    def _count_samples(self, inliers: Array) -> Array:
        """Samples needed to draw four inliers with `probability`, at most `max_iterations`."""
        share = inliers / jnp.maximum(jnp.sum(self.counts), 1e-6)
        log_outlier = jnp.log1p(-(jnp.minimum(share, 1.0) ** 4))  # log of the probability that a sample has an outlier
        samples = jnp.round(jnp.log1p(-self.probability) / jnp.where(log_outlier < 0, log_outlier, -1.0))
        samples = jnp.where(log_outlier < 0, jnp.minimum(samples, self.max_iterations), self.max_iterations)
        return samples.astype(jnp.int32)


class _State(NamedTuple):
    round: Int[Array, ""]
    samples: Int[Array, ""]
    inliers: Float[Array, ""]  # of the best model
    model: Float[Array, "9"]
    has_samples: Bool[Array, ""]  # whether the last round had a sample


def _without_gradient(why: str, values: Any) -> Any:
    """The values; their derivative raises `NoGradientError` with the message `why`."""

    @jax.custom_jvp
    def same(values: Any) -> Any:
        return values

    @same.defjvp
    def refuse(*_: Any) -> Any:
        raise NoGradientError(why)

    return same(values)


@value
class OpenCvHomography:
    """s = number of inliers of cv2.findHomography, from the candidate's points to the query's.

        mfvpr.score_candidates(mfvpr.OpenCvHomography(), candidate_matches)  # [C]

    The score runs on the host: all functions of the library accept it, but `jit`, `vmap` and gradients do not. (JAX's
    callbacks may deadlock.) OpenCV's samples depend on the order of the matches, so that matches are sorted by
    `index0`, or by their coordinates without it. A match of confidence 0 is ignored, all others count fully. OpenCV 4
    counts the inliers before its last least squares, version 5 after it.

    Attributes:
        threshold: largest error of an inlier, px of the query; 8 and 24 in the paper.
        max_iterations: maximum number of samples; rounded to an integer.
        confidence: RANSAC stops once a sample of inliers only was drawn with this probability.
        estimator: `ransac`, the paper's, or `magsac` (USAC_MAGSAC; Barath et al., CVPR 2020).
        few: score of less than 4 matches, `count` (re-ranking-for-VPR) or `zero` (Patch-NetVLAD).
    """

    threshold: float | Array = setting(24.0, POSITIVE, unit="px")
    max_iterations: float | Array = setting(2000.0, number(1.0, 1000000.0), "at most", unit="samples")
    confidence: float | Array = setting(0.995, number(1e-06, 0.999999), "that a sample was all inliers")
    estimator: str = setting("ransac", one_of("ransac", "magsac"), static=True)
    few: str = setting("count", one_of("count", "zero"), "less than 4 matches", static=True)

    __post_init__ = check_fields

    def __call__(self, matches: Matches) -> Float[np.ndarray, ""]:
        """Score of one pair `[K]`, float32; an `InputError` if anything is traced, or a number is out of bounds."""
        if not is_concrete((self, matches)):
            raise InputError(
                "homography_opencv: expected matches that neither jit nor vmap nor grad traces, since "
                "OpenCV runs outside of JAX; call score_candidates, or take Homography"
            )
        check_bounds(self)  # OpenCV replaces a threshold of 0 by 3 px
        points = np.concatenate([matches.points1, matches.points0], axis=-1, dtype=np.float32, casting="unsafe")
        real = np.asarray(matches.mask)
        if matches.confidence is not None:
            if np.isnan(np.asarray(matches.confidence)[real]).any():
                return np.array(np.nan, np.float32)
            real = real & (np.asarray(matches.confidence) > 0)
        points = points[real]
        if not np.isfinite(points).all():
            return np.array(np.nan, np.float32)
        if len(points) < 4:
            return np.array(len(points) if self.few == "count" else 0, np.float32)
        import cv2  # here, because it slows down the import of the library

        keys = points.T[::-1] if matches.index0 is None else [np.asarray(matches.index0)[real]]
        points = points[np.lexsort([*keys])]
        _, inliers = cv2.findHomography(
            points[:, :2],
            points[:, 2:],
            {"ransac": cv2.RANSAC, "magsac": cv2.USAC_MAGSAC}[self.estimator],
            float(self.threshold),
            maxIters=round(float(self.max_iterations)),
            confidence=float(self.confidence),
        )
        return np.array(0 if inliers is None else inliers.sum(), np.float32)

    def score_pairs(self, matches: Matches) -> Float[np.ndarray, " pairs"]:
        """Scores of pairs `[P, K, ...]`, float32."""
        host, count = jax.tree.map(np.asarray, matches), len(matches.mask)
        pairs = (jax.tree.map(lambda leaf, pair=pair: leaf[pair], host) for pair in range(count))
        with ThreadPoolExecutor(available_cpus()) as pool:  # OpenCV releases Python's lock
            return np.fromiter(pool.map(self, pairs), np.float32, count)
