"""Grids of the histogram: the largest of all bins without most of them, whatever the options."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mfvpr import (
    DescriptorDistanceWeight,
    FeatureScoreWeight,
    HistogramOfShifts,
    UnitWeight,
    filter_matches,
    score_candidates,
    score_grid,
)
from mfvpr.core import tallest
from mfvpr.core.lattice import Lattice
from mfvpr.core.tallest import tallest_bins
from tests.builders import per_match, random_matches, stack
from tests.core.batches import pair_of

pytestmark = pytest.mark.thorough

SLOTS, WEIGHTINGS = 64, 8  # a search with every one of the capacities
CAPACITIES = {20.0: 40, 10.0: 72, 5.0: 136, 3.0: 296}  # by bin size, with blocks of 2, 3, 4 and 8 bins
pairs = jax.jit(tallest_bins, static_argnums=3)
bounds = jax.jit(tallest.block_bounds, static_argnums=(3, 4))


def search(shifts, weights, lattice, capacity):
    return pairs(*stack([(shifts, weights, lattice)]), capacity)[0]


@pytest.fixture(scope="module")
def matches():
    rng = np.random.default_rng(0)
    sizes = [((336, 336), (336, 336)), ((320, 240), (336, 200)), ((200, 300), (336, 336)), ((336, 336), (90, 30))]
    cases = zip((60, 0, 1, 33), sizes, strict=True)
    return stack([random_matches(rng, count, capacity=60, sizes=of_pair) for count, of_pair in cases])


@st.composite
def histograms(draw):
    """Shifts `[2, SLOTS]`, weights `[WEIGHTINGS, SLOTS]`, a lattice and its capacity."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    bin_size = draw(st.sampled_from(list(CAPACITIES)))
    capacity = CAPACITIES[bin_size]
    num_bins = rng.integers(1, capacity + 1, 2) if draw(st.booleans()) else np.full(2, capacity)
    scale = draw(st.sampled_from([0.1, 1.0, 20.0]))  # with bins of 1 to 60 px, and deviations from 0.05 px to flat
    reach = bin_size * num_bins[:, None] / 2
    shifts = rng.uniform(-1, 1, (2, SLOTS)) * reach * draw(st.sampled_from([0.01, 0.5, 1.0, 2.0]))  # 2: out of range
    shared = rng.random(SLOTS) < draw(st.sampled_from([0.0, 0.3, 1.0]))
    shifts = np.where(shared[None], shifts[:, :1] + rng.normal(0, bin_size / 2, (2, SLOTS)), shifts)
    if draw(st.booleans()):  # ties: on bins, on edges
        shifts = np.round(shifts / bin_size * 2) * bin_size / 2
    weights = rng.uniform(0, 2, (WEIGHTINGS, SLOTS)) * (rng.random((WEIGHTINGS, SLOTS)) < rng.random((WEIGHTINGS, 1)))
    if draw(st.booleans()):
        weights[0] -= 1
    weights[1] = 0
    deviation = bin_size * draw(st.sampled_from([0.17, 0.5, 1.0, 2.1, 4.0, 8.0, 25.0, 1e4]))
    truncate = draw(st.sampled_from([np.inf, 6.0, 1.5, 0.3]))
    numbers = (-reach[:, 0] + bin_size / 2, num_bins, bin_size, deviation, truncate)
    first, num_bins, bin_size, deviation, truncate = (np.asarray(number, np.float32) for number in numbers)
    lattice = Lattice(first * scale, num_bins, bin_size * scale, deviation * scale, truncate)
    lattice = jax.tree.map(np.float32, lattice)
    return (shifts * scale).astype(np.float32), weights.astype(np.float32), lattice, capacity


def all_bins(shifts, weights, lattice, dtype):
    """Signed and unsigned sums of votes, `[W, By, Bx]`, by whole arrays of `dtype`."""
    shifts, weights, lattice = jax.tree.map(lambda leaf: np.asarray(leaf, dtype), (shifts, weights, lattice))
    votes = []
    for axis in (0, 1):
        centers = np.float32(lattice.first[axis] + np.arange(int(lattice.num_bins[axis])) * lattice.bin_size)
        sigmas = (centers.astype(dtype)[:, None] - shifts[axis]) / lattice.deviation
        # A match at the very end of the votes' reach counts or not by the rounding of its distance.
        edge = np.float32(np.abs(sigmas)) <= np.float32(lattice.truncate)
        votes.append(np.where(edge, np.exp(-0.5 * sigmas**2), 0))
    return tuple(np.einsum("wk,yk,xk->wyx", w, votes[1], votes[0], optimize=True) for w in (weights, np.abs(weights)))


@given(histograms())
def test_no_bin_is_taller(histogram):
    """Up to the rounding of votes to float32; exactly 0 for weights of 0."""
    shifts, weights, lattice, capacity = histogram
    assert capacity**2 * WEIGHTINGS > tallest.WORTHWHILE
    got = search(shifts, weights, lattice, capacity)
    expected, magnitude = all_bins(shifts, weights, lattice, np.float64)
    # Centers are rounded to float32 as well, which narrow votes far from the origin notice.
    rounding = 2e-6 + 4e-7 * float(np.max(np.abs(lattice.first)) / lattice.deviation)
    np.testing.assert_array_less(abs(got - expected.max((1, 2))), rounding * magnitude.max((1, 2)) + 1e-30)
    assert got[1] == 0


@given(histograms())
def test_a_bound_exceeds_all_bins_of_its_block(histogram):
    shifts, weights, lattice, capacity = histogram
    side = tallest.block_side(capacity)
    count = -(-capacity // side)
    expected, _ = all_bins(shifts, weights, lattice, np.float64)
    padded = np.zeros((WEIGHTINGS, count * side, count * side))
    padded[:, : expected.shape[1], : expected.shape[2]] = expected
    blocks = padded.reshape(WEIGHTINGS, count, side, count, side).max((2, 4))
    got = np.moveaxis(bounds(shifts, weights, lattice, side, count), 1, 0)
    np.testing.assert_array_less(blocks, got + 1e-30)


def test_a_bin_without_votes_is_taller_than_negative_ones():
    shifts = np.random.default_rng(3).uniform(-20, 20, (2, SLOTS)).astype(np.float32)
    weights = np.full((WEIGHTINGS, SLOTS), -1, np.float32)
    lattice = jax.tree.map(np.float32, Lattice(np.full(2, -33.5), np.full(2, 136), 0.5, 1.0, 1.5))
    np.testing.assert_array_equal(search(shifts, weights, lattice, 136), 0)


def test_most_blocks_are_left_out(monkeypatch):
    """Half of the matches agree: few blocks are evaluated."""
    pair = random_matches(np.random.default_rng(1), SLOTS)
    shifts = (pair.points1 - pair.points0).T
    lattice = jax.tree.map(np.float32, Lattice(np.full(2, -336 + 2.5), np.full(2, 135), 5.0, 15.0, np.inf))
    evaluated = []
    evaluate = tallest.evaluate_blocks

    def record_blocks(blocks, *inputs):
        jax.debug.callback(lambda blocks: evaluated.extend(blocks.tolist()), blocks)
        return evaluate(blocks, *inputs)

    monkeypatch.setattr(tallest, "evaluate_blocks", record_blocks)
    jax.block_until_ready(jax.jit(partial(tallest.search_blocks, capacity=136))(shifts, pair.scores0[None], lattice))
    jax.effects_barrier()
    assert len(evaluated) == len(set(evaluated))
    assert 0 < len(evaluated) <= 34**2 // 10


OPTIONS = [
    {},
    {"align": "zero_center", "truncate": 2.0},
    {"align": "zero_edge", "shift_range": (100.0, 40.0)},
    {"direction": "query_minus_candidate", "sigma_is_variance": True},
    {"weight": DescriptorDistanceWeight(), "max_bins": 140},
    {"temperature": 0.3},
    {"weight": UnitWeight()},
]


@pytest.mark.first_case
@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_a_grid_equals_pair_by_pair(matches, options):
    """Every option, pairs of different sizes, searched (5 px) and whole (15 px), empty and single pairs."""
    matches = replace(matches, confidence=None) if "weight" in options else matches
    scorer, sigmas, bin_sizes = HistogramOfShifts(**options), [4.0, 30.0], [5.0, 15.0]
    got = score_grid(scorer, matches, sigma=sigmas, bin_size=bin_sizes)
    for sigma, row in zip(sigmas, got, strict=True):
        scorers = [replace(scorer, sigma=sigma, bin_size=bin_size, max_bins=144) for bin_size in bin_sizes]
        expected = [score_candidates(scorer, matches) for scorer in scorers]
        np.testing.assert_allclose(row, expected, rtol=2e-6, atol=1e-6)


def test_a_grid_with_weights_and_distances_equals_pair_by_pair(matches):
    weights, limits = [FeatureScoreWeight(), DescriptorDistanceWeight(), UnitWeight()], [0.3, 0.9, 1.5]
    got = score_grid(HistogramOfShifts(), matches, sigma=[8.0, 40.0], weight=weights, max_distance=limits)
    for j, weight in enumerate(weights):
        for k, limit in enumerate(limits):
            near = jax.vmap(partial(filter_matches, max_distance=limit))(matches)
            for i, sigma in enumerate((8.0, 40.0)):
                expected = score_candidates(HistogramOfShifts(sigma=sigma, weight=weight), near)
                np.testing.assert_allclose(got[i, j, k], expected, rtol=2e-6)


def test_neither_padding_nor_company_matters(matches):
    """More slots, fewer pairs than cores, none at all."""
    grid = partial(score_grid, HistogramOfShifts(), sigma=[10.0], bin_size=[5.0])
    alone = jax.tree.map(lambda leaf: leaf[3:], matches)
    loose = per_match(alone, lambda rows: np.repeat(rows, 2, axis=1))
    loose = replace(loose, mask=loose.mask & (np.arange(120) % 2 == 0)[None])
    expected = grid(matches)[..., 3:]
    np.testing.assert_allclose(grid(alone), expected, rtol=2e-7)
    np.testing.assert_allclose(grid(loose), expected, rtol=1e-6)
    assert grid(jax.tree.map(lambda leaf: leaf[:0], matches)).shape == (1, 1, 0)
    many = jax.tree.map(lambda leaf: np.concatenate([leaf] * 5 + [leaf[:1]]), matches)  # 21: shared by several cores
    np.testing.assert_allclose(grid(many), jnp.tile(grid(matches), 6)[..., :21], rtol=2e-7)


def test_a_weight_that_is_no_number_spoils_its_own_score_only(matches):
    spoiled = replace(matches, scores0=np.where(matches.mask, np.nan, matches.scores0))
    got = score_grid(HistogramOfShifts(bin_size=5.0), spoiled, weight=[FeatureScoreWeight(), UnitWeight()])
    expected = score_candidates(HistogramOfShifts(bin_size=5.0, weight=UnitWeight()), matches)
    np.testing.assert_allclose(got[1], expected, rtol=2e-6)
    np.testing.assert_array_equal(got[0], [np.nan, 0.0, np.nan, np.nan])


def test_what_does_not_fit_is_nan(matches):
    grid = jax.jit(lambda m, sizes: score_grid(HistogramOfShifts(max_bins=100), m, sigma=[9.0], bin_size=sizes))
    small, large = grid(matches, jnp.array([5.0, 10.0]))[0]
    fits = np.ceil((np.asarray(matches.image_size0) + matches.image_size1).max(1) / 5) <= 100
    np.testing.assert_array_equal(np.isnan(small), ~fits & matches.mask.any(1))
    assert np.isfinite(large).all()


@pytest.mark.parametrize("sigma", [0.0, -1.0, np.nan])
def test_no_width_no_score(matches, sigma):
    scorer = HistogramOfShifts(bin_size=5.0, max_bins=136)
    got = jax.jit(lambda sigmas: score_grid(scorer, matches, sigma=sigmas))(np.array([sigma, 9.0]))
    np.testing.assert_array_equal(np.isnan(got[0]), matches.mask.any(1))
    assert np.isfinite(got[1]).all()


def test_derivatives_are_those_of_all_bins(matches):
    """With respect to points, weights and sigma, under jit and vmap, for bins that are searched."""
    scorer = HistogramOfShifts(max_bins=136)

    def of_grid(sigma, points1, scores0):
        moved = replace(matches, points1=points1, scores0=scores0)
        return jnp.sum(score_grid(scorer, moved, sigma=sigma[None], bin_size=jnp.array([5.0])))

    @jax.jit
    def of_pairs(sigma, points1, scores0):
        moved = replace(matches, points1=points1, scores0=scores0)
        return jnp.sum(jax.vmap(replace(scorer, sigma=sigma, bin_size=5.0))(moved))

    inputs = jnp.float32(12.0), jnp.asarray(matches.points1), jnp.asarray(matches.scores0)
    got, expected = (jax.jit(jax.grad(f, argnums=(0, 1, 2)))(*inputs) for f in (of_grid, of_pairs))
    for gradient, of_all_bins in zip(got, expected, strict=True):
        assert np.isfinite(gradient).all()
        np.testing.assert_allclose(gradient, of_all_bins, rtol=2e-5, atol=1e-6)
    sigmas = jnp.array([7.0, 12.0])
    batched = jax.jit(jax.vmap(lambda sigma: of_grid(sigma, *inputs[1:])))(sigmas)
    np.testing.assert_allclose(batched, [of_pairs(sigma, *inputs[1:]) for sigma in sigmas], rtol=2e-6)


@pytest.mark.parametrize(
    "options",
    [{"bin_size": size, "max_bins": 136} for size in (0.0, -5.0, np.nan)]
    + [{"shift_range": (-5.0, 5.0), "align": "zero_center"}, {"truncate": np.nan}, {"sigma": 0.0}, {"sigma": -5.0}],
    ids=str,
)
def test_numbers_without_meaning_score_nan(matches, options):
    """Traced, where nothing can raise; XLA's maximum over thousands of bins on a CPU would skip NaN."""
    traced = {name: np.asarray(number) for name, number in options.items() if isinstance(number, float | tuple)}
    scorer = HistogramOfShifts(**{"max_bins": 45} | {name: options[name] for name in options if name not in traced})
    got = jax.jit(lambda traced: score_candidates(replace(scorer, **traced), matches))(traced)
    np.testing.assert_array_equal(np.isnan(got), matches.mask.any(1))


@pytest.mark.parametrize(("options", "bins"), [({"bin_size": 1e8}, (1, 1)), ({"shift_range": (0.0, 30.0)}, (1, 4))])
def test_there_is_always_a_bin(matches, options, bins):
    scorer = HistogramOfShifts(**options)
    assert np.isfinite(score_candidates(scorer, matches)).all()
    got = scorer.histogram(pair_of(matches))
    assert (len(got.centers_x), len(got.centers_y)) == (max(bins), max(bins))
    assert np.isfinite(got.scores).sum() == bins[0] * bins[1]


def test_bins_of_an_infinite_shift_are_no_numbers(matches):
    pair = pair_of(matches)
    points = pair.points1.copy()
    points[np.flatnonzero(pair.mask)[0]] = np.inf
    assert np.isnan(HistogramOfShifts().histogram(replace(pair, points1=points)).scores).all()
