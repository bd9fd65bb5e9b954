"""The number of matches as a score, the re-ranking of SelaVPR (Lu et al., ICLR 2024)."""

from dataclasses import dataclass

import jax

from mfvpr.numerics import count
from mfvpr.types import Array, Matches


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MatchCount:
    """Number of mutual matches."""

    def __call__(self, matches: Matches) -> Array:
        """Score of one pair, `[]` float32."""
        return count(matches.mask)
