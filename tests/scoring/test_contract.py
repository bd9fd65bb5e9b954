"""What every scorer promises, whatever it computes."""

from dataclasses import fields, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mfvpr import AggregatedScore, AnchorPoints, HistogramOfShifts, MatchCount, UnitWeight, score_candidates
from tests.builders import make_matches, random_matches

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
]
scorers = pytest.mark.parametrize("scorer", ALL_SCORERS, ids=lambda s: f"{type(s).__name__}")


def stack(items):
    return jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf) for leaf in leaves]), *items)


@scorers
def test_scalar_float32_and_exactly_zero_without_matches(scorer):
    empty = make_matches([], [], capacity=8)
    score = scorer(empty)
    assert score.shape == ()
    assert score.dtype == jnp.float32
    assert score == 0.0
    assert scorer(random_matches(np.random.default_rng(0), 40)) > 0


@scorers
@pytest.mark.parametrize("garbage", [np.nan, np.inf, -1e30, 7.0])
def test_padding_never_matters(scorer, garbage):
    tight = random_matches(np.random.default_rng(1), 60)
    loose = random_matches(np.random.default_rng(1), 60, capacity=90, garbage=garbage)
    np.testing.assert_allclose(scorer(loose), scorer(tight), rtol=2e-6)


@scorers
def test_order_of_matches_does_not_matter(scorer):
    matches = random_matches(np.random.default_rng(2), 70)
    order = np.random.default_rng(3).permutation(70)
    per_match = {f.name: getattr(matches, f.name)[order] for f in fields(matches) if "size" not in f.name}
    np.testing.assert_allclose(scorer(replace(matches, **per_match)), scorer(matches), rtol=2e-6)


@scorers
@pytest.mark.parametrize("batch", [1, 2, 7])
def test_batch_equals_loop_and_neighbors_do_not_matter(scorer, batch):
    rng = np.random.default_rng(4)
    pairs = [random_matches(rng, count, capacity=50) for count in (0, 1, 50, 13, 2, 37, 44)[:batch]]
    np.testing.assert_allclose(
        score_candidates(scorer, stack(pairs)), [scorer(pair) for pair in pairs], rtol=2e-6, atol=0
    )


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
    for factor in (0.7, 1.3):
        changed = jax.tree.map(lambda value, factor=factor: value * factor, scorer)
        changed = replace(changed, bin_size=scorer.bin_size * 1.1) if hasattr(scorer, "bin_size") else changed
        np.testing.assert_allclose(score(changed, matches), changed(matches), rtol=2e-6)
    assert len(traces) <= 2  # a window given as an int becomes a float: another dtype, not another value


@scorers
@pytest.mark.parametrize("count", [0, 1, 25])
def test_gradients_are_finite(scorer, count):
    matches = random_matches(np.random.default_rng(6), count, capacity=30)
    inputs = {f.name: getattr(matches, f.name) for f in fields(matches) if f.name != "mask"}

    def score(scorer, inputs):
        return scorer(replace(matches, **inputs))

    scorer = jax.tree.map(float, scorer)
    for gradient in jax.tree.leaves(jax.grad(score, argnums=(0, 1))(scorer, inputs)):
        assert np.isfinite(gradient).all()
