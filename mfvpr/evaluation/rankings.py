"""Rankings of candidates by the scores of a system: of retrieval, of each scorer, and combined ones."""

from collections import deque
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, Num

from mfvpr.core.ranking import at_least_32_bits, combine, rank
from mfvpr.core.types import Array, Shortlist
from mfvpr.datasets.datasets import QuerySequence
from mfvpr.datasets.positives import Positives
from mfvpr.matchers.match_set import MatchSet, Scales
from mfvpr.utils.errors import InputError, require_word
from mfvpr.utils.fields import NOT_NEGATIVE, POSITIVE
from mfvpr.utils.numerics import at_least_single, compiled, masked, masked_mean, safe_sqrt

if TYPE_CHECKING:
    from mfvpr.evaluation.drives import DriveFilter  # which ranks the rankings of this module again

Ties = Literal["retrieval", "index"]
RetrievalScore = Literal["cosine", "negative_euclidean"]
Scores = Float[np.ndarray, "queries candidates"]
AnyScores = Num[Array, "queries candidates"]
OfQuery = Num[Array, " candidates"]

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

    def without(self, is_left_out: Bool[np.ndarray, "queries candidates"]) -> "Ranked":
        """The ranking without some of its candidates: -1 and NaN at its end."""
        order = np.argsort(is_left_out, axis=1, kind="stable")
        values = np.where(is_left_out, -1, self.rows), np.where(is_left_out, np.nan, self.scores)
        return Ranked(*(np.take_along_axis(each, order, axis=1) for each in values))

    @property
    def shortlist(self) -> Shortlist:
        """The ranking as a shortlist, to be written (`mfvpr.io.write_shortlist`) or matched again."""
        mask = self.rows >= 0
        return Shortlist(indices=self.rows, scores=np.where(mask, self.scores, 0), mask=mask)


@dataclass(frozen=True)
class Fusion:
    """Sum of a main score, the retrieval score, and the scores of further scorers.

    Attributes:
        c: the combined score is main score + c * retrieval score; None = `balancing_c` of each query. "zscore" = the
            sum of all scores, each standardized as in `fuse_scales`: it ranks two finite scores as None does, in a unit
            that is the same for every query.
        retrieval_score: kind of retrieval score, see `mfvpr.evaluation.rankings.retrieval_scores`.
        weights: for "zscore" only, above 0, by name: of `retrieval` and of the main scorer, by default 1;
            and of further scorers, which take part only if they are named here.
    """

    c: float | Literal["zscore"] | None = None
    retrieval_score: RetrievalScore = "cosine"
    weights: Mapping[str, float] = field(default_factory=dict)

    def members(self, main: str) -> list[str]:
        """Names of the scorers that take part, the main one first."""
        return [main, *(name for name in self.weights if name not in (main, RETRIEVAL))]

    def system(self, main: str) -> str:
        """Name of the fused system, such as `histogram + retrieval`."""
        return " + ".join([*self.members(main), RETRIEVAL])

    def check(self, main: str, scorers: Collection[str]) -> None:
        """Raise an InputError if a setting is out of bounds, or a name is not among those of all `scorers`."""
        require_word("retrieval_score", self.retrieval_score, RetrievalScore)
        known = ", ".join(scorers) or "there are none"
        if main not in scorers:
            raise InputError(f"fused: expected names of scorers ({known}), got {main}")
        (NOT_NEGATIVE | "zscore" | None).check("c", self.c)
        if self.weights and self.c != "zscore":
            raise InputError(f"weights: expected c='zscore' as well, got c={self.c!r}")
        for name, weight in self.weights.items():
            if name not in {RETRIEVAL, *scorers}:
                raise InputError(f"weights: expected {RETRIEVAL} or scorers ({known}), got {name}; score by it as well")
            POSITIVE.check(f"weights.{name}", weight)

    def __call__(self, main: str, candidates: Shortlist, scores: Mapping[str, Scores]) -> Scores:
        """Combined scores, from scores by name of the scorer."""
        by_retrieval = retrieval_scores(candidates, self.retrieval_score)
        if self.c != "zscore":
            return np.asarray(fuse(by_retrieval, scores[main], candidates.mask, self.c))
        parts = {RETRIEVAL: by_retrieval} | {name: scores[name] for name in self.members(main)}
        weights = np.array([self.weights.get(name, 1.0) for name in parts], np.float32)
        return np.asarray(fuse_scales(np.stack([*parts.values()], axis=-1), candidates.mask, weights))


@dataclass(frozen=True)
class FrameCorrelation:
    """Increase the scores of candidates near the places of the previous queries (Camara & Preucil, RAS 2020).

    The place of a query is its best candidate. A candidate d database rows from the place of a previous query gains
    strength * gain * (1 - d / reach) of its score; the largest gain over the previous queries counts. The strength is
    the score of that place over the best score of the previous places, and 1 if `previous` is 1 or all scores are 0.
    Queries and database images must be in the order of the drive.
    """

    previous: int = 2  # queries, from 1; the first ones keep their scores
    reach: float = 15.0  # database rows
    gain: float = 0.4  # largest relative increase of a score

    def __post_init__(self) -> None:
        if self.previous < 1 or not 0 < self.reach < np.inf or not 0 <= self.gain < np.inf:
            raise InputError(f"{self}: expected at least one query, a finite reach above 0, a finite gain from 0")

    def __call__(self, candidates: Shortlist, scores: Scores) -> Scores:
        """Correlated scores of a sequence, float32; scores that are not above 0, and NaN, stay the same."""
        mask, correlated = np.asarray(candidates.mask), np.array(scores, np.float64)
        before: deque[tuple[float, float]] = deque(maxlen=self.previous)  # (row, score) of the last places
        for row_scores, rows, usable in zip(correlated, np.asarray(candidates.indices, float), mask, strict=True):
            positive = usable & (row_scores > 0)
            if len(before) == self.previous:
                places, of_places = np.array(before).T
                most = of_places.max()
                strength = of_places / most if most > 0 and self.previous > 1 else np.ones(len(before))
                nearness = np.maximum(1 - np.abs(rows[positive, None] - places) / self.reach, 0)
                row_scores[positive] *= 1 + self.gain * np.max(strength * nearness, axis=1, initial=0)
            best = row_scores.max(where=positive, initial=0)  # of equal ones, the lowest row is the place
            before.append((rows.min(where=positive & (row_scores == best), initial=np.inf), best))
        return correlated.astype(np.float32)


@dataclass(frozen=True)
class FinalScore:
    """A score that candidates are ranked by: of the retrieval, of a scorer, or made of another final score."""

    name: str
    scorers: tuple[str, ...] = ()  # names of those that take part, the main one first; none = retrieval alone
    base: str = ""  # name of the final score that this one is made of, by `step`; "" = of retrieval or a scorer
    step: "Fusion | FrameCorrelation | DriveFilter | None" = None


def rank_by_scores(
    candidates: Shortlist,
    scores: Mapping[str, Scores],
    final_scores: Iterable[FinalScore],
    ties: Ties,
    *,
    num_rows: int = 0,
    excluded: Positives | None = None,
) -> dict[str, Ranked]:
    """Rankings of queries by name of the final score, in the order of `final_scores`; a drive if it is a sequence.

    `scores` `[Q, C]` are by name of the scorer. Sequences need `num_rows`, the number of images in the database, and
    the images of it that are `excluded` for each query.
    """
    known = {RETRIEVAL: candidates.scores, **scores}
    rankings: dict[str, Ranked] = {}
    for score in final_scores:
        if isinstance(score.step, Fusion):
            known[score.name] = score.step(score.base, candidates, known)
        elif isinstance(score.step, FrameCorrelation):
            known[score.name] = score.step(candidates, known[score.base])
        elif score.step is not None:  # of a drive
            hidden = None if excluded is None else excluded.dense()
            rankings[score.name] = score.step(rankings[score.base], num_rows, hidden)
            continue
        rankings[score.name] = Ranked.of(candidates, known[score.name], ties)
    return rankings


def balancing_c(
    retrieval_scores: OfQuery, rerank_scores: OfQuery, mask: Bool[Array, " candidates"]
) -> Float[jax.Array, ""]:
    """The c with which both scores of one query's candidates have the same standard deviation, in any unit.

        mfvpr.balancing_c(shortlist.scores[0], scores[0], shortlist.mask[0])

    Candidates count if `mask` is True, and both `retrieval_scores` and `rerank_scores` are finite.
    """
    both, pair = mask & jnp.isfinite(retrieval_scores) & jnp.isfinite(rerank_scores), (retrieval_scores, rerank_scores)
    retrieval_deviation, deviation = (_masked_std(at_least_32_bits(scores), both) for scores in pair)
    c = deviation / jnp.where(retrieval_deviation > 0, retrieval_deviation, 1.0)
    return jnp.where((retrieval_deviation > 0) & jnp.isfinite(c), c, 0.0)


@compiled
def fuse(
    retrieval_scores: AnyScores, scores: AnyScores, mask: Bool[Array, "queries candidates"], c: float | Array | None
) -> Float[jax.Array, "queries candidates"]:
    """Combined scores of several queries, NaN without a candidate; None as `c` is `balancing_c` of each query."""
    if c is None:
        c = jax.vmap(balancing_c)(retrieval_scores, scores, mask)[:, None]
    combined = combine(masked(retrieval_scores, mask), masked(scores, mask), c=c)
    return jnp.where(mask, combined, jnp.nan)


def retrieval_scores(candidates: Shortlist, kind: RetrievalScore = "cosine") -> Scores:
    """Retrieval scores: cosine similarity, or minus the Euclidean distance, for scores up to 1 only."""
    require_word("retrieval_score", kind, RetrievalScore)
    cosine = candidates.scores
    if kind == "cosine":
        return cosine
    if (largest := np.max(cosine, initial=0, where=candidates.mask)) > 1 + 1e-3:
        expected = f"cosine similarities up to 1, got {largest:.4g}; use cosine, which takes any score"
        raise InputError(f"retrieval_score=negative_euclidean: expected {expected}")
    return -np.sqrt(np.maximum(2 - 2 * cosine, 0))


@compiled
def fuse_scales(
    scores: Num[Array, "*batch candidates scales"],
    mask: Bool[Array, "... candidates"],
    weights: Num[Array, " scales"] | None = None,
) -> Float[jax.Array, "*batch candidates"]:
    """Weighted sum of the scores of S scales or scorers; NaN without a candidate. `weights` are 1 by default.

    Patch-NetVLAD fuses patch sizes in this way. Each scale first gets mean 0 and standard deviation 1 over the query's
    candidates, or 0 if all scores are equal. A score that is not finite is left out of mean and deviation, and affects
    only the sum of its own candidate.
    """
    weights = jnp.ones(scores.shape[-1]) if weights is None else jnp.asarray(weights)

    def fuse_query(scores: Float[Array, "candidates scales"], mask: Bool[Array, " candidates"]) -> Array:
        standard = jax.vmap(_standardize, in_axes=(1, None), out_axes=1)(scores, mask)
        standard = jnp.where(mask[:, None] & (weights != 0)[None], standard, 0.0)  # infinity times 0 would be NaN
        fused = jnp.matmul(standard, weights.astype(scores.dtype), precision=jax.lax.Precision.HIGHEST)
        return jnp.where(mask, fused, jnp.nan)

    mask = jnp.broadcast_to(mask, scores.shape[:-1])
    return jnp.vectorize(fuse_query, signature="(c,s),(c)->(c)")(at_least_single(scores), mask)


def _standardize(scores: Float[Array, " candidates"], mask: Bool[Array, " candidates"]) -> Array:
    """Scores with mean 0 and standard deviation 1 over the finite scores of candidates."""
    finite = mask & jnp.isfinite(scores)
    # Relative to the maximum, equal scores deviate by exactly 0, without rounding.
    maximum = jnp.max(masked(scores, finite, -jnp.inf), initial=-jnp.inf)
    values = masked(scores - jnp.where(jnp.isfinite(maximum), maximum, 0.0), finite)
    largest = jnp.max(jnp.abs(values), initial=0.0)  # its square may overflow
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


def _masked_std(values: Float[Array, " candidates"], mask: Bool[Array, " candidates"]) -> Float[jax.Array, ""]:
    """Standard deviation of all real entries, with a gradient of 0 where it is 0; 0 where there are none."""
    return safe_sqrt(masked_mean(masked(values - masked_mean(values, mask), mask) ** 2, mask))
