"""Score of LoST-X (Garg et al., RSS 2018): how well matches, those of near descriptors most, agree along x."""

import jax.numpy as jnp

from mfvpr.scoring.fields import check_choices, choice, flag
from mfvpr.scoring.shifts import image_sizes
from mfvpr.scoring.weights import match_confidence
from mfvpr.types import Array, Matches, value
from mfvpr.utils.numerics import at_least_single, masked, masked_mean, safe_sqrt, where_finite

_SMALLEST = 1e-12  # what float32 resolves of a cosine distance, and less than any distance of descriptors but 0


@value
class LostScore:
    """s = log(1 + 1 / L): the smallest L, which LoST takes, has the largest score, and a pair without matches 0.

    L = (1 - cos(v x0, v x1)) / (n |v|) over the n matches, with x0 and x1 their positions along x in both images, px,
    and v = max d - d, where d are the cosine distances of the descriptors, distance^2 / 2, divided by their sum. A
    match counts with its confidence in all of these sums. L is 1 / (e^s - 1); LoST multiplies it by the distance of
    the images' global descriptors, which matches do not hold, and has its matches by channels and semantic labels.

    Where all distances are equal, as of a single match, v is 0 and L infinite, so that s = 0. Two matches are perfect
    wherever they are, since the further descriptors weigh nothing: with few matches the score says little. What 1 - cos
    or the described L is below 1e-12 counts as that; 1 - cos is 1 where all positions that weigh are 0.

    Attributes:
        form: `weighted` is the L above; `unweighted` is (1 - cos(x0, x1)) / n, LoST's own without descriptors of
            points, as its program calls it; `described` is sum |x1 - x0| distance^2 / 2, as the paper describes LoST:
            the more matches, the worse.
        mirrored: count the query's x from the right, W - 1 - x, for images that look the other way.
    """

    form: str = choice("weighted", "unweighted", "described")
    mirrored: bool = flag(False, "views from opposite directions")

    def __post_init__(self) -> None:
        check_choices(self)

    def __call__(self, matches: Matches) -> Array:
        """Score of one pair, `[]` float32."""
        confidence = match_confidence(matches)
        x0, x1 = (masked(at_least_single(points), matches.mask)[:, 0] for points in (matches.points0, matches.points1))
        if self.mirrored:
            x0 = masked(image_sizes(matches)[0][:1] - 1 - x0, matches.mask)
        distance = masked(at_least_single(matches.distance), matches.mask)
        form = {"weighted": _weighted, "unweighted": _unweighted, "described": _described}[self.form]
        agreement, difference = form(x0, x1, distance, confidence)
        score = jnp.log1p(agreement / jnp.maximum(difference, _SMALLEST))
        return where_finite(score, confidence, x0, x1, distance)


def _weighted(x0: Array, x1: Array, distance: Array, confidence: Array) -> tuple[Array, Array]:
    """n |v|, and the cosine distance of v x0 and v x1."""
    real = confidence > 0
    largest = jnp.max(distance, initial=0.0, where=real)
    unit = jnp.where(largest > _SMALLEST, largest, 1.0)  # of the distances, on which L does not depend
    mean = masked_mean((distance / unit) ** 2, real, confidence)
    # n |v| is |max d - d| / mean d. As a product of differences it is exactly 0 of the largest.
    closeness = masked((largest - distance) / unit * ((largest + distance) / unit), real)
    length = safe_sqrt(jnp.sum(confidence * closeness**2))
    return length / jnp.where(mean > 0, mean, 1.0), _cosine_distance(x0, x1, confidence * closeness**2)


def _unweighted(x0: Array, x1: Array, _: Array, confidence: Array) -> tuple[Array, Array]:
    """n, and the cosine distance of x0 and x1."""
    return jnp.sum(confidence), _cosine_distance(x0, x1, confidence)


def _described(x0: Array, x1: Array, distance: Array, confidence: Array) -> tuple[Array, Array]:
    """1 where there are matches, and the sum of |x1 - x0| d."""
    some = jnp.any(confidence > 0).astype(confidence.dtype)
    return some, jnp.sum(confidence * jnp.abs(x1 - x0) * distance**2 / 2)


def _cosine_distance(x0: Array, x1: Array, weights: Array) -> Array:
    """1 - cos of two vectors `[K]` in the metric of some weights `[K]`; 1 where one of them is 0."""
    length0, length1 = (safe_sqrt(jnp.sum(weights * x**2)) for x in (x0, x1))
    usable = (length0 > 0) & (length1 > 0)
    unit0, unit1 = (x / jnp.where(usable, length, 1.0) for x, length in ((x0, length0), (x1, length1)))
    return jnp.where(usable, jnp.sum(weights * (unit0 - unit1) ** 2) / 2, 1.0)  # small ones would be lost by 1 - cos
