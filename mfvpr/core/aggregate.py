"""Aggregated score (paper, section III-C): every match counts, less so the further its shift is from the mean.

Beside it the number of matches, the shortest score, by which SelaVPR re-ranks (Lu et al., ICLR 2024).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Float

from mfvpr.core.types import Array, Matches, value
from mfvpr.core.weights import Weight, image_sizes, match_confidence, match_shifts, match_weights, weight_field
from mfvpr.utils.fields import FLAG, POSITIVE, check_fields, one_of, setting
from mfvpr.utils.numerics import masked, masked_mean, masked_median, positive, safe_sqrt, where_finite


@value
class AggregatedScore:
    """Weighted sum over matches of the closeness of their shift to the mean shift, equation 3.

        mfvpr.AggregatedScore(mean="median", clamp=True)(matches)

    The score, in units of the weight times px^2, is

        s = sum_k w_k ((W - |x_k - mean x|)^2 + (H - |y_k - mean y|)^2),

    where (x_k, y_k) is the shift of match k, w_k its weight, and (W, H) the image size, the paper's (x_im, y_im).

    Attributes:
        weight: match weight, DMF by default as in the paper.
        mean: center of the shifts: `unweighted` mean (as printed), `weighted` mean or `median`. A mean counts every
            match with its confidence.
        clamp: a shift that is further from the center than the image is wide counts 0 instead of growing again.
        temperature: px; T > 0 replaces |x| by the hyperbola sqrt(x^2 + T^2) - T, and the clamp of z by
            T log(1 + e^(z / T)), so that the score is smooth in the points (except for `median`). None is the paper's;
            an array not above 0 scores NaN.
    """

    weight: Weight = weight_field("dmf")
    mean: str = setting("unweighted", one_of("unweighted", "weighted", "median"), static=True)
    clamp: bool = setting(False, FLAG, static=True)
    temperature: float | Array | None = setting(
        None, POSITIVE | None, "above 0 is smooth; None = the paper's", unit="px", learned=True
    )

    __post_init__ = check_fields

    def __call__(self, matches: Matches) -> Float[jax.Array, ""]:
        """Score of one pair `[K]`, float32."""
        weights = match_weights(self.weight, matches)
        shifts = match_shifts(matches)
        confidence = match_confidence(matches)
        if self.mean == "median":
            center = masked_median(shifts, confidence > 0)
        else:
            center = masked_mean(shifts, matches.mask, weights if self.mean == "weighted" else confidence)
        offsets, size = shifts - center[None], image_sizes(matches)[0][None]
        if self.temperature is None:
            closeness = size - jnp.abs(offsets)
            closeness = jnp.maximum(closeness, 0.0) if self.clamp else closeness
        else:
            temperature = positive(self.temperature, offsets.dtype)
            closeness = size - (safe_sqrt(offsets**2 + temperature**2) - temperature)
            closeness = temperature * jax.nn.softplus(closeness / temperature) if self.clamp else closeness
        score = jnp.sum(weights * jnp.sum(masked(closeness, matches.mask) ** 2, axis=-1))
        return where_finite(score, weights, shifts)


@value
class MatchCount:
    """Number of matches, each counted with its confidence.

        mfvpr.MatchCount()(mfvpr.soft_match(features0, features1, temperature=0.1))  # a smooth score

    Attributes:
        single: score of a pair with exactly one match: `count` it, or `zero`, as SelaVPR's code does by accident.
    """

    single: str = setting("count", one_of("count", "zero"), "a pair with one match", static=True)

    __post_init__ = check_fields

    def __call__(self, matches: Matches) -> Float[jax.Array, ""]:
        """Score of one pair `[K]`, float32."""
        confidence = match_confidence(matches)
        score = jnp.sum(confidence)
        return score if self.single == "count" else jnp.where(jnp.sum(confidence != 0) == 1, 0.0 * score, score)
