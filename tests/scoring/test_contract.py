"""What every scorer promises, whatever it computes."""

from dataclasses import fields, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mfvpr import AggregatedScore, AnchorPoints, HistogramOfShifts, MatchCount, Matches, UnitWeight, score_candidates
from tests.builders import make_matches, per_match, random_matches

ALL_SCORERS = [
    HistogramOfShifts(),
    HistogramOfShifts(bin_size=20.0, sigma=12.0, truncate=3.0, align="zero_center", weight=UnitWeight()),
    HistogramOfShifts(shift_range=(100.0, 50.0), align="zero_edge", direction="query_minus_candidate"),
    AnchorPoints(),
    AnchorPoints(window_mode="asymmetric", first="candidate", cell_weight="cell_sum", include_self=False),
    AnchorPoints(window_mode="odd_down", cell_weight="ones", tolerance=1.5),
    AggregatedScore(),
    AggregatedScore(mean="weighted", clamp=True),
    AggregatedScore(mean="median"),
    MatchCount(),
    HistogramOfShifts(temperature=0.05),
    AnchorPoints(num_bins=8, temperature=0.2),
    AggregatedScore(mean="weighted", clamp=True, temperature=30.0),
]
scorers = pytest.mark.parametrize("scorer", ALL_SCORERS, ids=lambda s: f"{type(s).__name__}")
score = jax.jit(lambda scorer, matches: scorer(matches))  # once per shape: hence 60 slots wherever possible
score_all = jax.jit(score_candidates)
gradients = jax.jit(jax.grad(lambda scorer, inputs, mask: scorer(Matches(mask=mask, **inputs)), argnums=(0, 1)))


def stack(items):
    return jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf) for leaf in leaves]), *items)


@scorers
def test_scalar_float32_and_exactly_zero_without_matches(scorer):
    nothing = score(scorer, random_matches(np.random.default_rng(0), 0, capacity=60))
    assert nothing.shape == ()
    assert nothing.dtype == jnp.float32
    assert nothing == 0.0
    assert score(scorer, random_matches(np.random.default_rng(0), 40, capacity=60)) > 0


@scorers
@pytest.mark.parametrize("garbage", [np.nan, np.inf, -1e30, 7.0])
def test_padding_never_matters(scorer, garbage):
    tight = random_matches(np.random.default_rng(1), 60)
    loose = random_matches(np.random.default_rng(1), 60, capacity=90, garbage=garbage)
    np.testing.assert_allclose(score(scorer, loose), score(scorer, tight), rtol=2e-6)


@scorers
def test_order_of_matches_does_not_matter(scorer):
    matches = random_matches(np.random.default_rng(2), 60)
    order = np.random.default_rng(3).permutation(60)
    shuffled = per_match(matches, lambda rows: rows[order])
    np.testing.assert_allclose(score(scorer, shuffled), score(scorer, matches), rtol=2e-6)


@scorers
@pytest.mark.parametrize("batch", [1, 2, 5])
def test_batch_equals_loop_and_neighbors_do_not_matter(scorer, batch):
    rng = np.random.default_rng(4)
    pairs = [random_matches(rng, count, capacity=60) for count in (0, 1, 60, 13, 37)[-batch:]]
    loop = [score(scorer, pair) for pair in pairs]
    np.testing.assert_allclose(score_all(scorer, stack(pairs)), loop, rtol=2e-6, atol=0)


@scorers
def test_one_trace_serves_all_parameter_values(scorer):
    traces = []

    @jax.jit
    def score(scorer, matches):
        traces.append(1)
        return scorer(matches)

    matches = random_matches(np.random.default_rng(5), 30)
    eager, compiled = scorer(matches), score(scorer, matches)
    np.testing.assert_allclose(compiled, eager, rtol=2e-6)
    for factor in (1.1, 1.3):
        changed = jax.tree.map(lambda value, factor=factor: value * factor, scorer)
        np.testing.assert_allclose(score(changed, matches), changed(matches), rtol=2e-6)
    assert len(traces) == 1


@scorers
@pytest.mark.parametrize("count", [0, 1, 25])
def test_gradients_are_finite(scorer, count):
    matches = random_matches(np.random.default_rng(6), count, capacity=60)
    inputs = {f.name: getattr(matches, f.name) for f in fields(matches) if f.name != "mask"}
    for gradient in jax.tree.leaves(gradients(jax.tree.map(float, scorer), inputs, matches.mask)):
        assert np.isfinite(gradient).all()


@scorers
def test_gradients_agree_with_finite_differences(scorer):
    """Along a random direction of weights and distances, where every score is smooth."""
    matches = random_matches(np.random.default_rng(7), 20)
    direction = np.random.default_rng(8).uniform(-1, 1, (3, 20)).astype(np.float32)
    start = jnp.stack([matches.distance, matches.scores0, matches.scores1])

    @jax.jit
    def along(step):
        distance, scores0, scores1 = start + step * direction
        return scorer(replace(matches, distance=distance, scores0=scores0, scores1=scores1))

    step = 2e-3
    numeric = (along(step) - along(-step)) / (2 * step)
    scale = abs(float(along(0.0))) + 1e-3
    np.testing.assert_allclose(jax.grad(along)(0.0) / scale, numeric / scale, atol=2e-3)


@scorers
def test_a_masked_pair_may_have_any_size(scorer):
    rng = np.random.default_rng(9)
    pair, empty = random_matches(rng, 60), random_matches(rng, 0, capacity=60)
    empty = replace(empty, image_size0=np.full(2, np.nan, np.float32), image_size1=np.zeros(2, np.float32))
    scorer = jax.tree.map(float, scorer)
    scores = score_all(scorer, stack([pair, empty]))
    np.testing.assert_allclose(scores[0], score(scorer, pair), rtol=2e-6)
    assert scores[1] == 0.0
    for gradient in jax.tree.leaves(jax.jit(jax.grad(score))(scorer, empty)):
        assert np.isfinite(gradient).all()


@scorers
@pytest.mark.parametrize("candidates", [0, 3])
def test_no_slots_and_no_candidates(scorer, candidates):
    pair = per_match(make_matches([], []), lambda rows: rows[:0])
    assert score(scorer, pair) == 0.0
    batch = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (candidates, *leaf.shape)), pair)
    assert score_all(scorer, batch).shape == (candidates,)


@scorers
def test_integers_and_double_precision_mode_are_welcome(scorer):
    matches = random_matches(np.random.default_rng(10), 60)
    matches = replace(matches, points0=matches.points0.round(), points1=matches.points1.round())
    integers = replace(matches, **{n: getattr(matches, n).astype(np.int32) for n in ("points0", "image_size0")})
    expected = score(scorer, matches)
    np.testing.assert_allclose(score(scorer, integers), expected, rtol=2e-6)
    with jax.enable_x64(True):
        got = score(scorer, jax.tree.map(jnp.asarray, matches))
        assert got.dtype == jnp.float32
        np.testing.assert_allclose(got, expected, rtol=2e-6)


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: HistogramOfShifts(align="zero_centre"),
        lambda: HistogramOfShifts(direction="x"),
        lambda: AnchorPoints(window_mode="x"),
        lambda: AnchorPoints(first="reference"),
        lambda: AnchorPoints(cell_weight="x"),
        lambda: AggregatedScore(mean="medain"),
    ],
)
def test_misspelt_choices_are_refused(wrong):
    with pytest.raises(ValueError, match="expected one of"):
        wrong()


def test_positions_of_the_arguments_are_the_papers_order():
    assert HistogramOfShifts(10.0, 5.0, UnitWeight()) == HistogramOfShifts(
        bin_size=10.0, sigma=5.0, weight=UnitWeight()
    )
    assert AnchorPoints(12, 8, 2.0, UnitWeight()) == AnchorPoints(
        num_bins=12, window=8, tolerance=2.0, weight=UnitWeight()
    )
