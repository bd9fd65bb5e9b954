"""Fusion and ranking."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mfvpr import HistogramOfShifts, Shortlist, balancing_c, combine, rank, rerank, score_candidates
from mfvpr.core import fuse_scales
from mfvpr.core.ranking import fuse, fuse_shortlist, retrieval_scores
from mfvpr.evaluation import Fusion
from tests import oracles
from tests.builders import random_matches, stack

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


@pytest.mark.parametrize("other", [5.0, 1e9, np.nan])
def test_sizes_of_pairs_without_matches_may_be_anything(other):
    pair = random_matches(np.random.default_rng(0), 9)
    size = np.full(2, other, np.float32)
    empty = replace(pair, mask=np.zeros_like(pair.mask), image_size0=size, image_size1=size)
    score = HistogramOfShifts()(pair)
    for pairs, expected in (([pair, pair], [score, score]), ([pair, empty], [score, 0]), ([empty, empty], [0, 0])):
        np.testing.assert_allclose(score_candidates(HistogramOfShifts(), stack(pairs)), expected, rtol=1e-6)


def test_combined_score_spans_plain_to_retrieval_order():
    rng = np.random.default_rng(1)
    retrieval_scores, scores = jnp.array(rng.random(20), jnp.float32), jnp.array(rng.random(20), jnp.float32)
    np.testing.assert_array_equal(rank(combine(retrieval_scores, scores, c=0.0)), rank(scores))
    np.testing.assert_array_equal(rank(combine(retrieval_scores, scores)), rank(retrieval_scores))
    expected = 3.0 * np.asarray(retrieval_scores, float) + np.asarray(scores, float)
    np.testing.assert_allclose(combine(retrieval_scores, scores, c=3.0), expected, 1e-6)


@pytest.mark.parametrize("kind", [np.uint8, np.int32, np.float16, jnp.bfloat16])
@pytest.mark.parametrize("array", [np.array, jnp.array])
def test_scores_of_few_bits_are_combined_in_single_precision(array, kind):
    """Also whole numbers, whose products and squares would overflow."""
    retrieval_scores, scores = array([[100, 200, 96]], kind), array([[250, 10, 240]], kind)
    wide = [jnp.asarray(values, jnp.float32) for values in (retrieval_scores, scores)]
    np.testing.assert_array_equal(combine(retrieval_scores, scores, c=1000), combine(*wide, c=1000.0))
    mask = np.ones((1, 3), bool)
    c = balancing_c(retrieval_scores[0], scores[0], mask[0])
    np.testing.assert_allclose(c, np.std(wide[1]) / np.std(wide[0]), rtol=1e-5)
    if not jnp.issubdtype(kind, jnp.floating):
        return  # no scores of a shortlist
    candidates = Shortlist(np.arange(3)[None], np.asarray(retrieval_scores), mask)
    for fusion in (Fusion(1000.0), Fusion(), Fusion("zscore")):
        expected = fusion("it", replace(candidates, scores=np.asarray(wide[0])), {"it": np.asarray(wide[1])})
        np.testing.assert_allclose(fusion("it", candidates, {"it": np.asarray(scores)}), expected, rtol=1e-5)


def test_padding_is_no_similarity():
    candidates = Shortlist(np.array([[3, -1]]), np.array([[0.5, 99.0]], np.float32), np.array([[True, False]]))
    assert retrieval_scores(candidates, "negative_euclidean")[0, 0] == -1


def test_balancing_c_equalizes_the_spread_of_real_candidates():
    retrieval_scores = jnp.array([0.5, 0.7, 0.9, 77.0])
    scores = jnp.array([10.0, 50.0, 30.0, np.nan])
    mask = jnp.array([True, True, True, False])
    c = balancing_c(retrieval_scores, scores, mask)
    np.testing.assert_allclose(c * np.std(retrieval_scores[:3]), np.std(scores[:3]), rtol=1e-6)
    assert balancing_c(jnp.ones(4), scores, mask) == 0.0


def test_a_score_that_is_no_number_takes_no_part_in_the_balance():
    retrieval_scores, mask = jnp.array([0.5, 0.7, 0.9, 0.1]), jnp.ones(4, bool)
    expected = np.std([10.0, 50.0, 30.0]) / np.std(retrieval_scores[:3])  # without its candidate
    for broken in (np.nan, np.inf):
        c = balancing_c(retrieval_scores, jnp.array([10.0, 50.0, 30.0, broken]), mask)
        np.testing.assert_allclose(c, expected, rtol=1e-6)
        c = balancing_c(retrieval_scores.at[3].set(broken), jnp.array([10.0, 50.0, 30.0, 20.0]), mask)
        np.testing.assert_allclose(c, expected, rtol=1e-6)
    assert balancing_c(retrieval_scores, jnp.full(4, jnp.nan), mask) == 0.0


def test_balanced_fusion_has_a_gradient_where_all_scores_are_equal():
    retrieval_scores, mask = jnp.array([[0.5, 0.7], [0.3, 0.3]]), jnp.ones((2, 2), bool)
    total = lambda scores: jnp.sum(fuse(retrieval_scores, scores, mask, None) ** 2)  # noqa: E731
    for scores in (jnp.full((2, 2), 3.0), jnp.array([[1.0, 2.0], [4.0, 4.0]])):
        assert np.isfinite(jax.grad(total)(scores)).all()


def test_fusion_and_ranking_compile_once_for_all_callers(compilations):
    scores, mask = jnp.ones((2, 4)), jnp.ones((2, 4), bool)
    for _ in range(2):
        rank(fuse(scores, scores, mask, None), mask, tie_break=jnp.arange(8).reshape(2, 4))
        rank(fuse(scores, scores, mask, 0.5), mask)
        compiled, compilations.count = compilations.count, 0
    assert compiled == 0


@pytest.mark.parametrize("dtype", [np.uint8, np.int8, np.uint32, np.int32, np.uint64, np.int64, np.bool_])
def test_whole_numbers_are_ranked_as_they_are(dtype):
    np.testing.assert_array_equal(rank(jnp.array([2**24, 2**24 + 1, 7])), [1, 0, 2])  # not as float32
    low, high = (False, True) if dtype is np.bool_ else (np.iinfo(dtype).min, np.iinfo(dtype).max)
    scores, mask = np.array([low, high, 1, low, high], dtype), np.array([True, True, True, True, False])
    expected = sorted(range(5), key=lambda row: (not mask[row], -int(scores[row])))
    np.testing.assert_array_equal(rank(scores, mask), expected)


ROUGH = st.one_of(
    st.sampled_from([0.0, 0.1, 3.0, np.nan, np.inf, -np.inf]), st.floats(-1e3, 1e3, width=16, allow_subnormal=False)
)


@pytest.mark.parametrize("normalize", ["zscore", "none"])
@given(data=st.data())
def test_scales_are_fused_as_in_patch_netvlad(normalize, data):
    scores = np.array(data.draw(st.lists(ROUGH, min_size=12, max_size=12)), np.float32).reshape(4, 3)
    mask = np.array(data.draw(st.lists(st.booleans(), min_size=4, max_size=4)))
    weights = (0.45, 0.15, 0.4)
    with np.errstate(invalid="ignore"):
        expected = oracles.fuse_scales(scores, mask, weights, normalize)
    got = fuse_scales(scores, mask, np.array(weights, np.float32), normalize=normalize)
    np.testing.assert_allclose(got, expected, rtol=2e-4, atol=2e-4)


def test_no_score_is_no_fault_of_a_program():
    scores, mask = np.ones((3, 2), np.float32), np.array([True, True, False])
    with jax.debug_nans(True):
        np.testing.assert_array_equal(fuse_scales(scores, mask), [0, 0, np.nan])
        candidates = Shortlist(np.array([[0, -1]]), np.array([[0.5, np.nan]], np.float32), np.array([[True, False]]))
        fused = fuse_shortlist(candidates, np.array([[2, np.nan]], np.float32), 4.0)
        np.testing.assert_array_equal(fused, [[4, np.nan]])


def test_a_scale_without_weight_takes_no_part_and_no_candidates_have_no_score():
    scores, mask = np.array([[np.inf, 1], [1, 2], [3, np.nan]], np.float32), np.array([True, True, False])
    for weight in (1, -2):
        fused = fuse_scales(scores, mask, np.array([0, weight], np.float32), normalize="none")
        np.testing.assert_array_equal(fused, [weight, 2 * weight, np.nan])
    assert fuse_scales(np.zeros((0, 2), np.float32), np.zeros(0, bool)).shape == (0,)


@pytest.mark.optimized
def test_scales_of_equal_scores_say_nothing():
    """Whatever rounding makes of the mean of equal scores."""
    scores = np.stack([np.full(49, 0.1), np.random.default_rng(0).random(49)], axis=-1).astype(np.float32)
    mask = np.ones(49, bool)
    np.testing.assert_array_equal(fuse_scales(scores, mask), fuse_scales(scores[:, 1:], mask))
    np.testing.assert_array_equal(fuse_scales(scores[:, :1], mask), np.zeros(49))


def test_queries_and_settings_are_fused_one_by_one():
    rng = np.random.default_rng(0)
    scores, mask = rng.random((2, 3, 6, 4)).astype(np.float32), rng.random((3, 6)) < 0.7
    got = fuse_scales(scores, mask)
    for setting, query in np.ndindex(2, 3):
        expected = oracles.fuse_scales(scores[setting, query], mask[query], np.ones(4), "zscore")
        np.testing.assert_allclose(got[setting, query], expected, rtol=1e-5, atol=1e-5)


def test_fused_scales_have_a_gradient_where_scores_are_equal_or_missing():
    mask = np.array([True, True, True, True, False])
    equal, unequal = np.full(5, 2.0), np.array([1.0, np.nan, 4.0, 2.0, np.nan])

    def total(scores):
        fused = fuse_scales(scores, mask)
        return jnp.sum(jnp.where(jnp.isfinite(fused), fused, 0.0) ** 3)  # the sum of squares is their number

    for scores in (np.stack([equal, equal], 1), np.stack([equal, unequal], 1)):
        slope = jax.grad(total)(jnp.asarray(scores, jnp.float32))
        assert np.isfinite(slope).all()
    assert np.abs(slope[[0, 2, 3], 1]).min() > 0.05


@pytest.mark.parametrize("unit", [1e-30, 1e-20, 1.0, 3e19, 1e30])
def test_z_scores_have_no_unit(unit):
    scores = np.array([1.0, 4.0, 2.0, 0.5]) * unit
    expected = (scores - scores.mean()) / scores.std()
    fused = fuse_scales(jnp.asarray(scores[:, None], jnp.float32), np.ones(4, bool))
    np.testing.assert_allclose(fused, expected, rtol=1e-5)
