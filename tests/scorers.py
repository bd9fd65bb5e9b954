"""Scorers as users write them, beside the library's own, for every test of scoring; compiled scores of one pair."""

import jax
import jax.numpy as jnp
import pytest

import mfvpr
from mfvpr import (
    AggregatedScore,
    AnchorPoints,
    HistogramOfShifts,
    Homography,
    LostScore,
    MatchCount,
    RapidSpatialScore,
    RatioWeight,
    UnitWeight,
    VisualPhrases,
)


def plain(matches):
    """A function: how close the descriptors of the matches are, all together."""
    return jnp.sum(mfvpr.masked(2.0 - matches.distance, matches.mask))


@mfvpr.value
class Wrapped:
    """A score made of the library's: what needs a capacity lies inside."""

    inner: HistogramOfShifts = HistogramOfShifts(sigma=18.0)
    share: float = 0.25

    def __call__(self, matches):
        return self.inner(matches) + self.share * MatchCount()(matches)


@mfvpr.value
class Strongest:
    """An int that is an index: the detection scores of the n-th strongest match."""

    place: int = 1

    def __call__(self, matches):
        strength = mfvpr.masked(matches.scores0 + matches.scores1, matches.mask)
        ordered = jnp.sort(jnp.pad(strength, (0, 8)))
        return ordered[len(ordered) - 1 - self.place]


@mfvpr.value
class Sampled:
    """A key: how well shifts agree along random directions."""

    key: jax.Array
    scale: float = 20.0

    def __call__(self, matches):
        shifts = mfvpr.match_shifts(matches)
        weights = mfvpr.match_weights(UnitWeight(), matches)
        angles = jax.random.uniform(self.key, (3,), shifts.dtype, maxval=jnp.pi)
        along = shifts[:, :1] * jnp.cos(angles)[None] + shifts[:, 1:] * jnp.sin(angles)[None]
        center = jax.vmap(mfvpr.masked_median, (1, None))(along, matches.mask)
        return jnp.sum(weights[:, None] * jnp.exp(-(((along - center[None]) / self.scale) ** 2)))


def closest(matches):
    """A weight that is a function."""
    return 1.0 / (1.0 + matches.distance)


OWN = [
    HistogramOfShifts(),
    HistogramOfShifts(bin_size=20.0, sigma=12.0, truncate=3.0, align="zero_center", weight=UnitWeight()),
    HistogramOfShifts(shift_range=(100.0, 50.0), align="zero_edge", direction="query_minus_candidate"),
    HistogramOfShifts(weight=RatioWeight()),
    AnchorPoints(),
    AnchorPoints(window_mode="asymmetric", first="candidate", cell_weight="cell_sum", include_self=False),
    AggregatedScore(),
    AggregatedScore(mean="median"),
    MatchCount(),
    Homography(max_iterations=100.0),
    RapidSpatialScore(),
    RapidSpatialScore(reach="largest_coordinate", per_feature=True),
    RapidSpatialScore(reach="largest_shift"),
    VisualPhrases(),
    VisualPhrases(length=3, cell_size=40.0, align="zero_edge"),
    LostScore(),
    LostScore(form="unweighted", mirrored=True),
    HistogramOfShifts(temperature=0.05),
    AnchorPoints(num_bins=8, temperature=0.2),
    AggregatedScore(mean="weighted", clamp=True, temperature=30.0),
]
FOREIGN_VALUES = [Wrapped(), Strongest(), Sampled(jax.random.key(3))]
FOREIGN = [plain, *FOREIGN_VALUES, HistogramOfShifts(weight=closest)]


def title(scorer):
    return getattr(scorer, "__name__", type(scorer).__name__)


def one_of_each_class(scorers):
    """Cases of a test: the first scorer of each class for `make test`, the others for `make test-all`."""
    classes = [type(scorer) for scorer in scorers]
    return [
        pytest.param(scorer, marks=[pytest.mark.slow] if type(scorer) in classes[:place] else [])
        for place, scorer in enumerate(scorers)
    ]


score = jax.jit(lambda scorer, matches: scorer(matches))


def pair_of(batch, row=0):
    return jax.tree.map(lambda leaf: leaf[row], batch)


def each_scorer(scorers):
    """Parametrize a test by scorers."""
    return pytest.mark.parametrize("scorer", scorers, ids=lambda scorer: type(scorer).__name__)
