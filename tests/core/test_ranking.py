"""Combination and ranking."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mfvpr import combine, rank, rerank
from tests import oracles

pytestmark = pytest.mark.thorough


@given(st.lists(st.sampled_from([0.0, 1.0, 2.5, -1.0, np.nan, np.inf, -np.inf]), min_size=1, max_size=12), st.data())
def test_rank_is_stable_with_nan_and_masked_last(scores, data):
    mask = data.draw(st.lists(st.booleans(), min_size=len(scores), max_size=len(scores)))
    got = rank(jnp.array(scores, jnp.float32), jnp.array(mask))
    assert got.dtype == jnp.int32
    assert list(np.asarray(got)) == oracles.rank(scores, mask)


def test_rerank_takes_batches_and_defaults_to_no_mask():
    scores = jnp.array([[1.0, 3.0, 2.0], [5.0, 5.0, 9.0]])
    ranking = rerank(scores)
    np.testing.assert_array_equal(ranking.order, [[1, 2, 0], [2, 0, 1]])
    np.testing.assert_array_equal(ranking.scores, scores)


def test_ties_may_go_by_index_instead():
    scores = jnp.array([[1.0, 2.0, 2.0, np.nan, 1.0]])
    index = jnp.array([[7, 9, 3, 1, 5]])
    np.testing.assert_array_equal(rank(scores), [[1, 2, 0, 4, 3]])
    np.testing.assert_array_equal(rank(scores, tie_break=index), [[2, 1, 4, 0, 3]])
    large = np.array([[7, 9, 3, 1, 5]]) + 2**32 * np.array([[0, 0, 1, 0, 0]])
    np.testing.assert_array_equal(rank(scores, tie_break=large), [[1, 2, 4, 0, 3]])


def test_combined_score_spans_plain_to_retrieval_order():
    rng = np.random.default_rng(1)
    retrieval_scores, scores = jnp.array(rng.random(20), jnp.float32), jnp.array(rng.random(20), jnp.float32)
    np.testing.assert_array_equal(rank(combine(retrieval_scores, scores, c=0.0)), rank(scores))
    np.testing.assert_array_equal(rank(combine(retrieval_scores, scores)), rank(retrieval_scores))
    expected = 3.0 * np.asarray(retrieval_scores, float) + np.asarray(scores, float)
    np.testing.assert_allclose(combine(retrieval_scores, scores, c=3.0), expected, 1e-6)


def test_double_precision_is_ranked_as_it_is():
    scores = np.array([1.0, 1 + 1e-9, np.nan, 1.0, 3e300])
    np.testing.assert_array_equal(rank(scores), [4, 1, 0, 3, 2])
    np.testing.assert_array_equal(rank(scores[:2]), [1, 0])


@pytest.mark.parametrize("dtype", [np.uint8, np.int8, np.uint32, np.int32, np.uint64, np.int64, np.bool_])
def test_whole_numbers_are_ranked_as_they_are(dtype):
    np.testing.assert_array_equal(rank(jnp.array([2**24, 2**24 + 1, 7])), [1, 0, 2])  # not as float32
    low, high = (False, True) if dtype is np.bool_ else (np.iinfo(dtype).min, np.iinfo(dtype).max)
    scores, mask = np.array([low, high, 1, low, high], dtype), np.array([True, True, True, True, False])
    expected = sorted(range(5), key=lambda row: (not mask[row], -int(scores[row])))
    np.testing.assert_array_equal(rank(scores, mask), expected)
