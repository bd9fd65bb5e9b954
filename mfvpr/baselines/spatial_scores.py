"""Scores of other systems on the shifts and positions of matches: rapid spatial score, visual phrases, LoST."""

import jax
import jax.numpy as jnp
from jaxtyping import Float

from mfvpr.core.types import Array, Matches, value
from mfvpr.core.weights import image_sizes, match_confidence, match_shifts
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import FLAG, POSITIVE, check_fields, list_of, one_of, setting, whole
from mfvpr.utils.numerics import at_least_single, masked, masked_mean, positive, safe_sqrt, where_finite

MAX_LENGTH = 8  # the number of phrases of 100,000 matches still fits into float32
_SMALLEST = 1e-12  # below what float32 resolves of a cosine distance, and below any distance of descriptors but 0


@value
class RapidSpatialScore:
    """Rapid spatial score of Patch-NetVLAD (Hausler et al., CVPR 2021), in px^2.

        mfvpr.RapidSpatialScore()(matches)

    s = sum_k ((X - |x_k - mean x|)^2 + (Y - |y_k - mean y|)^2) over the shifts. A match counts with its confidence, in
    the means and in the sum. A shift further than X from the mean counts more again. If X and Y are the image size, the
    score is `AggregatedScore` with weight 1.

    Attributes:
        reach: choice of X and Y. `image_size`: width and height of the query; Patch-NetVLAD's code takes the largest
            index of its grid of patches. `largest_coordinate`: largest x and y of the matched points of both images;
            re-ranking-for-VPR takes those of all keypoints, which matches do not hold. `largest_shift`: |max x_k| and
            |max y_k|, Patch-NetVLAD's equation as printed, which rewards the largest outlier.
        size: (X, Y) px, instead of `reach`; for patches on a grid the largest index times the step.
        per_feature: divide by the number of the query's keypoints, matched or not, as both codes do. The ranking of
            a query's candidates stays the same; scores of scales with different numbers of patches become comparable.
    """

    reach: str = setting("image_size", one_of("image_size", "largest_coordinate", "largest_shift"), static=True)
    size: tuple[float, float] | None = setting(
        None, list_of(POSITIVE, 2) | None, "None = what reach says", unit="[x, y] px", swept=False
    )
    per_feature: bool = setting(False, FLAG, static=True)

    __post_init__ = check_fields

    def __call__(self, matches: Matches) -> Float[jax.Array, ""]:
        """Score of one pair `[K]`, float32; an InputError if `per_feature` is set and the matches have no `count0`."""
        confidence, shifts = match_confidence(matches), match_shifts(matches)
        residuals = jnp.abs(shifts - masked_mean(shifts, matches.mask, confidence)[None])
        if self.size is not None:
            reach = jnp.asarray(self.size, shifts.dtype)
        elif self.reach == "image_size":
            reach = image_sizes(matches)[0]
        else:
            real = confidence > 0
            largest = lambda values: jnp.max(masked(values, real, -jnp.inf), axis=0, initial=-jnp.inf)  # noqa: E731
            sides = (masked(at_least_single(points), matches.mask) for points in (matches.points0, matches.points1))
            of_shift = self.reach == "largest_shift"
            reach = jnp.abs(largest(shifts)) if of_shift else jnp.maximum(*map(largest, sides))
            reach = jnp.where(jnp.any(real), reach, 0.0)
        closeness = reach[None] - residuals
        score = jnp.sum(confidence * jnp.sum(masked(closeness, matches.mask) ** 2, axis=-1))
        if self.per_feature:
            score = score / query_features(matches)
        return where_finite(score, confidence, shifts)


def query_features(matches: Matches) -> Float[jax.Array, ""]:
    """Number of the query's keypoints, at least 1, float32: divisor of scores per feature."""
    if matches.count0 is None:
        raise InputError("per_feature=True: expected matches with count0 (query's keypoints), got None; leave it out")
    return jnp.maximum(jnp.asarray(matches.count0, jnp.float32), 1.0)


@value
class VisualPhrases:
    """Number of geometry-preserving visual phrases (Zhang et al., CVPR 2011): groups of matches with equal shifts.

        mfvpr.VisualPhrases(length=2, cell_size=15.0)(matches)

    s = sum over cells of C(m, length), where m matches have a shift in the cell. The plane of shifts, points1 -
    points0, is divided into square cells. Length 1 counts matches, length 2 pairs of matches that agree. A phrase
    counts the product of its matches' confidences, so that matches of confidence 0 do not count. The score is smooth in
    the confidences, and constant in the points within a cell (gradient 0).

    Attributes:
        length: matches per phrase, from 1 to 8 (else a ValueError).
        cell_size: width of the cells, px; an array not above 0 scores NaN.
        align: `zero_center` centers a cell on shift 0; `zero_edge` puts an edge there. Edges belong to the upper cell.
    """

    length: int = setting(2, whole(1, MAX_LENGTH), unit="matches of a phrase", static=True)
    cell_size: float | Array = setting(15.0, POSITIVE, unit="px")
    align: str = setting("zero_center", one_of("zero_center", "zero_edge"), static=True)

    __post_init__ = check_fields

    def __call__(self, matches: Matches) -> Float[jax.Array, ""]:
        """Score of one pair `[K]`, float32."""
        confidence, shifts = match_confidence(matches), match_shifts(matches)
        size = positive(self.cell_size, shifts.dtype)
        start = shifts + size / 2 if self.align == "zero_center" else shifts
        cells = jnp.floor(start / size)
        # Another program may round a quotient near an integer to the other side.
        above, below = start >= (cells + 1) * size, start < cells * size
        cells = masked(cells + above.astype(cells.dtype) - below.astype(cells.dtype), matches.mask)

        rows, columns, votes = jax.lax.sort((cells[:, 1], cells[:, 0], confidence), num_keys=2)
        differs = (rows != jnp.roll(rows, 1)) | (columns != jnp.roll(columns, 1))
        is_first = differs.at[:1].set(True)  # of its cell
        empty = jnp.zeros(self.length, votes.dtype).at[0].set(1.0)

        def step(shorter: Array, match: tuple[Array, Array]) -> tuple[Array, Array]:
            vote, begins = match
            shorter = jnp.where(begins, empty, shorter)  # phrases of 0, ..., length - 1 earlier matches of the cell
            longer = vote * shorter  # phrases of 1, ..., length matches that end with this one
            return shorter.at[1:].add(longer[:-1]), longer[-1]

        # Only sums of products, so that cells with too few matches count exactly 0.
        _, phrases = jax.lax.scan(step, empty, (votes, is_first))
        return where_finite(jnp.sum(phrases), confidence, cells)


@value
class LostScore:
    """LoST-X's score (Garg et al., RSS 2018), how well matches agree along x: s = log(1 + 1 / L), 0 without matches.

        mfvpr.LostScore(mirrored=True)(matches)

    L = (1 - cos(v x0, v x1)) / (n |v|) over the n matches. x0 and x1 are the positions along x in both images, px.
    v = max d - d, where d are the cosine distances of the descriptors, distance^2 / 2, divided by their sum. A match
    counts with its confidence in all sums. LoST's best candidate has the smallest L, which can be restored as
    1 / (e^s - 1). LoST also multiplies L by the distance of the images' global descriptors, which matches do not hold,
    and matches by channels and semantic labels.

    If all distances are equal, v is 0 and L infinite, so that s = 0. Two matches are always perfect. 1 - cos is at
    least 1e-12, and 1 if all positions with a weight are 0.

    Attributes:
        form: `weighted` is the L above; `unweighted` is (1 - cos(x0, x1)) / n, LoST's program without descriptors of
            points.
        mirrored: count the query's x from the right, W - 1 - x, for images with opposite viewing directions.
    """

    form: str = setting("weighted", one_of("weighted", "unweighted"), static=True)
    mirrored: bool = setting(False, FLAG, "views from opposite directions", static=True)

    __post_init__ = check_fields

    def __call__(self, matches: Matches) -> Float[jax.Array, ""]:
        """Score of one pair `[K]`, float32."""
        confidence = match_confidence(matches)
        x0, x1 = (masked(at_least_single(points), matches.mask)[:, 0] for points in (matches.points0, matches.points1))
        if self.mirrored:
            x0 = masked(image_sizes(matches)[0][:1] - 1 - x0, matches.mask)
        distance = masked(at_least_single(matches.distance), matches.mask)
        if self.form == "unweighted":
            agreement, difference = jnp.sum(confidence), _cosine_distance(x0, x1, confidence)
        else:
            real = confidence > 0
            largest = jnp.max(distance, initial=0.0, where=real)
            unit = jnp.where(largest > _SMALLEST, largest, 1.0)  # L does not depend on the unit of the distances
            mean = masked_mean((distance / unit) ** 2, real, confidence)
            # n |v| = |max d - d| / mean d. As a product, max d - d is exactly 0 for the largest distance.
            closeness = masked((largest - distance) / unit * ((largest + distance) / unit), real)
            length = safe_sqrt(jnp.sum(confidence * closeness**2))
            agreement = length / jnp.where(mean > 0, mean, 1.0)
            difference = _cosine_distance(x0, x1, confidence * closeness**2)
        score = jnp.log1p(agreement / jnp.maximum(difference, _SMALLEST))
        return where_finite(score, confidence, x0, x1, distance)


def _cosine_distance(x0: Float[Array, " slots"], x1: Array, weights: Array) -> Float[Array, ""]:
    """1 - cos of two vectors with weights; 1 if one of the vectors is 0."""
    length0, length1 = (safe_sqrt(jnp.sum(weights * x**2)) for x in (x0, x1))
    usable = (length0 > 0) & (length1 > 0)
    unit0, unit1 = (x / jnp.where(usable, length, 1.0) for x, length in ((x0, length0), (x1, length1)))
    return jnp.where(usable, jnp.sum(weights * (unit0 - unit1) ** 2) / 2, 1.0)  # 1 - cos would cancel
