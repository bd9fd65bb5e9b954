"""Homography by RANSAC, SSM-RAN's re-ranking (paper, section IV): how many matches one plane's motion explains.

`Homography` has the result of OpenCV's findHomography, up to the random samples: all samples of a round are solved and
counted at once, and samples after the one where OpenCV would stop do not count. `OpenCvHomography` calls OpenCV.

A model is a matrix, row by row, that maps points of the candidate (1) to points of the query (0). Matches are the
coordinates x1, y1, x0, y0. Samples are uniform, never degenerate, and independent of batch and padding.
"""

from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, Num

from mfvpr.baselines.spatial_scores import query_features
from mfvpr.core.scorer import check_bounds
from mfvpr.core.types import Array, Matches, value
from mfvpr.core.weights import match_confidence, require_sizes
from mfvpr.utils.errors import InputError, NoGradientError
from mfvpr.utils.fields import FLAG, POSITIVE, check_fields, number, one_of, setting, whole
from mfvpr.utils.numerics import at_least_single, available_cpus, is_concrete, masked, where_finite

ROUND = 256  # maximum number of samples of a round
_ROUNDS = 8  # the search ends after so many times the rounds that samples without degenerate draws would need
_DRAWS = 6 * ROUND  # draws for a round: a fifth of all draws of random points keep their orientations
_MATCHES_PER_STEP = 16  # matches that all models of a round are compared with in one step
_TRIANGLES = (0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3)
_FLAT = 1e-6  # area of a triangle, relative to its sides, that rounding can produce
_STEPS = 10  # of the least squares, as in OpenCV
_MIN_CURVATURE = 1e-9  # keeps the system solvable if the inliers do not determine a parameter
_FAR = 1e15  # coordinate in a frame; errors of farther points may overflow, so that these are no inliers
_EXACT = jax.lax.Precision.HIGHEST


class Estimate(NamedTuple):
    """Result of RANSAC for one pair, after a number of samples."""

    # (x, y, 1) of the candidate -> query, px; NaN = no homography. Its last entry is 1, or 0 if (0, 0) is at infinity.
    matrix: Float[Array, "3 3"]
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
        confidence: RANSAC stops once a sample of inliers only was drawn with this probability, if inliers are as many
            as the best model's; an array of 1 never stops early, one not above 0 scores NaN.
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
        limits = self.threshold, self.max_iterations, self.confidence
        points, confidence, *limits = _without_gradient((points, match_confidence(matches), *limits))
        threshold, max_iterations, probability = (jnp.asarray(limit, points.dtype) for limit in limits)
        probability = jnp.minimum(probability, 1.0)  # as OpenCV
        counts = confidence.astype(points.dtype)
        real = counts > 0
        if len(real) == 0:
            return Estimate(jnp.full((3, 3), jnp.nan, points.dtype), real, jnp.sum(counts), jnp.zeros((), jnp.int32))
        require_sizes(matches.image_size0, matches.image_size1)
        frame = Frame.of(matches.image_size1, matches.image_size0, points.dtype)
        normalized = frame.normalize(points)
        is_near = jnp.all(jnp.abs(normalized) < _FAR, axis=1)
        normalized = masked(normalized, real & is_near, jnp.nan)  # NaN is never an inlier
        threshold = threshold / frame.scale[1]
        order = canonical_order(masked(points, real), real)
        number = jnp.sum(real, dtype=jnp.int32)
        # The generator is named, because others draw different numbers in a batch.
        key = jax.random.key(self.seed, impl="threefry2x32")
        limits = threshold, max_iterations, probability
        each_counts_one = matches.confidence is None
        model, samples = _search(key, normalized[order], counts[order], number, *limits, each_counts_one)
        if self.refit:
            model = least_squares(model, normalized, masked(counts, is_inlier(model, normalized, threshold)))
        inliers = jnp.where(number == 4, real, is_inlier(model, normalized, threshold))
        score = jnp.sum(masked(counts, inliers))
        few = jnp.sum(counts) if self.few == "count" else jnp.zeros_like(score)
        score = jnp.where(number == 4, jnp.sum(counts), jnp.where(number < 4, few, score))
        score = score / query_features(matches) if self.per_feature else score
        finite = where_finite(score, masked(points, real), counts)
        usable = (threshold >= 0) & (max_iterations >= 1) & (probability > 0)
        return Estimate(frame.to_pixels(model), inliers, jnp.where(usable, finite, jnp.nan), samples)


@jax.custom_jvp
def _without_gradient(values: Any) -> Any:
    return values


@_without_gradient.defjvp
def _refuse_gradient(*_: Any) -> Any:
    advice = "take a score that has one, such as HistogramOfShifts"
    raise NoGradientError(f"homography: the number of inliers has no gradient; {advice}")


def _search(
    key: Array,
    points: Float[Array, "slots 4"],
    counts: Float[Array, " slots"],
    number: Int[Array, ""],
    threshold: Float[Array, ""],
    max_iterations: Float[Array, ""],
    probability: Float[Array, ""],
    each_counts_one: bool,
) -> tuple[Float[Array, "9"], Int[Array, ""]]:
    """RANSAC of one pair: the best model, NaN if there is none, and the number of samples.

    The `number` real matches come first, in canonical order and in a frame; `counts` are their confidences.
    """
    rounds = _ROUNDS * jnp.ceil(max_iterations / ROUND).astype(jnp.int32)
    place, every = jnp.arange(ROUND, dtype=jnp.int32), jnp.sum(counts)

    def count_samples(inliers: Array) -> Array:
        """Samples needed to draw four inliers with `probability`, at most `max_iterations`."""
        share = inliers / jnp.maximum(every, 1e-6)
        log_outlier = jnp.log1p(-(jnp.minimum(share, 1.0) ** 4))  # log of the probability that a sample has an outlier
        samples = jnp.round(jnp.log1p(-probability) / jnp.where(log_outlier < 0, log_outlier, -1.0))
        samples = jnp.where(log_outlier < 0, jnp.minimum(samples, max_iterations), max_iterations)
        return samples.astype(jnp.int32)

    def is_searching(state: _State) -> Array:
        return state.has_samples & (state.samples < count_samples(state.inliers)) & (state.round < rounds)

    def search_round(state: _State) -> _State:
        four, num_samples = draw_samples(points, key, state.round, jnp.maximum(number, 4))
        models = through(four)
        inliers, number_of = _count_inliers(models, points, counts, threshold, each_counts_one)
        inliers = jnp.where((place < num_samples) & (number_of > 3), inliers, 0.0)
        # As if samples came one after the other: samples after the one where that search stops do not count.
        before = jnp.concatenate([jnp.zeros_like(inliers[:1]), jax.lax.cummax(inliers)[:-1]])
        most_before = jnp.maximum(before, state.inliers)
        counted = (place < num_samples) & (state.samples + place < count_samples(most_before))
        inliers = masked(inliers, counted)
        best = jnp.argmax(inliers)
        return _State(
            round=state.round + 1,
            samples=state.samples + jnp.sum(counted, dtype=jnp.int32),
            inliers=jnp.maximum(inliers[best], state.inliers),
            model=jnp.where(inliers[best] > state.inliers, models[:, best], state.model),
            has_samples=num_samples > 0,
        )

    zero, start = jnp.zeros((), points.dtype), jnp.zeros((), jnp.int32)
    state = _State(start, start, zero, jnp.full(9, jnp.nan, points.dtype), number >= 4)
    state = jax.lax.while_loop(is_searching, search_round, state)
    return state.model, state.samples


class _State(NamedTuple):
    round: Int[Array, ""]
    samples: Int[Array, ""]
    inliers: Float[Array, ""]  # of the best model
    model: Float[Array, "9"]
    has_samples: Bool[Array, ""]  # whether the last round had a sample


def _count_inliers(
    models: Float[Array, "9 samples"], points: Array, counts: Array, threshold: Array, each_counts_one: bool
) -> tuple[Array, Array]:
    """Sum of the inliers' counts and number of inliers of each model, in steps that fit into the cache."""
    padding = (0, -len(counts) % _MATCHES_PER_STEP)
    points = jnp.pad(points, (padding, (0, 0)), constant_values=jnp.nan).reshape(-1, _MATCHES_PER_STEP, 4)
    counts = jnp.pad(counts, padding).reshape(-1, _MATCHES_PER_STEP)

    def count_step(step: Array, sums: tuple[Array, Array]) -> tuple[Array, Array]:
        inliers, number = sums
        for point, count in zip(points[step], counts[step], strict=True):
            inlier = is_inlier(models, point, threshold)
            inliers = inliers + jnp.where(inlier, count, 0.0)
            if not each_counts_one:
                number = number + inlier.astype(number.dtype)
        return inliers, number

    zeros = jnp.zeros_like(models[0])
    inliers, number = jax.lax.fori_loop(0, len(points), count_step, (zeros, zeros))
    return inliers, inliers if each_counts_one else number


def canonical_order(points: Float[Array, "slots 4"], real: Bool[Array, " slots"]) -> Int[Array, " slots"]:
    """Slots of the real matches, sorted by a hash of their coordinates whatever their order, then padding."""
    bits = jax.lax.bitcast_convert_type(points.astype(jnp.float32) + 0.0, jnp.uint32)  # 0 and -0 are equal
    code = jnp.zeros(real.shape, jnp.uint32)
    for column in range(4):  # Wellons' lowbias32, which maps no two numbers to the same
        code = code ^ bits[:, column]
        code = (code ^ (code >> 16)) * jnp.uint32(0x7FEB352D)
        code = (code ^ (code >> 15)) * jnp.uint32(0x846CA68B)
        code = code ^ (code >> 16)
    keys = ~real, code, *bits.T  # the coordinates decide if two codes are equal
    return jax.lax.sort((*keys, jnp.arange(len(real), dtype=jnp.int32)), num_keys=len(keys))[-1]


def draw_four(key: Array, round_number: Int[Array, ""] | int, count: Int[Array, ""] | int) -> Int[Array, "4 draws"]:
    """Four distinct numbers below `count` (at least 4), all sets equally likely."""
    bits = jax.random.bits(jax.random.fold_in(key, round_number), (4, _DRAWS), jnp.uint32)
    share = (bits >> 8).astype(jnp.float32) * 2.0**-24
    remaining = count - jnp.arange(4, dtype=jnp.int32)  # numbers that are not drawn yet
    place = jnp.minimum((share * remaining[:, None].astype(jnp.float32)).astype(jnp.int32), remaining[:, None] - 1)
    numbers: list[Array] = []
    ascending: list[Array] = []  # the same numbers
    for drawn in place:
        for smaller in ascending:
            drawn = drawn + (drawn >= smaller).astype(jnp.int32)
        numbers.append(drawn)
        for index, entry in enumerate(ascending):  # insert the drawn number; larger numbers move on
            ascending[index], drawn = jnp.minimum(entry, drawn), jnp.maximum(entry, drawn)
        ascending.append(drawn)
    return jnp.stack(numbers)


def draw_samples(points: Float[Array, "slots 4"], key: Array, round_number: Array, count: Array) -> tuple[Array, Array]:
    """Draw samples `[4, 4, S]`: (x1, y1, x0, y0) of four of the first `count` matches each; and their number.

    As in OpenCV's findHomography, a draw is rejected if no camera can see it: three of the points lie on a line in one
    image, or some but not all triangles change their orientation.
    """
    gather = lambda index: jnp.moveaxis(points.at[index].get(mode="promise_in_bounds"), 2, 0)  # noqa: E731
    index = jax.lax.optimization_barrier(draw_four(key, round_number, count))  # each coordinate would draw again
    x1, y1, x0, y0 = gather(index)
    same_orientation, flat = [], []
    for area1, area0, (corner, *ends) in zip(areas(x1, y1), areas(x0, y0), _TRIANGLES, strict=True):
        same_orientation.append(area1 * area0 > 0)
        for area, x, y in ((area1, x1, y1), (area0, x0, y0)):
            sides = sum(jnp.abs(values[end] - values[corner]) for values in (x, y) for end in ends)
            flat.append(jnp.abs(area) <= _FLAT * sides)
    number_same = jnp.sum(jnp.stack(same_orientation), axis=0)
    is_degenerate = ((number_same != 0) & (number_same != len(_TRIANGLES))) | jnp.any(jnp.stack(flat), axis=0)
    valid = jnp.cumsum(~is_degenerate, dtype=jnp.int32)
    draws = jnp.searchsorted(valid, jnp.arange(1, ROUND + 1, dtype=jnp.int32), method="scan_unrolled")
    index = index.at[:, jnp.minimum(draws, _DRAWS - 1)].get(mode="promise_in_bounds")
    return gather(index), jnp.minimum(valid[-1], ROUND)


def areas(x: Float[Array, "4 ..."], y: Float[Array, "4 ..."]) -> tuple[Array, Array, Array, Array]:
    """Twice the signed areas of the `_TRIANGLES` of four points."""
    x, y = x - x[:1], y - y[:1]
    a012, a013, a023 = (x[i] * y[j] - x[j] * y[i] for i, j in ((1, 2), (1, 3), (2, 3)))
    return a012, a013, a023, a023 + a012 - a013


def through(four: Float[Array, "coordinates=4 matches=4 samples"]) -> Float[Array, "9 samples"]:
    """Homographies through four matches (x1, y1, x0, y0).

    No three points may lie on a line. The fourth point of the candidate is p_3 = sum_i l_i p_i, where the l_i are
    ratios of triangles; in the query, q_3 = sum_i m_i q_i. A map from p_i to (m_i / l_i) q_i for i < 3 also maps p_3 to
    q_3. Hence H = sum_i (m_i / l_i) q_i r_i^T, where the r_i are the rows of the inverse of (p_0 p_1 p_2): the lines
    through two of these points. H is multiplied by l_0 l_1 l_2, so that it needs no division.
    """

    def shares(x: Array, y: Array) -> tuple[Array, Array, Array]:
        """The ratios of the fourth point, up to a common factor that avoids underflow."""
        _, a013, a023, a123 = areas(x, y)
        size = jnp.abs(a013) + jnp.abs(a023) + jnp.abs(a123)
        return a123 / size, -a023 / size, a013 / size

    x1, y1, x0, y0 = four
    (l0, l1, l2), (m0, m1, m2) = shares(x1, y1), shares(x0, y0)
    scales = m0 * l1 * l2, m1 * l0 * l2, m2 * l0 * l1
    x, y, u, v = (values - values[:1] for values in four)  # the first point is the origin of both images
    scales, x, y, u, v = jax.lax.optimization_barrier((scales, x, y, u, v))  # each entry would recompute them
    lines = (y[1] - y[2], x[2] - x[1], x[1] * y[2] - x[2] * y[1]), (y[2], -x[2]), (-y[1], x[1])
    top, middle = (
        [scales[1] * side[1] * lines[1][column] + scales[2] * side[2] * lines[2][column] for column in (0, 1)]
        for side in (u, v)
    )
    bottom = [sum(scale * line[column] for scale, line in zip(scales, lines, strict=True)) for column in (0, 1)]
    last = scales[0] * lines[0][2]
    # From coordinates relative to the first point back to those of the frame.
    last = last - bottom[0] * x1[0] - bottom[1] * y1[0]
    bottom = [*bottom, last]
    rows = [[*side, -side[0] * x1[0] - side[1] * y1[0]] for side in (top, middle)]
    model = [
        value + origin * base
        for row, origin in zip(rows, (x0[0], y0[0]), strict=True)
        for value, base in zip(row, bottom, strict=True)
    ]
    size = jnp.abs(bottom[0]) + jnp.abs(bottom[1]) + jnp.abs(bottom[2])
    return jnp.stack([*model, *bottom]) / size[None]  # NaN if all entries are 0: a model of zeros would have no errors


def is_inlier(model: Array, points: Array, threshold: Array) -> Array:
    """Whether H p1 is finite and close to p0: models `[9, ...]` and a match `[4]`, or a model and matches."""
    x1, y1, x0, y0 = jnp.moveaxis(points, -1, 0)
    u, v, w = (model[row] * x1 + model[row + 1] * y1 + model[row + 2] for row in (0, 3, 6))
    u, v, limit = u - x0 * w, v - y0 * w, threshold * w  # both sides times the last coordinate of H p1
    return (u * u + v * v <= limit * limit) & (w != 0)


def least_squares(model: Float[Array, "9"], points: Float[Array, "slots 4"], weights: Array) -> Float[Array, "9"]:
    """Model with the least weighted squared error for matches; those of weight 0 may have any points."""
    x1, y1, x0, y0 = masked(points, weights > 0).T  # an infinite error times 0 would be NaN
    plane, target, roots = jnp.stack([x1, y1, jnp.ones_like(x1)]), jnp.stack([x0, y0]), jnp.sqrt(weights)

    def errors_of(free: Float[Array, "8"]) -> Float[Array, " errors"]:
        u, v, w = jnp.matmul(jnp.append(free, last).reshape(3, 3), plane, precision=_EXACT)
        w = jnp.where(weights > 0, w, 1.0)
        return ((jnp.stack([u, v]) / w[None] - target) * roots[None]).reshape(-1)

    def step(_: int, state: tuple[Array, Array]) -> tuple[Array, Array]:
        free, damping = state
        errors, slopes = errors_of(free), jax.jacfwd(errors_of)(free)
        square = jnp.matmul(slopes.T, slopes, precision=_EXACT)
        square = square + jnp.diag(damping * jnp.diag(square) + _MIN_CURVATURE)
        change = jnp.linalg.solve(square, jnp.matmul(errors, slopes, precision=_EXACT))
        is_better = jnp.sum(errors_of(free - change) ** 2) < jnp.sum(errors**2)
        return jnp.where(is_better, free - change, free), damping * jnp.where(is_better, 0.1, 10.0)

    last = jnp.where(model[8] == 0, 0.0, 1.0)  # 0 = the center of the candidate has its image at infinity
    start = model[:8] / jnp.where(model[8] == 0, 1.0, model[8]), jnp.asarray(1e-3, model.dtype)
    return jnp.append(jax.lax.fori_loop(0, _STEPS, step, start)[0], last)


class Frame(NamedTuple):
    """Coordinates in which the points of images lie within -1 and 1; one far point costs the others no digits."""

    center: Float[Array, "4"]  # px
    scale: Float[Array, "2"]  # px

    @classmethod
    def of(cls, size1: Num[Array, "2"], size0: Num[Array, "2"], dtype: Any) -> "Frame":
        """Frame of images with these sizes in px; an invalid size leaves coordinates as they are."""
        sizes = jnp.stack([jnp.asarray(size, dtype) for size in (size1, size0)])
        half = jnp.where(jnp.isfinite(sizes) & (sizes > 0), sizes, 0.0) / 2
        scale = jnp.max(half, axis=1)
        return cls(half.reshape(4), jnp.where(scale > 0, scale, 1.0))

    def normalize(self, points: Float[Array, "slots 4"]) -> Float[Array, "slots 4"]:
        return (points - self.center[None]) / jnp.repeat(self.scale, 2)[None]

    def to_pixels(self, model: Float[Array, "9"]) -> Float[Array, "3 3"]:
        """Matrix in px of a model in the coordinates of the frame; the last entry is 1, or 0."""
        (x1, y1, x0, y0), (scale1, scale0) = self.center, self.scale
        zero, unit = jnp.zeros_like(x1), jnp.ones_like(x1)
        enter = jnp.stack([unit, zero, -x1, zero, unit, -y1, zero, zero, scale1]).reshape(3, 3)
        leave = jnp.stack([scale0, zero, x0, zero, scale0, y0, zero, zero, unit]).reshape(3, 3)
        matrix = jnp.matmul(jnp.matmul(leave, model.reshape(3, 3), precision=_EXACT), enter, precision=_EXACT)
        return matrix / jnp.where(matrix[2, 2] == 0, 1.0, matrix[2, 2])


@value
class OpenCvHomography:
    """s = number of inliers of cv2.findHomography, from the candidate's points to the query's.

        mfvpr.score_candidates(mfvpr.OpenCvHomography(), candidate_matches)  # [C]

    The score runs on the host: all functions of the library accept it, but `jit`, `vmap` and gradients do not. Matches
    are sorted by `index0`, or by their coordinates without it, since OpenCV's samples depend on their order. A match of
    confidence 0 is ignored, all others count fully. OpenCV 4 counts inliers before its last least squares, 5 after it.

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
            expected = "expected matches that neither jit nor vmap nor grad traces"
            raise InputError(f"homography_opencv: {expected}; call score_candidates, or take Homography")
        check_bounds(self)  # OpenCV replaces a threshold of 0 by 3 px
        points = np.concatenate([matches.points1, matches.points0], axis=-1, dtype=np.float32, casting="unsafe")
        real = np.asarray(matches.mask, bool)
        confidence = np.ones(len(real)) if matches.confidence is None else np.asarray(matches.confidence)
        has_nan = np.isnan(confidence[real]).any()
        real = real & (confidence > 0)
        points = points[real]
        if has_nan or not np.isfinite(points).all():
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
