"""Fusion and ranking."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mfvpr import balancing_c, combine, rank, rerank
from mfvpr.reranking import fuse
from tests import oracles


@given(st.lists(st.sampled_from([0.0, 1.0, 2.5, -1.0, np.nan, np.inf, -np.inf]), min_size=1, max_size=12), st.data())
def test_rank_is_stable_with_nan_and_masked_last(scores, data):
    mask = data.draw(st.lists(st.booleans(), min_size=len(scores), max_size=len(scores)))
    got = rank(jnp.array(scores, jnp.float32), jnp.array(mask))
    assert got.dtype == jnp.int32
    assert list(np.asarray(got)) == oracles.rank(scores, mask)


def test_rank_takes_batches_and_defaults_to_no_mask():
    scores = jnp.array([[1.0, 3.0, 2.0], [5.0, 5.0, 9.0]])
    np.testing.assert_array_equal(rank(scores), [[1, 2, 0], [2, 0, 1]])
    ranking = rerank(scores)
    np.testing.assert_array_equal(ranking.order, rank(scores))
    np.testing.assert_array_equal(ranking.scores, scores)


def test_ties_may_go_by_index_instead():
    scores = jnp.array([[1.0, 2.0, 2.0, np.nan, 1.0]])
    index = jnp.array([[7, 9, 3, 1, 5]])
    np.testing.assert_array_equal(rank(scores), [[1, 2, 0, 4, 3]])
    np.testing.assert_array_equal(rank(scores, tie_break=index), [[2, 1, 4, 0, 3]])


def test_combined_score_spans_plain_to_filter_order():
    rng = np.random.default_rng(1)
    filter_scores, scores = jnp.array(rng.random(20), jnp.float32), jnp.array(rng.random(20), jnp.float32)
    np.testing.assert_array_equal(rank(combine(filter_scores, scores, c=0.0)), rank(scores))
    np.testing.assert_array_equal(rank(combine(filter_scores, scores)), rank(filter_scores))
    np.testing.assert_allclose(combine(filter_scores, scores, c=3.0), oracles.combine(filter_scores, scores, 3.0), 1e-6)


def test_balancing_c_equalizes_the_spread_of_real_candidates():
    filter_scores = jnp.array([0.5, 0.7, 0.9, 77.0])
    scores = jnp.array([10.0, 50.0, 30.0, np.nan])
    mask = jnp.array([True, True, True, False])
    c = balancing_c(filter_scores, scores, mask)
    np.testing.assert_allclose(c * np.std(filter_scores[:3]), np.std(scores[:3]), rtol=1e-6)
    assert balancing_c(jnp.ones(4), scores, mask) == 0.0


def test_a_score_that_is_no_number_takes_no_part_in_the_balance():
    """Its candidate is there: neither its score nor the filter's similarity to it may matter to the others."""
    filter_scores, mask = jnp.array([0.5, 0.7, 0.9, 0.1]), jnp.ones(4, bool)
    for broken in (np.nan, np.inf):
        c = balancing_c(filter_scores, jnp.array([10.0, 50.0, 30.0, broken]), mask)
        expected = np.std([10.0, 50.0, 30.0]) / np.std(np.array([0.5, 0.7, 0.9, 0.1]))
        np.testing.assert_allclose(c, expected, rtol=1e-6)
    assert balancing_c(filter_scores, jnp.full(4, jnp.nan), mask) == 0.0


def test_balanced_fusion_has_a_gradient_where_all_scores_are_equal():
    filter_scores, mask = jnp.array([[0.5, 0.7], [0.3, 0.3]]), jnp.ones((2, 2), bool)
    total = lambda scores: jnp.sum(fuse(filter_scores, scores, mask, None) ** 2)  # noqa: E731
    for scores in (jnp.full((2, 2), 3.0), jnp.array([[1.0, 2.0], [4.0, 4.0]])):
        assert np.isfinite(jax.grad(total)(scores)).all()


def test_fusion_and_ranking_compile_once_for_all_callers(compilations):
    scores, mask = jnp.ones((2, 4)), jnp.ones((2, 4), bool)
    for _ in range(2):
        rank(fuse(scores, scores, mask, None), mask, tie_break=jnp.arange(8).reshape(2, 4))
        rank(fuse(scores, scores, mask, 0.5), mask)
        compiled, compilations.count = compilations.count, 0
    assert compiled == 0


def test_whole_numbers_are_ranked_as_they_are():
    np.testing.assert_array_equal(rank(jnp.array([2**24, 2**24 + 1, 7])), [1, 0, 2])
