"""Scores of shortlists: balanced, fused with the retrieval and over scales."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mfvpr import Shortlist, balancing_c, combine, rank
from mfvpr.evaluation import Fusion
from mfvpr.evaluation.rankings import fuse, fuse_scales, fuse_shortlist, retrieval_scores
from tests import oracles

pytestmark = pytest.mark.thorough

ROUGH = st.one_of(
    st.sampled_from([0.0, 0.1, 3.0, np.nan, np.inf, -np.inf]), st.floats(-1e3, 1e3, width=16, allow_subnormal=False)
)


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
