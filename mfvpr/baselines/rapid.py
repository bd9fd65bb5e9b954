"""Rapid spatial score of Patch-NetVLAD (CVPR 2021): matches count less, the further they are from the mean shift."""

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from mfvpr.core.types import Array, Matches, value
from mfvpr.core.weights import image_sizes, match_confidence, match_shifts
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import FLAG, POSITIVE, check_fields, list_of, one_of, setting
from mfvpr.utils.numerics import at_least_single, masked, masked_mean, where_finite


@value
class RapidSpatialScore:
    """s = sum_k ((X - |x_k - mean x|)^2 + (Y - |y_k - mean y|)^2) over the shifts, in px^2.

        mfvpr.RapidSpatialScore()(matches)

    A match counts with its confidence, in the means and in the sum. A shift further than X from the mean counts more
    again. If X and Y are the image size, the score is `AggregatedScore` with weight 1.

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
        closeness = self._reach(matches, shifts, confidence > 0)[None] - residuals
        score = jnp.sum(confidence * jnp.sum(masked(closeness, matches.mask) ** 2, axis=-1))
        if self.per_feature:
            score = score / query_features(matches)
        return where_finite(score, confidence, shifts)

    def _reach(
        self, matches: Matches, shifts: Float[Array, "slots 2"], real: Bool[Array, " slots"]
    ) -> Float[Array, "2"]:
        """X and Y; 0 if they are a maximum over no matches."""
        if self.size is not None:
            return jnp.asarray(self.size, shifts.dtype)
        if self.reach == "image_size":
            return image_sizes(matches)[0]

        def largest(values: Array) -> Array:
            return jnp.max(masked(values, real, -jnp.inf), axis=0, initial=-jnp.inf)

        if self.reach == "largest_shift":
            reach = jnp.abs(largest(shifts))
        else:
            points = (masked(at_least_single(points), matches.mask) for points in (matches.points0, matches.points1))
            reach = jnp.maximum(*map(largest, points))
        return jnp.where(jnp.any(real), reach, 0.0)


def query_features(matches: Matches) -> Float[jax.Array, ""]:
    """Number of the query's keypoints, at least 1, float32: divisor of scores per feature."""
    if matches.count0 is None:
        raise InputError(
            "per_feature=True: expected matches that know how many keypoints the query has (count0), got None"
        )
    return jnp.maximum(jnp.asarray(matches.count0, jnp.float32), 1.0)
