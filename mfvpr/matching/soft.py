"""Matching made smooth, for whoever learns through it."""

import jax
import jax.numpy as jnp

from mfvpr.matching.nearest_neighbors import at_least_one, keypoint_count, products, ready, slot_numbers
from mfvpr.types import Array, Features, Matches
from mfvpr.utils.numerics import as_float, masked, positive, safe_sqrt


def soft_match(features0: Features, features1: Features, *, temperature: float | Array) -> Matches:
    """`match` of one pair made smooth: a dual softmax over the similarities s_ij (Rocco et al., NeurIPS 2018).

    With R the softmax of s / T over the candidate's keypoints j and C that over the query's i, slot i goes to the
    means of points, scores and squared distances 2 - 2 s_ij under R, with confidence sum_j R_ij C_ij. As T -> 0 that is
    `match`: the neighbor, with confidence 1 where it is mutual and 0 elsewhere.

    Args:
        features0: query, keypoints `[N0, 2]`; padding may hold anything.
        features1: candidate, keypoints `[N1, 2]`.
        temperature: T, in units of the similarity, which lies in [-1, 1]; not above 0 gives NaN.

    Returns:
        Matches with K = N0 slots, real where the query has a keypoint with a finite descriptor and the candidate any.
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


def _softmax(logits: Array, real: Array, axis: int) -> Array:
    """Softmax over the real entries along `axis`; 0 elsewhere, also where none is real."""
    lowest = jnp.finfo(logits.dtype).min  # not -inf, whose softmax over nothing real is NaN, and so is its gradient
    return masked(jax.nn.softmax(jnp.where(real, logits, lowest), axis=axis), real)
