"""Measurements of one pair's matches for scores: weights (paper, section IV-B), confidences, shifts, image sizes."""

from dataclasses import field, replace
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from jaxtyping import Float, Num

from mfvpr.core.types import INDICES, Array, Matches, per_match, value
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import Setting, one_of
from mfvpr.utils.numerics import as_float, at_least_single, masked


class Weight(Protocol):
    """Function of the Matches of ONE pair, slots `[K]`, that returns the weights `[K]` of its matches.

        def near(matches):
            return 1 / (1 + matches.distance)

        mfvpr.HistogramOfShifts(weight=near)
        mfvpr.match_weights(near, matches)  # times the matches' confidence, and 0 on padding, as scorers use it

    Weights of padding are arbitrary. A class decorated with `mfvpr.value` can be swept and learned, as a scorer can.
    """

    def __call__(self, matches: Matches, /) -> Array: ...


@value
class FeatureScoreWeight:
    """FS-weight: weights `[K]` w = scores0 + scores1, in units of the detector's scores.

    Example:
        mfvpr.HistogramOfShifts(weight=mfvpr.FeatureScoreWeight())  # or "fs" in grids and settings
    """

    def __call__(self, matches: Matches) -> Float[jax.Array, "*batch slots"]:
        return as_float(matches.scores0) + as_float(matches.scores1)


@value
class DescriptorDistanceWeight:
    """DMF-weight: weights `[K]` w = 2 - distance, in [0, 2] for descriptors of unit length.

    Example:
        mfvpr.HistogramOfShifts(weight=mfvpr.DescriptorDistanceWeight())  # "dmf" in grids and settings
    """

    def __call__(self, matches: Matches) -> Float[Array, "*batch slots"]:
        return 2.0 - matches.distance


@value
class RatioWeight:
    """Weights `[K]` w = (1 - ratio)^exponent, in [0, 1], from the ratio of descriptor distances.

        mfvpr.HistogramOfShifts(weight=mfvpr.RatioWeight())(mfvpr.match(features0, features1, with_ratio=True))

    A keypoint that resembles two keypoints of the candidate equally has weight 0 (Lowe, IJCV 2004, section 7.1). This
    weight is not from the paper. Matches without a ratio raise an InputError. A larger exponent emphasizes unambiguous
    matches; no value is better than 1.
    """

    exponent: float | Array = 1.0

    def __call__(self, matches: Matches) -> Float[jax.Array, "*batch slots"]:
        lead = 1.0 - match_ratio(matches)
        is_zero = (lead <= 0) & jnp.isfinite(lead)  # the derivatives of the power would be infinite
        return jnp.where(is_zero, 0.0, jnp.where(is_zero, 1.0, lead) ** jnp.asarray(self.exponent, lead.dtype))


@value
class UnitWeight:
    """Weights `[K]` w = 1: every match counts the same.

    Example:
        mfvpr.HistogramOfShifts(weight=mfvpr.UnitWeight())  # "unit" in grids and settings
    """

    def __call__(self, matches: Matches) -> Num[jax.Array, "*batch slots"]:
        return jnp.ones_like(matches.distance)


@value
class ChosenWeight:
    """One of several weights, selected by an index that may be traced and batched."""

    options: tuple[Weight, ...]
    index: int | Array

    def __call__(self, matches: Matches) -> Float[jax.Array, "*batch slots"]:
        return jnp.stack([as_float(weight(matches)) for weight in self.options])[self.index]


WEIGHTS: dict[str, Weight] = {
    "fs": FeatureScoreWeight(),
    "dmf": DescriptorDistanceWeight(),
    "ratio": RatioWeight(),
    "unit": UnitWeight(),
}
"""The fixed weights by the words of grids and settings."""


def weight_field(word: str) -> Any:
    """Declare a field that holds a weight, by default the one of a word."""
    about = Setting(word, one_of(*WEIGHTS))
    return field(default=WEIGHTS[word], metadata={"setting": about})


def match_weights(weight: Weight, matches: Matches) -> Float[jax.Array, " slots"]:
    """Weights `[K]` of one pair's `matches` by a `weight`, times their confidence, 0 on padding.

    An `InputError` if the weight returns another shape, or if the arrays of the matches have different lengths.

    Example:
        mfvpr.match_weights(mfvpr.DescriptorDistanceWeight(), matches)  # [K]
    """
    matches = replace(matches)  # checks the shapes, which `jax.tree.map` may have changed: they would be broadcast
    # Padding is set to 1 before the weight's arithmetic: its NaN would reappear in the gradients.
    clean = {
        name: masked(values if name in INDICES else at_least_single(values), matches.mask, 1)
        for name, values in per_match(matches).items()
    }
    weights = at_least_single(weight(replace(matches, **clean)))
    if weights.shape != matches.mask.shape:
        raise InputError(
            f"weight: expected a weight for each of {list(matches.mask.shape)} matches, got an array "
            f"{list(weights.shape)}"
        )
    weights = masked(weights, matches.mask)
    return weights if matches.confidence is None else weights * match_confidence(matches)


def match_ratio(matches: Matches) -> Float[jax.Array, "*batch slots"]:
    """The matches' ratio; an InputError if they have none."""
    if matches.ratio is None:
        raise InputError("expected matches with a ratio, got none; match them with_ratio=True")
    return as_float(matches.ratio)


def match_confidence(matches: Matches) -> Float[jax.Array, "*batch slots"]:
    """The matches' confidence, by default 1, and 0 on padding. Confidence 0 means no match."""
    confidence = jnp.ones_like(matches.distance) if matches.confidence is None else matches.confidence
    return masked(at_least_single(confidence), matches.mask)


def match_shifts(matches: Matches) -> Float[jax.Array, "slots 2"]:
    """Shifts points1 - points0 of one pair's `matches`, slots `[K]`, in px; 0 on padding.

    Example:
        mfvpr.match_shifts(matches)  # [K, 2], (x, y)
    """
    matches = replace(matches)  # checks the shapes, as in `match_weights`
    start, end = (masked(at_least_single(points), matches.mask) for points in (matches.points0, matches.points1))
    return end - start


def require_sizes(*image_sizes: Array | None) -> None:
    """Raise an InputError if the sizes of images are not known."""
    if any(size is None for size in image_sizes):
        raise InputError(
            "image_size: expected the sizes of both images, which this score needs, got None; give "
            "Features.of(..., image_size=(width, height))"
        )


def image_sizes(matches: Matches) -> tuple[Float[jax.Array, "2"], Float[jax.Array, "2"]]:
    """Sizes (width, height) of query and candidate, px, of one pair's `matches`, slots `[K]`.

        (width0, height0), (width1, height1) = mfvpr.image_sizes(matches)

    Without matches, invalid sizes are 1. Sizes that are None raise an `InputError`.
    """
    require_sizes(matches.image_size0, matches.image_size1)
    has_matches = jnp.any(matches.mask)
    size0, size1 = at_least_single(matches.image_size0), at_least_single(matches.image_size1)
    usable = lambda size: has_matches | ((size > 0) & jnp.isfinite(size))  # noqa: E731
    return masked(size0, usable(size0), 1.0), masked(size1, usable(size1), 1.0)
