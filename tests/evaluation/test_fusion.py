"""Several scores of a query's candidates, retrieval's among them, as one."""

from dataclasses import replace

import numpy as np
import pytest

import mfvpr
from mfvpr import datasets
from mfvpr.core.types import Shortlist
from mfvpr.evaluation import FrameCorrelation, Fusion, match_sequence, stages
from mfvpr.evaluation.fusion import final_scores, rank_by_scores
from mfvpr.evaluation.rankings import rank_shortlist
from tests import oracles
from tests.builders import evaluate_parts
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
        expected = oracles.fuse_scales(stacked[query], mask, weights, "zscore")
        np.testing.assert_allclose(fused[query], expected, rtol=1e-4, atol=1e-4)


def test_standardized_scores_are_summed():
    candidates, scores = random_scores()
    fused = Fusion("zscore", weights={"retrieval": 0.5, "a": 3.0, "b": 0.25})("a", candidates, scores)
    assert fused.dtype == np.float32
    assert_fused(fused, candidates, [candidates.scores, scores["a"], scores["b"]], [0.5, 3.0, 0.25])
    fused = Fusion("zscore", weights={"a": 3.0})("a", candidates, scores)  # retrieval counts 1
    assert_fused(fused, candidates, [candidates.scores, scores["a"]], [1.0, 3.0])


def test_the_retrieval_score_may_be_a_distance():
    candidates, scores = random_scores()
    fused = Fusion("zscore", "negative_euclidean")("a", candidates, scores)
    distance = -np.sqrt(2 - 2 * candidates.scores.astype(np.float64))
    assert_fused(fused, candidates, [distance, scores["a"]], [1, 1])


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


def test_a_system_is_called_by_what_takes_part():
    for names, system in ((["retrieval", "b"], "a + b + retrieval"), (["c", "a", "b"], "a + c + b + retrieval")):
        assert Fusion("zscore", weights=dict.fromkeys(names, 2.0)).system("a") == system


@pytest.fixture(scope="module")
def sequence_matches(dataset):
    return match_sequence(dataset, dataset.only, mfvpr.Pipeline(SIFT, VLAD, candidates=5))


def rank_by(matched, fused, correlated):
    scores = stages.score(SCORERS, matched.by_scale, matched.candidates)
    by_name = final_scores(tuple(SCORERS), fused, correlated, {})
    return rank_by_scores(matched.candidates, scores, by_name.values(), "retrieval")


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


def test_scores_of_several_scales_are_fused_again_with_retrieval(sequence_matches):
    """They are standardized sums themselves."""
    twice = replace(sequence_matches, matches=sequence_matches.matches * 2, weights=(1.0, 1.0))
    systems, once = (rank_by(matched, {"histogram": Fusion("zscore")}, {}) for matched in (twice, sequence_matches))
    name = "histogram + retrieval"
    np.testing.assert_allclose(systems[name].scores, once[name].scores, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(systems["histogram"].scores.mean(axis=1), 0, atol=1e-5)


def test_every_sequence_is_fused_by_itself(dataset, small_street, tmp_path):
    folders = [tmp_path / name for name in ("first", "second")]
    for folder in folders:
        folder.symlink_to(small_street / "queries")
    several = datasets.folder(small_street / "database", folders, ground_truth="none")
    options = {"candidates": 5, "fused": {"histogram": BOTH}}
    results = [evaluate_parts(data, SIFT, VLAD, SCORERS, **options) for data in (dataset, several)]
    [alone], rankings = (result.systems["histogram + count + retrieval"] for result in results)
    for ranking in rankings:
        np.testing.assert_array_equal(ranking.rows, alone.rows)
        np.testing.assert_array_equal(ranking.scores, alone.scores)
