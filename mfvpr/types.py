"""What flows through the house: Features -> Shortlist and Matches -> Ranking.

Axis letters: Q queries, C candidates, N keypoints, K match slots, D descriptor dimension. `0` = query, `1` = candidate.
Points are (x, y) in pixels of the image that the detector saw. `mask` is True on real entries; what padding holds
never matters, NaN included. Every field may carry leading batch axes. Arrays may be NumPy's or JAX's.
"""

from dataclasses import dataclass
from typing import Any

import jax

Array = Any  # jax.Array or np.ndarray: the host builds with NumPy what the device computes with


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Features:
    """Local features of one image.

    Attributes:
        keypoints: `[..., N, 2]` (x, y), px.
        descriptors: `[..., N, D]`, unit Euclidean length.
        scores: `[..., N]` detection scores, larger = better.
        mask: `[..., N]` bool.
        image_size: `[..., 2]` (width, height), px.
    """

    keypoints: Array  # [..., N, 2]
    descriptors: Array  # [..., N, D]
    scores: Array  # [..., N]
    mask: Array  # [..., N]
    image_size: Array  # [..., 2]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Matches:
    """Putative matches between a query image (0) and a candidate (1).

    Attributes:
        points0: `[..., K, 2]` (x, y) in the query, px.
        points1: `[..., K, 2]` (x, y) in the candidate, px.
        distance: `[..., K]` Euclidean distance of the unit descriptors, in [0, 2].
        scores0: `[..., K]` detection scores in the query.
        scores1: `[..., K]` detection scores in the candidate.
        mask: `[..., K]` bool.
        image_size0: `[..., 2]` (width, height) of the query, px.
        image_size1: `[..., 2]` (width, height) of the candidate, px.
        ratio: `[..., K]` distance to the nearest descriptor of the candidate over that to the second nearest, in
            [0, 1]; None where nobody asked for it.
        confidence: `[..., K]` in [0, 1], how surely a match is one: it counts so much of its weight. None = 1.
    """

    points0: Array  # [..., K, 2]
    points1: Array  # [..., K, 2]
    distance: Array  # [..., K]
    scores0: Array  # [..., K]
    scores1: Array  # [..., K]
    mask: Array  # [..., K]
    image_size0: Array  # [..., 2]
    image_size1: Array  # [..., 2]
    ratio: Array | None = None  # [..., K]
    confidence: Array | None = None  # [..., K]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Shortlist:
    """The filter's best candidates for each query.

    Attributes:
        indices: `[Q, C]` int32 database rows, best first, -1 = none.
        scores: `[Q, C]` filter scores (cosine similarity).
        mask: `[Q, C]` bool, False where the index is -1.
    """

    indices: Array  # [Q, C]
    scores: Array  # [Q, C]
    mask: Array  # [Q, C]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Ranking:
    """A re-ranked shortlist.

    Attributes:
        order: `[Q, C]` int32 positions into the shortlist, best first.
        scores: `[Q, C]` re-ranking scores in the shortlist's order (not sorted).
    """

    order: Array  # [Q, C]
    scores: Array  # [Q, C]
