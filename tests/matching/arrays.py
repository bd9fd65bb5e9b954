"""Made-up shortlists, and images in one array."""

import jax
import numpy as np

from mfvpr.types import Shortlist


def make_shortlist(rows):
    """A shortlist of these database rows without scores; -1 = none."""
    indices = np.array(rows, np.int32)
    return Shortlist(indices, np.zeros(indices.shape, np.float32), indices >= 0)


def stack(trees):
    """The leaves of equal trees, such as features of the same capacity, along a new first axis."""
    return jax.tree.map(lambda *leaves: np.stack(leaves), *trees)
