"""The number of matches as a score, the re-ranking of SelaVPR (Lu et al., ICLR 2024)."""

import jax.numpy as jnp

from mfvpr.types import Array, Matches, value
from mfvpr.weighting import match_confidence


@value
class MatchCount:
    """Number of matches, each counted with its confidence.

    Soft matches make it soft: its temperature is that of `mfvpr.soft_match`.
    """

    def __call__(self, matches: Matches) -> Array:
        """Score of one pair, `[]` float32."""
        return jnp.sum(match_confidence(matches))
