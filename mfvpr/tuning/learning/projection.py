"""A linear projection of local descriptors to fewer dimensions."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Num

from mfvpr.types import Array, Features, value
from mfvpr.utils.numerics import masked, safe_sqrt


@value
class Projection:
    """x -> x M / |x M| of unit length; padding, and a descriptor with x M = 0, become 0."""

    matrix: Float[Array, "dimensions projected"]

    def __call__(self, features: Features) -> Features:
        """Project the descriptors of features."""
        descriptors = masked(jnp.asarray(features.descriptors, dtype=self.matrix.dtype), features.mask)
        projected = jnp.matmul(descriptors, self.matrix, precision=jax.lax.Precision.HIGHEST)
        length = safe_sqrt(jnp.sum(projected**2, axis=-1, keepdims=True))
        return replace(features, descriptors=projected / jnp.where(length > 0, length, 1.0))

    @classmethod
    def principal(cls, descriptors: Num[np.ndarray, "descriptors dimensions"], dimension: int) -> "Projection":
        """The projection that preserves most of the descriptors' squared length: PCA without centering.

        The mean is not subtracted, since matching compares dot products. The columns are orthonormal, the strongest
        first.

        Raises:
            ValueError: `dimension` is below 1, or above the number of dimensions of the descriptors.
        """
        available = np.shape(descriptors)[1]
        if not 1 <= dimension <= available:
            raise ValueError(f"Projection.principal(dimension={dimension}): expected 1 to {available}")
        values = np.asarray(descriptors, np.float64)
        _, vectors = np.linalg.eigh(values.T @ values)  # D x D: far cheaper than the singular vectors of n x D
        return cls(jnp.asarray(vectors[:, : -dimension - 1 : -1], dtype=float))
