"""Contract of all scorers, beside what `mfvpr.testing` checks (test_testing.py)."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mfvpr import (
    AggregatedScore,
    AnchorPoints,
    DescriptorDistanceWeight,
    FeatureScoreWeight,
    HistogramOfShifts,
    Homography,
    LostScore,
    MatchCount,
    RapidSpatialScore,
    RatioWeight,
    VisualPhrases,
    score_candidates,
    score_grid,
)
from mfvpr.core.scorer import fit_capacities, with_static_functions
from mfvpr.utils import InputError
from tests import scorers
from tests.builders import SIZE, per_match, random_matches, stack
from tests.scorers import FOREIGN, OWN, Wrapped, one_of_each_class, pair_of, plain, title

pytestmark = pytest.mark.thorough

every_scorer = pytest.mark.parametrize("scorer", one_of_each_class([*OWN, *FOREIGN]), ids=title)
_score_all = jax.jit(score_candidates)  # compiled once per shape: hence 60 slots, 5 pairs
SIZES = np.array([SIZE, SIZE], np.float32)


def fit(scorer):
    """The scorer with the capacity that the tests' images need."""
    return with_static_functions(fit_capacities(scorer, SIZES, SIZES))


def score(scorer, matches):
    return scorers.score(fit(scorer), matches)


def score_all(scorer, pairs):
    return _score_all(fit(scorer), stack(pairs))


@every_scorer
def test_neither_company_nor_order_nor_padding_matters(scorer):
    """Each score within rounding of itself, however small beside those of others."""
    order = np.random.default_rng(3).permutation(60)

    def pairs(**padding):
        counts = (0, 1, 60, 13, 37)
        return [random_matches(np.random.default_rng(count), count, capacity=60, **padding) for count in counts]

    expected = [score(scorer, pair) for pair in pairs()]
    np.testing.assert_allclose(score_all(scorer, pairs()), expected, rtol=2e-6, atol=0)
    shuffled = [per_match(pair, lambda rows: rows[order]) for pair in pairs(garbage=np.inf)]
    np.testing.assert_allclose(score_all(scorer, shuffled), expected, rtol=2e-6, atol=0)


@every_scorer
def test_a_masked_pair_may_have_any_size(scorer):
    rng = np.random.default_rng(9)
    pair, empty = random_matches(rng, 60), random_matches(rng, 0, capacity=60)
    empty = replace(empty, image_size0=np.full(2, np.nan, np.float32), image_size1=np.zeros(2, np.float32))
    scores = score_all(scorer, [pair, *[empty] * 4])
    np.testing.assert_allclose(scores[0], score(scorer, pair), rtol=2e-6)
    assert (scores[1:] == 0.0).all()
    numbers = [leaf for leaf in jax.tree.leaves(scorer) if isinstance(leaf, float)]
    if len(numbers) == len(jax.tree.leaves(scorer)) and not isinstance(scorer, Homography):  # which has no gradient
        for gradient in jax.tree.leaves(jax.jit(jax.grad(score))(fit(scorer), empty)):
            assert np.isfinite(gradient).all()


@every_scorer
@pytest.mark.parametrize(("candidates", "slots"), [(0, 60), (3, 0)])
def test_no_slots_and_no_candidates(scorer, candidates, slots):
    pair = per_match(random_matches(np.random.default_rng(0), 60), lambda rows: rows[:slots])
    batch = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (candidates, *leaf.shape)), pair)
    np.testing.assert_array_equal(_score_all(fit(scorer), batch), np.zeros(candidates))


@pytest.mark.parametrize(
    ("scorer", "values"),
    [
        (HistogramOfShifts, {"align": "zero_centre"}),
        (LostScore, {"form": "cosine"}),
        (HistogramOfShifts, {"sigma": -3}),
        (HistogramOfShifts, {"temperature": np.nan}),
        (HistogramOfShifts, {"shift_range": (10.0, -1.0)}),
        (VisualPhrases, {"cell_size": np.float64(-1)}),
        (RapidSpatialScore, {"size": (0.0, 10.0)}),
    ],
)
def test_misspelled_words_and_numbers_out_of_bounds_raise_and_arrays_do_not(scorer, values):
    with pytest.raises(InputError, match=f"^{next(iter(values))}=.*: expected (a|one of)"):
        scorer(**values)
    if not isinstance(next(iter(values.values())), str):
        scorer(**jax.tree.map(jnp.asarray, values))


def test_images_of_other_sizes_are_never_scored_with_too_few_bins():
    """The first thing that users of JAX do; 64 bins would not hold these images."""
    matches = stack([random_matches(np.random.default_rng(11), 30, sizes=((640, 480), (800, 600))) for _ in range(2)])
    expected = score_candidates(HistogramOfShifts(), matches)
    assert (expected > 0).all()
    for scorer in (HistogramOfShifts(), Wrapped()):
        for trace in (lambda scorer: _score_all(scorer, matches), lambda scorer: jax.jit(jax.vmap(scorer))(matches)):
            with pytest.raises(ValueError, match=r"bin_size .*traced; .*max_bins="):
                trace(scorer)
    roomy = HistogramOfShifts().with_capacity(matches.image_size0, matches.image_size1)
    np.testing.assert_allclose(_score_all(roomy, matches), expected, rtol=2e-6)
    inner = score_candidates(HistogramOfShifts(sigma=18.0), matches)
    np.testing.assert_allclose(
        score_candidates(Wrapped(), matches), inner + 0.25 * score_candidates(MatchCount(), matches), rtol=2e-6
    )


def test_a_capacity_that_is_too_small_raises_unless_traced():
    matches = stack([random_matches(np.random.default_rng(13), 30)])
    with pytest.raises(InputError, match="max_bins=44: expected at least 45"):
        score_candidates(HistogramOfShifts(max_bins=44), matches)
    with pytest.raises(InputError, match=r"bin_size=0.5: .*1024.*1344"):
        score_candidates(HistogramOfShifts(bin_size=0.5), matches)
    assert np.isnan(_score_all(HistogramOfShifts(max_bins=44), matches)).all()
    for refine in (False, True):
        shift = jax.jit(lambda pair: HistogramOfShifts(max_bins=44).dominant_shift(pair, refine=refine))  # noqa: B023
        assert np.isnan(shift(pair_of(matches))).all()


def test_calls_with_other_numbers_compile_nothing(compilations):
    matches = stack([random_matches(np.random.default_rng(count), 40 + count, capacity=64) for count in range(3)])
    scorers = [HistogramOfShifts(), AnchorPoints(), AggregatedScore(temperature=3.0), Wrapped(), HistogramOfShifts()]

    def score_everywhere(factor, pair):
        for scorer in scorers:
            score_candidates(jax.tree.map(lambda number: number * factor, scorer), matches)
        HistogramOfShifts(sigma=20 * factor).dominant_shift(pair_of(matches, pair), refine=True)
        axes = {"sigma": [5 * factor, 30.0], "bin_size": [4.9 + factor / 10, 15.0], "max_distance": [0.5, factor]}
        jax.block_until_ready(score_grid(HistogramOfShifts(), matches, **axes))

    score_everywhere(1.0, 0)
    compilations.reset()
    for factor in (0.99, 1.0, 1.01):
        score_everywhere(factor, 1)
    assert compilations.count == 0


def test_a_function_that_changes_is_not_taken_for_what_it_was():
    matches = stack([random_matches(np.random.default_rng(14), 30)])
    closure = {"factor": 1.0}
    weighted = HistogramOfShifts(weight=lambda matches: closure["factor"] * matches.scores0)
    for scorer in (lambda matches: closure["factor"] * plain(matches), weighted):
        closure["factor"] = 1.0
        before = score_candidates(scorer, matches)
        closure["factor"] = 2.0
        np.testing.assert_allclose(score_candidates(scorer, matches), 2 * before, rtol=2e-6)


@pytest.mark.first_case
@pytest.mark.parametrize("broken", [np.nan, np.inf])
@pytest.mark.parametrize("field", ["points0", "points1", "scores0", "distance", "ratio"])
def test_one_match_that_is_no_number_leaves_no_score(field, broken):
    """For one pair, in a batch, and in a grid; else such a pair would rank somewhere."""
    pair = random_matches(np.random.default_rng(15), 20, capacity=24)
    getattr(pair, field)[3] = broken
    batch = stack([pair, random_matches(np.random.default_rng(16), 20, capacity=24)])
    weight = {"distance": DescriptorDistanceWeight(), "ratio": RatioWeight()}.get(field, FeatureScoreWeight())
    anchors = [(AnchorPoints(num_bins=num_bins, weight=weight), {"tolerance": [3.0]}) for num_bins in (15, 3)]
    for scorer, axis in ((HistogramOfShifts(weight=weight), {"sigma": [22.5]}), *anchors):
        assert np.isnan(score(scorer, pair))
        for scores in (score_candidates(scorer, batch), score_grid(scorer, batch, **axis)[0]):
            assert np.isnan(scores[0])
            assert np.isfinite(scores[1])
    assert np.isnan(score(AggregatedScore(weight=weight), pair))
    assert np.isnan(HistogramOfShifts(weight=weight).dominant_shift(pair)).all()
    rapid = RapidSpatialScore(), RapidSpatialScore(reach="largest_shift")
    relatives = *rapid, VisualPhrases(), LostScore(), Homography(max_iterations=100.0)
    for scorer in relatives if "points" in field else ():
        assert np.isnan(score(scorer, pair))
