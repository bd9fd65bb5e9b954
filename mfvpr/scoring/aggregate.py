"""Aggregated score (paper, section III-C): every match counts, less so the further its shift is from the mean."""

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp

from mfvpr.numerics import as_float, masked, masked_mean, masked_median
from mfvpr.scoring.choices import check_choices, choice
from mfvpr.scoring.shifts import match_shifts
from mfvpr.types import Array, Matches
from mfvpr.weighting import DescriptorDistanceWeight, Weight, match_weights


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class AggregatedScore:
    """s = sum_k w_k ((W - |x_k - mean x|)^2 + (H - |y_k - mean y|)^2) over the shifts, in weight x px^2.

    Attributes:
        weight: match weight, DMF by default as in the paper.
        mean: center of the shifts: `unweighted` mean (as printed), `weighted` mean or `median`.
        clamp: let a shift further from the center than the image is wide count 0 instead of growing again.
    """

    weight: Weight = DescriptorDistanceWeight()
    mean: str = choice("unweighted", "weighted", "median")
    clamp: bool = field(default=False, metadata={"static": True})

    def __post_init__(self) -> None:
        check_choices(self)

    def __call__(self, matches: Matches) -> Array:
        """Score of one pair, `[]` float32."""
        weights = match_weights(self.weight, matches)
        shifts = match_shifts(matches)
        center = self._center(shifts, weights, matches.mask)
        closeness = as_float(matches.image_size0)[None] - jnp.abs(shifts - center[None])
        closeness = jnp.maximum(closeness, 0.0) if self.clamp else closeness
        return jnp.sum(weights * jnp.sum(masked(closeness, matches.mask) ** 2, axis=-1))

    def _center(self, shifts: Array, weights: Array, mask: Array) -> Array:
        if self.mean == "median":
            return masked_median(shifts, mask)
        return masked_mean(shifts, mask, weights if self.mean == "weighted" else None)
