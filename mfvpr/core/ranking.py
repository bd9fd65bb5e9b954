"""Combination of retrieval and re-ranking scores (paper, section IV-E), and the ranking by a score."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, Num, Shaped

from mfvpr.core.types import Array, Ranking
from mfvpr.utils.numerics import as_array, compiled, masked


def combine(
    filter_scores: Num[Array, "*batch candidates"],
    rerank_scores: Num[Array, "*batch candidates"],
    *,
    c: float | Array = 1e6,
) -> Num[Array, "*batch candidates"]:
    """Combined score s = c s_f + s_r of retrieval and re-ranking scores, equation 4 (paper, section IV-E).

        mfvpr.combine(filter_scores=shortlist.scores, rerank_scores=scores, c=1e6)  # [Q, C]

    c has units of the re-ranking score; the paper's 1e6 suits the scores of D2-Net's features.
    """
    filter_scores, rerank_scores = map(at_least_32_bits, (filter_scores, rerank_scores))
    return c * filter_scores + rerank_scores


def at_least_32_bits(scores: Array) -> Array:
    """Scores of at least 32 bits: products of whole numbers or of float16 overflow."""
    is_wide = jnp.issubdtype(scores.dtype, jnp.floating) and jnp.finfo(scores.dtype).bits >= 32
    return scores if is_wide else scores.astype(jnp.float32)


def rank(
    scores: Shaped[Array, "*batch candidates"],
    mask: Bool[Array, "*batch candidates"] | None = None,
    *,
    tie_break: Shaped[Array, "*batch candidates"] | None = None,
) -> Int[jax.Array, "*batch candidates"]:
    """Positions, int32, in descending order of `scores`.

        mfvpr.rank(np.array([0.2, 0.9, 0.5]))  # [1, 2, 0]

    Ties keep their order (the order of the retrieval), or are ordered by ascending `tie_break`, such as the database
    index. NaN comes after all numbers, and entries where `mask` is False come last.
    """
    return _rank(_as_order_keys(as_array(scores)), mask, _as_order_keys(as_array(tie_break)))


def _as_order_keys(keys: Array | None) -> Array | None:
    """Replace 64-bit numbers, which JAX truncates, by smaller integers in the same order; NaN stays."""
    if isinstance(keys, np.ndarray) and keys.dtype in (np.int64, np.uint64, np.float64):
        places = np.unique(keys, return_inverse=True)[1].reshape(keys.shape)
        return np.where(np.isnan(keys), np.nan, places).astype(np.float32) if np.isnan(keys).any() else places
    return keys


@compiled
def _rank(scores: Array, mask: Array | None, tie_break: Array | None) -> Array:
    present = jnp.ones(scores.shape, bool) if mask is None else mask.astype(bool)
    is_number = present & ~jnp.isnan(scores)
    group = jnp.where(present, jnp.where(is_number, 0, 1), 2)
    # ~ reverses the order of integers, also of unsigned ones and of the smallest, which have no negative.
    descending = -scores if jnp.issubdtype(scores.dtype, jnp.floating) else ~scores
    descending = masked(descending, is_number, jnp.zeros((), scores.dtype))
    keys = (descending, group) if tie_break is None else (tie_break, descending, group)
    return jnp.lexsort(keys, axis=-1).astype(jnp.int32)


def rerank(
    scores: Float[Array, "*queries candidates"], mask: Bool[Array, "*queries candidates"] | None = None
) -> Ranking:
    """Ranking of a shortlist by the re-ranking `scores` of its candidates; False in `mask` = no candidate.

    Example:
        ranking = mfvpr.rerank(scores, shortlist.mask)
    """
    return Ranking(order=rank(scores, mask), scores=scores)
