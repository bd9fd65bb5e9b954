"""LightGlue as a matcher: a network, trained for certain features, that predicts matches and their confidence."""

from dataclasses import field
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from mfvpr.core.matching import at_least_one, distance_ratio, make_matches, slot_numbers
from mfvpr.core.nearest import largest_of, lines_of, ready
from mfvpr.core.types import Features, Matches, short_repr, value
from mfvpr.matchers.matcher import CHUNK_SIZE
from mfvpr.networks.lightglue_assignment import Packed, assignment
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import COUNT, check_fields, number, setting
from mfvpr.utils.fingerprints import fingerprint, recipe_of

if TYPE_CHECKING:  # Flax takes half a second
    from mfvpr.networks.lightglue import LightGlue


@value
class LightGlueMatcher:
    """Mutual maxima of LightGlue's assignment that are above a threshold.

        matcher = LightGlueMatcher.of(load_model("aliked_lightglue"), depth_confidence=0.95)

    The assignment is the `confidence` of a match; `distance` and `ratio` are those of the descriptors, as in
    `mfvpr.match`. The published weights are for ALIKED's features of 128 dimensions, and useless for other features.

    Attributes:
        weights: of the network.
        network: recipe of the network that the weights belong to.
        filter_threshold: a match is kept if its assignment is larger.
        depth_confidence: skip the remaining layers of a pair once more than this share of its keypoints is confident.
            This loses matches, a third on photographs; None = never. The pairs of a chunk wait for the slowest. The
            public code uses 0.95 by default and also prunes keypoints, which this class does not: matches equal those
            of `width_confidence=-1`.
        chunk_size: pairs at a time, see `mfvpr.Matcher`; changes only memory, time and the last bits.
    """

    weights: Packed
    network: str = field(metadata={"static": True})
    filter_threshold: float = setting(
        0.1, number(0, 1), "matches are kept whose assignment, their confidence, is above it"
    )
    depth_confidence: float | None = setting(
        None, number(0, 1) | None, "leave layers out once more than this share of keypoints is sure; null = never"
    )
    chunk_size: int | None = setting(None, COUNT | None, CHUNK_SIZE, static=True)

    __repr__ = short_repr

    def __post_init__(self) -> None:
        check_fields(self)

    @classmethod
    def of(cls, model: "LightGlue", **options: Any) -> "LightGlueMatcher":
        """Matcher from a model (`mfvpr.checkpoints.load_model`) and further attributes."""
        return cls(jax.jit(type(model).pack)(model), fingerprint(recipe_of(model)), **options)

    @property
    def dimension(self) -> int:
        """Dimension of the descriptors."""
        return self.weights.input.kernel.shape[0]

    @property
    def recipe(self) -> dict[str, Any]:
        """Everything that matches depend on; packed weights vary in the last bits between machines."""
        return {name: getattr(self, name) for name in ("network", "filter_threshold", "depth_confidence")}

    def __call__(self, features0: Features, features1: Features) -> Matches:
        """Matches of one pair, keypoints `[N0, 2]` and `[N1, 2]`: max(N0, 1) slots, slot k is keypoint k of the query.

        Descriptors of another dimension raise an `InputError`.
        """
        features0, features1 = (ready(at_least_one(features)) for features in (features0, features1))
        for features in (features0, features1):
            if (got := features.descriptors.shape[-1]) != self.dimension:
                raise InputError(
                    f"LightGlue: expected descriptors of {self.dimension} dimensions, got {got}; take the "
                    "features that its weights are for"
                )
        assigned = assignment(self.weights, features0, features1, depth_confidence=self.depth_confidence)
        best1, best0 = largest_of(lines_of(assigned, axis=1)), largest_of(lines_of(assigned, axis=0))
        confidence = jnp.exp(best1.similarity)
        mutual = best0.index[best1.index] == slot_numbers(features0)
        real = mutual & (confidence > self.filter_threshold) & (best1.similarity > -jnp.inf)
        ratio = distance_ratio(features0, features1)
        return make_matches(features0, features1, best1.index, real, confidence=confidence, ratio=ratio)
