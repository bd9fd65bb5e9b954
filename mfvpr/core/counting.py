"""The number of matches as a score, the re-ranking of SelaVPR (Lu et al., ICLR 2024)."""

import jax
import jax.numpy as jnp
from jaxtyping import Float

from mfvpr.core.parameters import check_plain, choice
from mfvpr.core.types import Matches, value
from mfvpr.core.weights import match_confidence


@value
class MatchCount:
    """Number of matches, each counted with its confidence.

        mfvpr.MatchCount()(mfvpr.soft_match(features0, features1, temperature=0.1))  # a smooth score

    Attributes:
        single: score of a pair with exactly one match: `count` it, or `zero`, as SelaVPR's code does by accident.
    """

    single: str = choice("count", "zero", note="a pair with one match")

    __post_init__ = check_plain

    def __call__(self, matches: Matches) -> Float[jax.Array, ""]:
        """Score of one pair `[K]`, float32."""
        confidence = match_confidence(matches)
        score = jnp.sum(confidence)
        return score if self.single == "count" else jnp.where(jnp.sum(confidence != 0) == 1, 0.0 * score, score)
