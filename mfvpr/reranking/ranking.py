"""One query x C candidates: scores of all candidates, their fusion with the filter's, and the ranking.

Scorers know one pair; here is `vmap` over candidates. Whole grids of parameters are in `mfvpr.reranking.grids`.
"""

from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from mfvpr.scoring.parameters import fit
from mfvpr.scoring.scorer import Scorer, check_host, on_host, score_pairs
from mfvpr.types import Array, Matches, Ranking, Shortlist
from mfvpr.utils.errors import InputError, require_word
from mfvpr.utils.numerics import as_float, compiled, is_concrete, masked, masked_mean, masked_std, or_nan

Ties = Literal["filter", "index"]
FilterScore = Literal["cosine", "negative_euclidean"]

BIN_STEP = 8  # capacities of histograms are multiples of it


def score_candidates(scorer: Scorer, matches: Matches) -> Array:
    """Scores `[C]` of matches `[C, K, ...]`.

    Compiled once per shape; other numbers in the scorer compile nothing. A scorer that is a plain function, or holds
    one, runs op by op. What needs a capacity gets that of the images: under a caller's `jit`, where these are traced,
    it must have one before (`max_bins` of the histogram).
    """
    check_candidates(matches)
    check_host(scorer)
    if on_host(scorer):
        return jnp.asarray(score_pairs(scorer, matches))
    return _score_candidates(fit(scorer, *matched_sizes(matches), multiple=BIN_STEP), matches)


@compiled
def _score_candidates(scorer: Scorer, matches: Matches) -> Array:
    return jax.vmap(scorer)(matches)


def check_candidates(matches: Matches) -> None:
    """Raise a ValueError unless the matches are `[C, K, ...]`, of candidates."""
    if np.ndim(matches.mask) != 2:
        shape = np.shape(matches.mask)
        raise ValueError(f"expected matches [C, K, ...] of candidates, got a mask of shape {shape}; of one pair "
                         "[K] the score is scorer(matches)")  # fmt: skip


def matched_sizes(matches: Matches) -> tuple[Array, Array]:
    """Both image sizes `[..., 2]`, without those of pairs that have no matches, which may be anything."""
    sizes = matches.image_size0, matches.image_size1
    if not is_concrete((matches.mask, sizes)):
        return sizes
    some = np.any(matches.mask, axis=-1)
    size0, size1 = (np.broadcast_to(size, (*some.shape, 2))[some] for size in sizes)
    return size0, size1


def combine(filter_scores: Array, rerank_scores: Array, *, c: float | Array = 1e6) -> Array:
    """s = c s_f + s_r (paper, section IV-E). `c` is in units of the re-ranking score; 1e6 suits D2-Net's."""
    return c * filter_scores + rerank_scores


def balancing_c(filter_scores: Array, rerank_scores: Array, mask: Array) -> Array:
    """The `c` `[]` that gives both scores the same spread over one query's candidates `[C]`.

    Not from the paper, whose c is a constant by hand; it serves detectors whose scores have other units.
    """

    def spread(scores: Array) -> Array:
        return masked_std(scores, mask & jnp.isfinite(scores))

    filter_spread = spread(filter_scores)
    c = spread(rerank_scores) / jnp.where(filter_spread > 0, filter_spread, 1.0)
    return jnp.where((filter_spread > 0) & jnp.isfinite(c), c, 0.0)


@compiled
def fuse(filter_scores: Array, scores: Array, mask: Array, c: float | Array | None) -> Array:
    """Combined scores `[Q, C]` of several queries; `c` None balances the spread of both scores per query."""
    if c is None:
        c = jax.vmap(balancing_c)(filter_scores, scores, mask)[:, None]
    filter_scores, scores = masked(filter_scores, mask), masked(scores, mask)
    return combine(filter_scores, scores, c=c)


def fuse_shortlist(
    candidates: Shortlist, scores: np.ndarray, c: float | None, *, filter_score: FilterScore = "cosine"
) -> np.ndarray:
    """Combined scores `[Q, C]` of filter and re-ranking, NumPy; NaN without a candidate.

    Args:
        candidates: the filter's, with their cosine similarities.
        scores: `[Q, C]` of the re-ranking.
        c: weight of the filter; None balances the spread of both per query.
        filter_score: the filter's score, see `filter_scores`.
    """
    fused = fuse(filter_scores(candidates, filter_score), scores, candidates.mask, c)
    return np.asarray(or_nan(fused, candidates.mask))


def filter_scores(candidates: Shortlist, kind: FilterScore = "cosine") -> np.ndarray:
    """The filter's part of a combined score `[Q, C]`: cosine similarity, or minus the Euclidean distance."""
    require_word("filter_score", kind, FilterScore)
    cosine = candidates.scores
    if kind == "cosine":
        return cosine
    if (largest := np.max(cosine, initial=0, where=candidates.mask)) > 1 + 1e-3:
        raise InputError(f"filter_score=negative_euclidean: expected cosine similarities up to 1, got {largest:.4g}; "
                         "use cosine, which takes any score")  # fmt: skip
    return -np.sqrt(np.maximum(2 - 2 * cosine, 0))


def fuse_scales(
    scores: Array, mask: Array, weights: Array | None = None, *, normalize: Literal["zscore", "none"] = "zscore"
) -> Array:
    """Weighted sum `[..., C]` of the scores of S scales, as Patch-NetVLAD's, or scorers; NaN without a candidate.

    Args:
        scores: `[..., C, S]` of a query's candidates.
        mask: `[..., C]` bool, with the axes of the scores or fewer in front.
        weights: `[S]`; None = 1 each.
        normalize: "zscore" first gives each scale mean 0 and standard deviation 1 over the query's candidates; where
            all score the same, 0. A score that is not finite takes no part in that, and what it makes of the sum is its
            candidate's alone. "none" leaves the scores as they are, as for a pair by itself.
    """
    return or_nan(_fuse_scales(scores, mask, weights, normalize=normalize), mask)


@partial(compiled, static_argnames="normalize")
def _fuse_scales(scores: Array, mask: Array, weights: Array | None, *, normalize: str) -> Array:
    """`fuse_scales`, 0 without a candidate."""
    scores = as_float(scores)
    weights = jnp.ones(scores.shape[-1]) if weights is None else jnp.asarray(weights)
    mask = jnp.broadcast_to(mask, scores.shape[:-1])
    if normalize == "zscore":
        by_scale = jnp.moveaxis(scores, -1, -2)
        standardized = jnp.vectorize(_standardized, signature="(c),(c)->(c)")
        scores = jnp.moveaxis(standardized(by_scale, mask[..., None, :]), -2, -1)
    counts = jnp.expand_dims(weights != 0, tuple(range(scores.ndim - 1)))
    scores = jnp.where(mask[..., None] & counts, scores, 0.0)  # infinity times 0 would be no number
    return jnp.matmul(scores, weights.astype(scores.dtype), precision=jax.lax.Precision.HIGHEST)


def _standardized(scores: Array, mask: Array) -> Array:
    """Scores `[C]` with mean 0 and standard deviation 1 over the finite ones of the candidates."""
    finite = mask & jnp.isfinite(scores)
    # Relative to one of them, equal scores have no spread that rounding would make.
    some = jax.lax.stop_gradient(jnp.max(masked(scores, finite, -jnp.inf), initial=-jnp.inf))
    values = masked(scores - jnp.where(jnp.isfinite(some), some, 0.0), finite)
    largest = jax.lax.stop_gradient(jnp.max(jnp.abs(values), initial=0.0))  # whose square may be no number
    values = values / jnp.where((largest > 0) & jnp.isfinite(largest), largest, 1.0)
    mean, spread = masked_mean(values, finite), masked_std(values, finite)
    return jnp.where(finite, (values - mean) / jnp.where(spread > 0, spread, 1.0), scores)


def indexed(ties: Ties) -> bool:
    """Whether equal scores go by the row of the database.

    Raises:
        InputError: another word.
    """
    require_word("ties", ties, Ties)
    return ties == "index"


def rank_shortlist(candidates: Shortlist, scores: np.ndarray, *, ties: Ties = "filter") -> np.ndarray:
    """Positions `[Q, C]` into the shortlist, best first, those without a candidate last, NumPy.

    Equal scores keep the filter's order, or go by database index.
    """
    tie_break = candidates.indices if indexed(ties) else None
    return np.asarray(rank(scores, candidates.mask, tie_break=tie_break))


def rank(scores: Array, mask: Array | None = None, *, tie_break: Array | None = None) -> Array:
    """Positions `[..., C]` int32 in descending order of `scores` `[..., C]`.

    Stable: ties keep the given order, which is the filter's, or go by ascending `tie_break` `[..., C]`, such as the
    database index. NaN comes after every number, masked last.
    """
    return _rank(_in_32_bits(scores), mask, _in_32_bits(tie_break))


def _in_32_bits(keys: Array | None) -> Array | None:
    """Smaller whole numbers in the same order, where JAX would cut those of 64 bits."""
    if isinstance(keys, np.ndarray) and keys.dtype in (np.int64, np.uint64):
        return np.unique(keys, return_inverse=True)[1].reshape(keys.shape)
    return keys


@compiled
def _rank(scores: Array, mask: Array | None, tie_break: Array | None) -> Array:
    present = jnp.ones(scores.shape, bool) if mask is None else mask
    number = present & ~jnp.isnan(scores)
    group = jnp.where(present, jnp.where(number, 0, 1), 2)
    scores = jnp.asarray(scores)
    # Whole numbers stay what they are. Of those, unsigned ones and the smallest have no negative.
    descending = -scores if jnp.issubdtype(scores.dtype, jnp.floating) else ~scores
    descending = masked(descending, number, jnp.zeros((), scores.dtype))
    keys = (descending, group) if tie_break is None else (tie_break, descending, group)
    return jnp.lexsort(keys, axis=-1).astype(jnp.int32)


def rerank(scores: Array, mask: Array | None = None) -> Ranking:
    """The ranking that `scores` `[..., C]` of a shortlist's candidates give."""
    return Ranking(order=rank(scores, mask), scores=scores)
