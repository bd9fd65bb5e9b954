"""LightGlue as a matcher: a network, trained for certain features, says which keypoints match, and how surely."""

from dataclasses import field
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from mfvpr.matching.nearest_neighbors import at_least_one, distance_ratio, paired, ready, slot_numbers
from mfvpr.matching.similarity import nearest
from mfvpr.networks.lightglue_assignment import Packed, assignment
from mfvpr.types import Features, Matches, value
from mfvpr.utils.errors import InputError
from mfvpr.utils.fingerprints import fingerprint, recipe_of

if TYPE_CHECKING:  # Flax takes half a second
    from mfvpr.networks.lightglue import LightGlue


@value
class LightGlueMatching:
    """The pairs of keypoints whose assignment is the largest of both, and above a threshold.

        matcher = LightGlueMatching.of(load_model("aliked_lightglue"), depth_confidence=0.95)

    Matches have the assignment as their `confidence`; `distance` and `ratio` are those of the descriptors, as of
    `mfvpr.match`. The published weights are for ALIKED's features of 128 dimensions, and mean nothing for others.

    Attributes:
        weights: of the network.
        network: the recipe of the network that they are of.
        filter_threshold: a match is kept where its assignment is above it.
        depth_confidence: layers of a pair are left out once more than this share of its keypoints is sure, which
            leaves out matches, a third on photographs; None = never. Pairs of a chunk wait for the slowest. The public
            code has 0.95 by default, and prunes keypoints as well (`width_confidence=0.99`), which is not done here:
            with 0.95 only 4 of 30 pairs had the matches of its defaults. They are those of `width_confidence=-1`.
        chunk_size: pairs at a time, see `mfvpr.Matcher`; it changes memory, time and the last bits alone.
    """

    weights: Packed
    network: str = field(metadata={"static": True})
    filter_threshold: float = 0.1
    depth_confidence: float | None = None
    chunk_size: int | None = field(default=None, metadata={"static": True})

    @classmethod
    def of(cls, model: "LightGlue", **options: Any) -> "LightGlueMatching":
        """With the weights of a model, see `mfvpr.checkpoints.files.load_model`, and further attributes as options."""
        return cls(jax.jit(type(model).packed)(model), fingerprint(recipe_of(model)), **options)

    @property
    def dimension(self) -> int:
        """Numbers of the descriptors it takes."""
        return self.weights.input.kernel.shape[0]

    @property
    def recipe(self) -> dict[str, Any]:
        """All that the matches depend on; the packed weights may differ in their last bits from machine to machine."""
        return {
            "network": self.network,
            "filter_threshold": self.filter_threshold,
            "depth_confidence": self.depth_confidence,
        }

    def __call__(self, features0: Features, features1: Features) -> Matches:
        """Of one pair, keypoints `[N0, 2]` and `[N1, 2]`: N0 slots, one at least; slot k is of keypoint k of the query.

        Raises:
            InputError: descriptors of another dimension.
        """
        features0, features1 = (ready(at_least_one(features)) for features in (features0, features1))
        for features in (features0, features1):
            if (got := features.descriptors.shape[-1]) != self.dimension:
                raise InputError(f"LightGlue: expected descriptors of {self.dimension} dimensions, got {got}; take the "
                                 "features that its weights are for")  # fmt: skip
        assigned = assignment(self.weights, features0, features1, depth_confidence=self.depth_confidence)
        best1, best0 = nearest(assigned, axis=1), nearest(assigned, axis=0)
        confidence = jnp.exp(best1.similarity)
        mutual = best0.index[best1.index] == slot_numbers(features0)
        real = mutual & (confidence > self.filter_threshold) & (best1.similarity > -jnp.inf)
        more = {"confidence": confidence, "ratio": distance_ratio(features0, features1)}
        return paired(features0, features1, best1.index, real, **more)
