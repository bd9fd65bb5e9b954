"""Final scores: fused with retrieval, over scales and scorers, correlated with frames before, and ranked."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import mfvpr
from mfvpr import balancing_c, combine
from mfvpr.core.types import Shortlist
from mfvpr.evaluation import FrameCorrelation, Fusion, match_sequence, stages
from mfvpr.evaluation.rankings import fuse_scales, rank_by_scores, rank_shortlist, retrieval_scores
from mfvpr.utils import InputError
from tests import oracles
from tests.evaluation.conftest import SCORERS, SIFT, VLAD

pytestmark = pytest.mark.thorough

BOTH = Fusion("zscore", weights={"retrieval": 0.5, "count": 2.0})


def random_scores(num_queries=6, num_candidates=9):
    """A shortlist with rows that are not full, and scores of two scorers in units of their own."""
    rng = np.random.default_rng(0)
    mask = np.arange(num_candidates) < rng.integers(2, num_candidates + 1, (num_queries, 1))
    rows = rng.permuted(np.tile(np.arange(num_candidates), (num_queries, 1)), axis=1)
    cosine = -np.sort(-rng.random((num_queries, num_candidates)), axis=1)
    scores = {
        name: np.where(mask, unit * rng.random(mask.shape), np.nan).astype(np.float32)
        for name, unit in (("a", 3e4), ("b", 2e-3))
    }
    return Shortlist(np.where(mask, rows, -1), np.where(mask, cosine, 0).astype(np.float32), mask), scores


def assert_fused(fused, candidates, parts, weights):
    """The scores are those of the oracle, in float64, query by query."""
    stacked = np.stack(parts, axis=-1).astype(np.float64)
    for query, mask in enumerate(candidates.mask):
        expected = oracles.fuse_scales(stacked[query], mask, weights)
        np.testing.assert_allclose(fused[query], expected, rtol=1e-4, atol=1e-4)


def test_standardized_scores_are_summed():
    candidates, scores = random_scores()
    fused = Fusion("zscore", weights={"retrieval": 0.5, "a": 3.0, "b": 0.25})("a", candidates, scores)
    assert fused.dtype == np.float32
    assert_fused(fused, candidates, [candidates.scores, scores["a"], scores["b"]], [0.5, 3.0, 0.25])
    fused = Fusion("zscore", "negative_euclidean", {"a": 3.0})("a", candidates, scores)  # retrieval counts 1
    distance = -np.sqrt(2 - 2 * candidates.scores.astype(np.float64))
    assert_fused(fused, candidates, [distance, scores["a"]], [1.0, 3.0])


def test_the_distance_of_a_cosine_that_rounding_lifts_above_1_is_0():
    candidates = Shortlist(np.array([[4, 2]]), np.float32([[1.0009, 0.5]]), np.ones((1, 2), bool))
    np.testing.assert_allclose(retrieval_scores(candidates, "negative_euclidean"), [[0, -1]], atol=1e-6)


@pytest.mark.parametrize("unit", ["a", "b"])
def test_it_ranks_as_a_balanced_c_and_has_no_unit(unit):
    candidates, scores = random_scores()
    fused = Fusion("zscore")(unit, candidates, scores)
    balanced = Fusion()(unit, candidates, scores)
    np.testing.assert_array_equal(rank_shortlist(candidates, fused), rank_shortlist(candidates, balanced))
    by_query = np.arange(1, 1 + len(fused))[:, None]  # other units for every query
    scaled = Fusion("zscore")(unit, candidates, {unit: 100 * by_query * scores[unit] - 7 * by_query})
    np.testing.assert_allclose(scaled, fused, rtol=1e-3, atol=1e-3)


def test_equal_scores_say_nothing_and_equal_sums_keep_their_order():
    candidates = Shortlist(np.array([[7, 3, 5]]), np.full((1, 3), 0.1, np.float32), np.ones((1, 3), bool))
    score = np.array([[1.0, 2.0, 2.0]], np.float32)
    got = Fusion("zscore")("a", candidates, {"a": score})
    np.testing.assert_allclose(got, (score - score.mean()) / score.std(), rtol=1e-6)
    assert rank_shortlist(candidates, got).tolist() == [[1, 2, 0]]
    equal = Fusion("zscore")("a", candidates, {"a": np.full((1, 3), 0.3, np.float32)})
    np.testing.assert_array_equal(equal, np.zeros((1, 3)))
    assert rank_shortlist(candidates, equal).tolist() == [[0, 1, 2]]
    assert rank_shortlist(candidates, equal, ties="index").tolist() == [[1, 2, 0]]


@pytest.fixture(scope="module")
def sequence_matches(dataset):
    return match_sequence(dataset, dataset.only, mfvpr.Pipeline(SIFT, VLAD, candidates=5))


def rank_by(matched, fused, correlated):
    scores = stages.score(SCORERS, matched.by_scale, matched.candidates)
    system = mfvpr.System(mfvpr.Pipeline(SIFT, VLAD), SCORERS, fused, correlated)
    return rank_by_scores(matched.candidates, scores, system.final_scores.values(), "retrieval")


def test_systems_of_several_scores_are_ranked_beside_the_others(sequence_matches):
    fused = {"histogram": BOTH, "count": Fusion("zscore")}
    correlated = {"histogram + count + retrieval": FrameCorrelation(1)}
    systems = rank_by(sequence_matches, fused, correlated)
    assert [*systems] == ["retrieval", *SCORERS, "histogram + count + retrieval", "count + retrieval",
                          "histogram + count + retrieval + frames"]  # fmt: skip
    before, after = systems["histogram + count + retrieval"], systems["histogram + count + retrieval + frames"]
    expected = FrameCorrelation(1)(before.shortlist, before.scores)
    order = np.argsort(-expected, axis=1, kind="stable")
    np.testing.assert_array_equal(after.scores, np.take_along_axis(expected, order, axis=1))
    np.testing.assert_array_equal(after.rows, np.take_along_axis(before.rows, order, axis=1))
    assert (after.scores != before.scores).any()
    alone = rank_by(sequence_matches, {"count": Fusion()}, {})
    for name in ("retrieval", *SCORERS):
        np.testing.assert_array_equal(systems[name].scores, alone[name].scores)
    np.testing.assert_array_equal(systems["count + retrieval"].rows, alone["count + retrieval"].rows)

    by_row = {
        name: np.take_along_axis(system.scores, np.argsort(system.rows, axis=1), axis=1)
        for name, system in systems.items()
    }
    assert sequence_matches.candidates.mask.all()
    parts = [by_row[name] for name in ("retrieval", *SCORERS)]
    assert_fused(by_row["histogram + count + retrieval"], sequence_matches.candidates, parts, [0.5, 1.0, 2.0])


ROUGH = st.one_of(
    st.sampled_from([0.0, 0.1, 3.0, np.nan, np.inf, -np.inf]), st.floats(-1e3, 1e3, width=16, allow_subnormal=False)
)


@pytest.mark.parametrize(("array", "kind"), [(np.array, np.uint8), (jnp.array, np.int32), (np.array, jnp.bfloat16)])
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


def test_balancing_c_equalizes_the_spread_of_real_candidates_with_finite_scores():
    retrieval_scores, scores = jnp.array([0.5, 0.7, 0.9, 0.1]), jnp.array([10.0, 50.0, 30.0, 20.0])
    mask, expected = jnp.ones(4, bool), np.std([10.0, 50.0, 30.0]) / np.std(retrieval_scores[:3])
    cases = [(retrieval_scores, scores, mask.at[3].set(False))]
    for broken in (np.nan, np.inf):
        cases.append((retrieval_scores, scores.at[3].set(broken), mask))
        cases.append((retrieval_scores.at[3].set(broken), scores, mask))
    for case in cases:
        np.testing.assert_allclose(balancing_c(*case), expected, rtol=1e-6)
    assert balancing_c(retrieval_scores, jnp.full(4, jnp.nan), mask) == balancing_c(jnp.ones(4), scores, mask) == 0


@given(data=st.data())
def test_scales_are_fused_as_in_patch_netvlad(data):
    scores = np.array(data.draw(st.lists(ROUGH, min_size=12, max_size=12)), np.float32).reshape(4, 3)
    mask = np.array(data.draw(st.lists(st.booleans(), min_size=4, max_size=4)))
    weights = (0.45, 0.15, 0.4)
    with np.errstate(invalid="ignore"):
        expected = oracles.fuse_scales(scores, mask, weights)
    got = fuse_scales(scores, mask, np.array(weights, np.float32))
    np.testing.assert_allclose(got, expected, rtol=2e-4, atol=2e-4)


def test_a_scale_without_weight_takes_no_part_and_no_candidates_have_no_score():
    scores, mask = np.array([[np.inf, 1], [1, 3], [3, np.nan]], np.float32), np.array([True, True, False])
    np.testing.assert_allclose(fuse_scales(scores, mask, np.float32([0, -2])), [2, -2, np.nan], rtol=1e-6)
    assert fuse_scales(np.zeros((0, 2), np.float32), np.zeros(0, bool)).shape == (0,)


def by_loops(rows, scores, previous):
    """As published: the recognized places so far, and what each candidate gains by them."""
    places, weighted = [], []
    for query, (own_rows, own_scores) in enumerate(zip(rows, scores, strict=True)):
        new = []
        for row, score in zip(own_rows, own_scores, strict=True):
            gain = 0.0
            if query >= previous:
                last = places[-previous:]
                best = max(score for _, score in last)
                for place, of_place in last:
                    strength = 1 if previous == 1 or best == 0 else of_place / best
                    if place is not None and abs(row - place) <= 15:
                        gain = max(gain, strength * (0.4 / 15 * (15 - abs(row - place))))
            new.append(score * (1 + gain) if row >= 0 and score > 0 else score)
        usable = [(-score, row) for row, score in zip(own_rows, new, strict=True) if row >= 0 and score > 0]
        score, row = min(usable, default=(0, None))
        places.append((row, -score))
        weighted.append(new)
    return weighted


def drive(seed, queries=40, candidates=6, database=50):
    rng = np.random.default_rng(seed)
    rows = np.array([rng.permutation(database)[:candidates] for _ in range(queries)], np.int32)
    scores = rng.integers(0, 5, rows.shape).astype(np.float32) * 10  # with ties
    rows[rng.random(rows.shape) < 0.1] = -1
    scores[5:8] = 0
    scores[11] = -scores[11]
    return Shortlist(rows, np.zeros(rows.shape, np.float32), rows >= 0), scores


@pytest.mark.parametrize("previous", [1, 2, 5])
@pytest.mark.parametrize("seed", range(3))
def test_agrees_with_the_loop(seed, previous):
    candidates, scores = drive(seed)
    got = FrameCorrelation(previous)(candidates, scores)
    np.testing.assert_allclose(got, by_loops(candidates.indices, scores, previous), rtol=1e-6)
    assert (got[candidates.mask & (scores > 0)] > scores[candidates.mask & (scores > 0)]).any()
    np.testing.assert_array_equal(got[:previous], scores[:previous])


def test_nan_stays_nan_and_is_no_place():
    rows, scores = np.array([[3, 9], [3, 9]], np.int32), np.array([[np.nan, 2], [1, 1]], np.float32)
    got = FrameCorrelation(1)(Shortlist(rows, scores, rows >= 0), scores)
    np.testing.assert_allclose(got, [[np.nan, 2], [1 + 0.4 * 9 / 15, 1.4]], rtol=1e-6)


def test_numbers_without_meaning_raise():
    for incorrect in ((0,), (1, 0.0), (1, 1.0, -0.1), (1, np.inf)):
        with pytest.raises(InputError, match="expected at least one query"):
            FrameCorrelation(*incorrect)
