"""Smooth matching, through which gradients reach the features."""

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from mfvpr.core.matching import at_least_one, keypoint_count, slot_numbers
from mfvpr.core.nearest import products, ready
from mfvpr.core.types import Array, Features, Matches
from mfvpr.utils.numerics import as_float, masked, positive, safe_sqrt


def soft_match(features0: Features, features1: Features, *, temperature: float | Float[Array, ""]) -> Matches:
    """Smooth version of `match`: a dual softmax over the similarities s_ij.

        matches = mfvpr.soft_match(features0, features1, temperature=0.1)

    See Rocco et al., NeurIPS 2018. Let R be the softmax of s / T over the candidate's keypoints j, and C the softmax
    over the query's keypoints i. Slot i holds the means of points, scores and squared distances 2 - 2 s_ij under R,
    with confidence sum_j R_ij C_ij. For T -> 0 this is `match`: the nearest neighbor, with confidence 1 if it is
    mutual, else 0.

    Args:
        features0: query, keypoints `[N0, 2]`; padding may hold anything.
        features1: candidate, keypoints `[N1, 2]`.
        temperature: T, in units of the similarity, which lies in [-1, 1]; not above 0 gives NaN.

    Returns:
        Matches with K = N0 slots; a slot is real if its keypoint has a finite descriptor, and the candidate has any.
    """
    features0, features1 = ready(features0), ready(at_least_one(features1))
    real0, real1 = (f.mask & jnp.all(jnp.isfinite(f.descriptors), axis=-1) for f in (features0, features1))
    similarity = products(masked(features0.descriptors, real0), masked(features1.descriptors, real1))
    logits = similarity / positive(temperature, similarity.dtype)
    real = real0[:, None] & real1[None]
    rows, columns = (_softmax(logits, real, axis) for axis in (1, 0))
    return Matches(
        points0=features0.keypoints,
        points1=products(rows, masked(as_float(features1.keypoints), real1).T),
        distance=safe_sqrt(2 - 2 * jnp.sum(rows * similarity, axis=1)),
        scores0=features0.scores,
        scores1=jnp.sum(rows * masked(as_float(features1.scores), real1)[None], axis=1),
        mask=jnp.any(real, axis=1),
        image_size0=features0.image_size,
        image_size1=features1.image_size,
        confidence=jnp.minimum(jnp.sum(rows * columns, axis=1), 1.0),  # rounding may exceed 1
        index0=slot_numbers(features0),
        count0=keypoint_count(features0),
        count1=keypoint_count(features1),
    )


def _softmax(
    logits: Float[Array, "rows columns"], real: Bool[Array, "rows columns"], axis: int
) -> Float[Array, "rows columns"]:
    """Softmax over the real entries along `axis`; all other entries are 0, even if none is real."""
    lowest = jnp.finfo(logits.dtype).min  # with -inf, the softmax and its gradient would be NaN if no entry is real
    return masked(jax.nn.softmax(jnp.where(real, logits, lowest), axis=axis), real)
