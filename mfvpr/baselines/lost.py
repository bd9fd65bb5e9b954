"""Score of LoST-X (Garg et al., RSS 2018): how well matches, those of near descriptors most, agree along x."""

import jax
import jax.numpy as jnp
from jaxtyping import Float

from mfvpr.core.types import Array, Matches, value
from mfvpr.core.weights import image_sizes, match_confidence
from mfvpr.utils.fields import FLAG, check_fields, one_of, setting
from mfvpr.utils.numerics import at_least_single, masked, masked_mean, safe_sqrt, where_finite

_Values = Float[Array, " slots"]
_Terms = tuple[Float[Array, ""], Float[Array, ""]]
_SMALLEST = 1e-12  # below what float32 resolves of a cosine distance, and below any distance of descriptors but 0


@value
class LostScore:
    """Score s = log(1 + 1 / L): LoST's best candidate has the smallest L; 0 without matches.

        mfvpr.LostScore(mirrored=True)(matches)

    L = (1 - cos(v x0, v x1)) / (n |v|) over the n matches. x0 and x1 are the positions along x in both images, px.
    v = max d - d, where d are the cosine distances of the descriptors, distance^2 / 2, divided by their sum. A match
    counts with its confidence in all sums. L can be restored as 1 / (e^s - 1). LoST also multiplies L by the distance
    of the images' global descriptors, which matches do not hold, and matches by channels and semantic labels.

    If all distances are equal, for instance of a single match, v is 0 and L infinite, so that s = 0. Two matches are
    always perfect: with few matches the score says little. 1 - cos and the `described` L are at least 1e-12; 1 - cos is
    1 if all positions with a weight are 0.

    Attributes:
        form: `weighted` is the L above; `unweighted` is (1 - cos(x0, x1)) / n, LoST's program without descriptors of
            points; `described` is sum |x1 - x0| distance^2 / 2, as the paper describes LoST: more matches score worse.
        mirrored: count the query's x from the right, W - 1 - x, for images with opposite viewing directions.
    """

    form: str = setting("weighted", one_of("weighted", "unweighted", "described"), static=True)
    mirrored: bool = setting(False, FLAG, "views from opposite directions", static=True)

    __post_init__ = check_fields

    def __call__(self, matches: Matches) -> Float[jax.Array, ""]:
        """Score of one pair `[K]`, float32."""
        confidence = match_confidence(matches)
        x0, x1 = (masked(at_least_single(points), matches.mask)[:, 0] for points in (matches.points0, matches.points1))
        if self.mirrored:
            x0 = masked(image_sizes(matches)[0][:1] - 1 - x0, matches.mask)
        distance = masked(at_least_single(matches.distance), matches.mask)
        terms = {"weighted": _weighted_terms, "unweighted": _unweighted_terms, "described": _described_terms}
        agreement, difference = terms[self.form](x0, x1, distance, confidence)
        score = jnp.log1p(agreement / jnp.maximum(difference, _SMALLEST))
        return where_finite(score, confidence, x0, x1, distance)


def _weighted_terms(x0: _Values, x1: _Values, distance: _Values, confidence: _Values) -> _Terms:
    """n |v|, and the cosine distance of v x0 and v x1."""
    real = confidence > 0
    largest = jnp.max(distance, initial=0.0, where=real)
    unit = jnp.where(largest > _SMALLEST, largest, 1.0)  # L does not depend on the unit of the distances
    mean = masked_mean((distance / unit) ** 2, real, confidence)
    # n |v| = |max d - d| / mean d. As a product of differences, max d - d is exactly 0 for the largest distance.
    closeness = masked((largest - distance) / unit * ((largest + distance) / unit), real)
    length = safe_sqrt(jnp.sum(confidence * closeness**2))
    return length / jnp.where(mean > 0, mean, 1.0), _cosine_distance(x0, x1, confidence * closeness**2)


def _unweighted_terms(x0: _Values, x1: _Values, _: _Values, confidence: _Values) -> _Terms:
    return jnp.sum(confidence), _cosine_distance(x0, x1, confidence)


def _described_terms(x0: _Values, x1: _Values, distance: _Values, confidence: _Values) -> _Terms:
    has_matches = jnp.any(confidence > 0).astype(confidence.dtype)
    return has_matches, jnp.sum(confidence * jnp.abs(x1 - x0) * distance**2 / 2)


def _cosine_distance(x0: _Values, x1: _Values, weights: _Values) -> Float[Array, ""]:
    """1 - cos of two vectors with weights; 1 if one of the vectors is 0."""
    length0, length1 = (safe_sqrt(jnp.sum(weights * x**2)) for x in (x0, x1))
    usable = (length0 > 0) & (length1 > 0)
    unit0, unit1 = (x / jnp.where(usable, length, 1.0) for x, length in ((x0, length0), (x1, length1)))
    return jnp.where(usable, jnp.sum(weights * (unit0 - unit1) ** 2) / 2, 1.0)  # 1 - cos would cancel
