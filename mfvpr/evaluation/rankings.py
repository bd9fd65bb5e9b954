"""Matches and rankings of a sequence of queries, and scores of shortlists: of the retrieval, fused, and ranked."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, Num

from mfvpr.core.ranking import at_least_32_bits, combine, rank
from mfvpr.core.types import Array, Shortlist
from mfvpr.datasets.datasets import QuerySequence
from mfvpr.matchers.match_set import MatchSet, Scales
from mfvpr.utils.errors import InputError, require_word
from mfvpr.utils.numerics import at_least_single, compiled, is_concrete, masked, masked_mean, safe_sqrt

Ties = Literal["retrieval", "index"]
RetrievalScore = Literal["cosine", "negative_euclidean"]
Scores = Float[np.ndarray, "queries candidates"]


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
    retrieval_deviation, deviation = (
        _masked_std(at_least_32_bits(scores), both) for scores in (retrieval_scores, rerank_scores)
    )
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
    return np.asarray(_or_nan(fused, candidates.mask))


def retrieval_scores(candidates: Shortlist, kind: RetrievalScore = "cosine") -> Scores:
    """Retrieval scores: cosine similarity, or minus the Euclidean distance, for scores up to 1 only."""
    require_word("retrieval_score", kind, RetrievalScore)
    cosine = candidates.scores
    if kind == "cosine":
        return cosine
    if (largest := np.max(cosine, initial=0, where=candidates.mask)) > 1 + 1e-3:
        raise InputError(
            f"retrieval_score=negative_euclidean: expected cosine similarities up to 1, got {largest:.4g}; use cosine, "
            "which takes any score"
        )
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
    return _or_nan(_fuse_scales(scores, mask, weights, normalize=normalize), mask)


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
    mean, deviation = masked_mean(values, finite), _masked_std(values, finite)
    return jnp.where(finite, (values - mean) / jnp.where(deviation > 0, deviation, 1.0), scores)


def rank_shortlist(
    candidates: Shortlist, scores: Scores, *, ties: Ties = "retrieval"
) -> Int[np.ndarray, "queries candidates"]:
    """Positions into the shortlist, best first, missing candidates last; ties by retrieval or by database index."""
    require_word("ties", ties, Ties)
    tie_break = candidates.indices if ties == "index" else None
    return np.asarray(rank(scores, candidates.mask, tie_break=tie_break))


RETRIEVAL = "retrieval"  # name of the retrieval's own ranking
SEQUENCE = "sequence"  # in names of rankings by the motion along a drive
FRAMES = "frames"  # in names of rankings by frame correlation, which uses the queries before


@dataclass(frozen=True, repr=False)
class Matched:
    """Candidates of the Q queries of a sequence, and their matches."""

    sequence: QuerySequence
    candidates: Shortlist
    matches: tuple[MatchSet, ...]  # of each scale
    bad_queries: Mapping[int, str]  # row -> reason, of images that could not be used
    bad_database: Mapping[int, str]
    weights: tuple[float, ...] | None = None  # of the scales; None = 1 each

    def __repr__(self) -> str:
        return f"Matched({self.sequence!r}, {self.candidates.indices.shape[1]} candidates each)"

    @property
    def by_scale(self) -> MatchSet | Scales:
        """Input of scoring; several scales are fused, each standardized over a query's candidates."""
        return self.matches[0] if len(self.matches) == 1 else Scales(self.matches, self.weights)


@dataclass(frozen=True, repr=False)
class Ranked:
    """Ranking of the candidates of a sequence."""

    rows: Int[np.ndarray, "queries candidates"]  # of the database, best first; -1 = none
    scores: Scores  # in this order

    @classmethod
    def of(cls, candidates: Shortlist, scores: Scores, ties: Ties) -> "Ranked":
        """Rank candidates by scores in the order of the shortlist."""
        order, rows = rank_shortlist(candidates, scores, ties=ties), np.where(candidates.mask, candidates.indices, -1)
        return cls(*(np.take_along_axis(values, order, axis=1) for values in (rows, scores)))

    def __repr__(self) -> str:
        return "Ranked({} queries, {} candidates each)".format(*self.rows.shape)

    @property
    def shortlist(self) -> Shortlist:
        """The ranking as a shortlist, to be written (`mfvpr.io.write_shortlist`) or matched again."""
        mask = self.rows >= 0
        return Shortlist(indices=self.rows, scores=np.where(mask, self.scores, 0), mask=mask)


def _masked_std(values: Float[Array, "*shape"], mask: Bool[Array, "*shape"]) -> Float[jax.Array, ""]:
    """Standard deviation of all real entries, with a gradient of 0 where it is 0; 0 where there are none."""
    values, mask = values.reshape(-1), mask.reshape(-1)
    return safe_sqrt(masked_mean(masked(values - masked_mean(values, mask), mask) ** 2, mask))


def _or_nan(values: Num[Array, "*shape"], mask: Bool[Array, "..."]) -> Float[jax.Array, "*shape"]:
    """`values` where `mask`, NaN elsewhere."""
    if is_concrete((values, mask)):  # `jax_debug_nans` would stop at a NaN from a compiled program
        return jax.device_put(np.where(mask, values, np.nan))
    return jnp.where(mask, values, jnp.nan)
