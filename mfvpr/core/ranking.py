"""Scores of the candidates of one query, fusion with the retrieval scores, and the ranking."""

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Literal, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, Num, Shaped

from mfvpr.core.parameters import with_capacity
from mfvpr.core.scorer import Scorer, check_host, on_host, score_pairs
from mfvpr.core.types import Array, Matches, Ranking, Shortlist
from mfvpr.utils.errors import InputError, require_word
from mfvpr.utils.numerics import (
    as_array,
    at_least_single,
    compiled,
    is_concrete,
    masked,
    masked_mean,
    masked_std,
    or_nan,
)

Tree = TypeVar("Tree")
Ties = Literal["retrieval", "index"]
RetrievalScore = Literal["cosine", "negative_euclidean"]

Scores = Float[np.ndarray, "queries candidates"]

BIN_STEP = 8  # capacities of histograms are multiples of it


def score_candidates(scorer: Scorer, matches: Matches) -> Float[jax.Array, " candidates"]:
    """Scores of matches `[C, K, ...]`; other shapes raise a ValueError.

        mfvpr.score_candidates(mfvpr.HistogramOfShifts(), candidate_matches)  # [C]

    The program is compiled once per shape, and reused for other numbers in the scorer. A scorer that is or holds a
    plain function runs operation by operation. Capacities (`max_bins` of the histogram) are fitted to the image sizes;
    under a caller's `jit`, where sizes are traced, set them before.
    """
    check_candidates(matches)
    check_host(scorer)
    if on_host(scorer):
        return jnp.asarray(score_pairs(scorer, matches))
    return _score_candidates(fit_to_sizes(partial(with_capacity, scorer, multiple=BIN_STEP), matches), matches)


@compiled
def _score_candidates(scorer: Scorer, matches: Matches) -> jax.Array:
    return jax.vmap(scorer)(matches)


def check_candidates(matches: Matches) -> None:
    """Raise a ValueError unless the matches are `[C, K, ...]`."""
    if np.ndim(matches.mask) != 2:
        shape = np.shape(matches.mask)
        raise ValueError(f"expected matches [C, K, ...] of candidates, got a mask of shape {shape}; of one pair "
                         "[K] the score is scorer(matches)")  # fmt: skip


def fit_to_sizes(fit: Callable[[Array, Array], Tree], matches: Matches) -> Tree:
    """`fit(sizes0, sizes1)` for the sizes of both images, without pairs that have no matches and arbitrary sizes."""
    sizes = matches.image_size0, matches.image_size1
    if not is_concrete((matches.mask, sizes)) or any(size is None for size in sizes):
        return fit(*sizes)
    size0, size1 = (np.broadcast_to(size, (len(matches.mask), 2)) for size in sizes)
    if (size0 == size0[:1]).all() and (size1 == size1[:1]).all():  # an accelerator need not say which have matches
        with suppress(InputError):  # perhaps no pair has matches
            return fit(size0[:1], size1[:1])
    has_matches = np.any(matches.mask, axis=-1)
    return fit(size0[has_matches], size1[has_matches])


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
    filter_scores, rerank_scores = map(_wide, (filter_scores, rerank_scores))
    return c * filter_scores + rerank_scores


def _wide(scores: Array) -> Array:
    """Scores of at least 32 bits: products of whole numbers or of float16 overflow."""
    is_wide = jnp.issubdtype(scores.dtype, jnp.floating) and jnp.finfo(scores.dtype).bits >= 32
    return scores if is_wide else scores.astype(jnp.float32)


def balancing_c(
    retrieval_scores: Num[Array, " candidates"],
    rerank_scores: Num[Array, " candidates"],
    mask: Bool[Array, " candidates"],
) -> Float[jax.Array, ""]:
    """The c with which both scores of one query's candidates have the same standard deviation, in any unit.

        mfvpr.balancing_c(shortlist.scores[0], scores[0], shortlist.mask[0])

    Candidates count if `mask` is True, and both `retrieval_scores` and `rerank_scores` are finite.
    """
    both = mask & jnp.isfinite(retrieval_scores) & jnp.isfinite(rerank_scores)
    retrieval_deviation, deviation = (masked_std(_wide(scores), both) for scores in (retrieval_scores, rerank_scores))
    c = deviation / jnp.where(retrieval_deviation > 0, retrieval_deviation, 1.0)
    return jnp.where((retrieval_deviation > 0) & jnp.isfinite(c), c, 0.0)


@compiled
def fuse(
    retrieval_scores: Num[Array, "queries candidates"],
    scores: Num[Array, "queries candidates"],
    mask: Bool[Array, "queries candidates"],
    c: float | Array | None,
) -> Float[jax.Array, "queries candidates"]:
    """Combined scores of several queries; None as `c` is `balancing_c` of each query."""
    if c is None:
        c = jax.vmap(balancing_c)(retrieval_scores, scores, mask)[:, None]
    retrieval_scores, scores = masked(retrieval_scores, mask), masked(scores, mask)
    return combine(retrieval_scores, scores, c=c)


def fuse_shortlist(
    candidates: Shortlist, scores: Scores, c: float | None, *, retrieval_score: RetrievalScore = "cosine"
) -> Scores:
    """Combined scores of retrieval and re-ranking, see `fuse`; NaN without a candidate."""
    fused = fuse(retrieval_scores(candidates, retrieval_score), scores, candidates.mask, c)
    return np.asarray(or_nan(fused, candidates.mask))


def retrieval_scores(candidates: Shortlist, kind: RetrievalScore = "cosine") -> Scores:
    """Retrieval scores: cosine similarity, or minus the Euclidean distance, for scores up to 1 only."""
    require_word("retrieval_score", kind, RetrievalScore)
    cosine = candidates.scores
    if kind == "cosine":
        return cosine
    if (largest := np.max(cosine, initial=0, where=candidates.mask)) > 1 + 1e-3:
        raise InputError("retrieval_score=negative_euclidean: expected cosine similarities up to 1, got "
                         f"{largest:.4g}; use cosine, which takes any score")  # fmt: skip
    return -np.sqrt(np.maximum(2 - 2 * cosine, 0))


def fuse_scales(
    scores: Num[Array, "*batch candidates scales"],
    mask: Bool[Array, "... candidates"],
    weights: Num[Array, " scales"] | None = None,
    *,
    normalize: Literal["zscore", "none"] = "zscore",
) -> Float[jax.Array, "*batch candidates"]:
    """Weighted sum of the scores of S scales or scorers; NaN without a candidate. `weights` are 1 by default.

    Patch-NetVLAD fuses patch sizes in this way. "zscore" first gives each scale mean 0 and standard deviation 1 over
    the query's candidates, or 0 if all scores are equal. A score that is not finite is left out of mean and deviation,
    and affects only the sum of its own candidate. "none" leaves the scores as they are, for pairs without other
    candidates.
    """
    return or_nan(_fuse_scales(scores, mask, weights, normalize=normalize), mask)


@partial(compiled, static_argnames="normalize")
def _fuse_scales(scores: Array, mask: Array, weights: Array | None, *, normalize: str) -> Array:
    """`fuse_scales`, 0 without a candidate."""
    scores = at_least_single(scores)
    weights = jnp.ones(scores.shape[-1]) if weights is None else jnp.asarray(weights)
    mask = jnp.broadcast_to(mask, scores.shape[:-1])
    if normalize == "zscore":
        by_scale = jnp.moveaxis(scores, -1, -2)
        standardize = jnp.vectorize(_standardize, signature="(c),(c)->(c)")
        scores = jnp.moveaxis(standardize(by_scale, mask[..., None, :]), -2, -1)
    counts = jnp.expand_dims(weights != 0, tuple(range(scores.ndim - 1)))
    scores = jnp.where(mask[..., None] & counts, scores, 0.0)  # infinity times 0 would be NaN
    return jnp.matmul(scores, weights.astype(scores.dtype), precision=jax.lax.Precision.HIGHEST)


def _standardize(scores: Float[Array, " candidates"], mask: Bool[Array, " candidates"]) -> Array:
    """Scores with mean 0 and standard deviation 1 over the finite scores of candidates."""
    finite = mask & jnp.isfinite(scores)
    # Relative to the maximum, equal scores deviate by exactly 0, without rounding.
    maximum = jax.lax.stop_gradient(jnp.max(masked(scores, finite, -jnp.inf), initial=-jnp.inf))
    values = masked(scores - jnp.where(jnp.isfinite(maximum), maximum, 0.0), finite)
    largest = jax.lax.stop_gradient(jnp.max(jnp.abs(values), initial=0.0))  # its square may overflow
    values = values / jnp.where((largest > 0) & jnp.isfinite(largest), largest, 1.0)
    mean, deviation = masked_mean(values, finite), masked_std(values, finite)
    return jnp.where(finite, (values - mean) / jnp.where(deviation > 0, deviation, 1.0), scores)


def breaks_ties_by_row(ties: Ties) -> bool:
    """Whether ties are broken by the database row."""
    require_word("ties", ties, Ties)
    return ties == "index"


def rank_shortlist(
    candidates: Shortlist, scores: Scores, *, ties: Ties = "retrieval"
) -> Int[np.ndarray, "queries candidates"]:
    """Positions into the shortlist, best first, missing candidates last; ties by retrieval or by database index."""
    tie_break = candidates.indices if breaks_ties_by_row(ties) else None
    return np.asarray(rank(scores, candidates.mask, tie_break=tie_break))


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
    return _rank(_in_32_bits(as_array(scores)), mask, _in_32_bits(as_array(tie_break)))


def _in_32_bits(keys: Array | None) -> Array | None:
    """Replace 64-bit integers, which JAX truncates, by smaller integers in the same order."""
    if isinstance(keys, np.ndarray) and keys.dtype in (np.int64, np.uint64):
        return np.unique(keys, return_inverse=True)[1].reshape(keys.shape)
    return keys


@compiled
def _rank(scores: Array, mask: Array | None, tie_break: Array | None) -> Array:
    present = jnp.ones(scores.shape, bool) if mask is None else mask.astype(bool)
    number = present & ~jnp.isnan(scores)
    group = jnp.where(present, jnp.where(number, 0, 1), 2)
    scores = jnp.asarray(scores)
    # ~ reverses the order of integers, also of unsigned ones and of the smallest, which have no negative.
    descending = -scores if jnp.issubdtype(scores.dtype, jnp.floating) else ~scores
    descending = masked(descending, number, jnp.zeros((), scores.dtype))
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
