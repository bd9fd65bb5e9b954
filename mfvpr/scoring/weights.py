"""Match weights (paper, section IV-B): values that map one pair's Matches to one weight per slot.

What they return on padding is arbitrary; `match_weights` is the form that scorers use.
"""

from collections.abc import Callable
from dataclasses import replace

import jax.numpy as jnp

from mfvpr.types import INDICES, Array, Matches, per_match, value
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import as_float, at_least_single, masked

Weight = Callable[[Matches], Array]


@value
class FeatureScoreWeight:
    """FS-weight: w = scores0 + scores1, in units of the detector's scores."""

    def __call__(self, matches: Matches) -> Array:
        return as_float(matches.scores0) + as_float(matches.scores1)


@value
class DescriptorDistanceWeight:
    """DMF-weight: w = 2 - distance, in [0, 2]."""

    def __call__(self, matches: Matches) -> Array:
        return 2.0 - matches.distance


@value
class RatioWeight:
    """w = (1 - ratio)^exponent, in [0, 1], of the ratio of distances to the nearest and the second nearest descriptor.

    The ratio is how ambiguous a match is (Lowe, IJCV 2004, section 7.1): a keypoint that resembles two of the
    candidate's as much counts nothing. It is not the paper's.

    Attributes:
        exponent: 1 is as good as others; larger ones count clear matches more.
    """

    exponent: float | Array = 1.0

    def __call__(self, matches: Matches) -> Array:
        """`[K]`.

        Raises:
            InputError: the matches have no ratio.
        """
        lead = 1.0 - match_ratio(matches)
        none = (lead <= 0) & jnp.isfinite(lead)  # there the power's derivatives are infinite
        return jnp.where(none, 0.0, jnp.where(none, 1.0, lead) ** jnp.asarray(self.exponent, lead.dtype))


@value
class UnitWeight:
    """w = 1: every match counts the same."""

    def __call__(self, matches: Matches) -> Array:
        return jnp.ones_like(matches.distance)


@value
class ChosenWeight:
    """One of several weights, by its number: so the kind of weight may be traced and batched like a parameter."""

    options: tuple[Weight, ...]
    index: int | Array

    def __call__(self, matches: Matches) -> Array:
        return jnp.stack([as_float(weight(matches)) for weight in self.options])[self.index]


WEIGHTS: dict[str, Weight] = {
    "fs": FeatureScoreWeight(),
    "dmf": DescriptorDistanceWeight(),
    "ratio": RatioWeight(),
    "unit": UnitWeight(),
}


def match_weights(weight: Weight, matches: Matches) -> Array:
    """`[K]` weights times the matches' confidence, 0 on padding."""
    # Padding is 1 before any arithmetic of the weight: else its NaN would return in the gradients.
    clean = {
        name: masked(values if name in INDICES else at_least_single(values), matches.mask, 1)
        for name, values in per_match(matches).items()
    }
    weights = masked(at_least_single(weight(replace(matches, **clean))), matches.mask)
    return weights if matches.confidence is None else weights * match_confidence(matches)


def match_ratio(matches: Matches) -> Array:
    """`[..., K]` the matches' ratio.

    Raises:
        InputError: they have none.
    """
    if matches.ratio is None:
        raise InputError("expected matches with a ratio, got none; match them with_ratio=True")
    return as_float(matches.ratio)


def match_confidence(matches: Matches) -> Array:
    """`[K]` the matches' confidence, 1 where nobody gave one, 0 on padding; a match of confidence 0 is none."""
    confidence = jnp.ones_like(matches.distance) if matches.confidence is None else matches.confidence
    return masked(at_least_single(confidence), matches.mask)
