"""Hubness against a loop over scores, scores divided by it, and a cohort in a whole evaluation."""

from dataclasses import replace

import numpy as np
import pytest

import mfvpr
from mfvpr.datasets import ImageFolder
from mfvpr.datasets.contents import Content, Contents
from mfvpr.evaluation import FrameCorrelation, Fusion, match_sequence, stages
from mfvpr.evaluation.cohort_normalization import PRIOR, by_hubness, cohort_sequence, hubness
from mfvpr.storage import FeatureCache
from mfvpr.utils import InputError
from tests.builders import evaluate_parts, make_shortlist
from tests.evaluation.conftest import SCORERS, SIFT, VLAD
from tests.programs import shared

pytestmark = pytest.mark.thorough


def by_loops(candidates, scores, database):
    """Image by image, in Python's own numbers."""
    by_image = [[] for _ in range(database)]
    for rows, row_scores in zip(candidates.indices.tolist(), scores.tolist(), strict=True):
        for row, score in zip(rows, row_scores, strict=True):
            if row >= 0 and np.isfinite(score):
                by_image[row].append(score)
    mean = sum(map(sum, by_image)) / sum(map(len, by_image))
    return [(sum(scores) + PRIOR * mean) / (len(scores) + PRIOR) / mean for scores in by_image]


@pytest.mark.parametrize("seed", range(4))
def test_hubness_is_that_of_the_loop(seed):
    rng = np.random.default_rng(seed)
    rows = np.array([rng.permutation(40)[:8] for _ in range(30)], np.int32)
    rows[rng.random(rows.shape) < 0.2] = -1
    rows[rows == 11] = 12  # twice somewhere, and 11 is nobody's candidate
    scores = np.where(rows >= 0, rng.integers(0, 6, rows.shape) * 7.5, np.nan).astype(np.float32)
    scores[rng.random(scores.shape) < 0.1] = np.nan
    scores[3, 0] = np.inf
    strengths = hubness(make_shortlist(rows), scores, 40)
    np.testing.assert_allclose(strengths, by_loops(make_shortlist(rows), scores, 40), rtol=1e-12)
    assert strengths[11] == 1
    assert strengths.max() > 1.1
    np.testing.assert_allclose(hubness(make_shortlist(rows), 1000 * scores, 40), strengths, rtol=1e-6)


@pytest.mark.parametrize("scores", [np.zeros((2, 3)), np.full((2, 3), np.nan), np.full((2, 3), np.inf)])
def test_where_nothing_scores_there_is_no_hub(scores):
    np.testing.assert_array_equal(hubness(make_shortlist([[1, 2, -1], [0, 2, -1]]), scores, 4), np.ones(4))


def test_each_score_is_divided_by_that_of_its_image():
    """Unless that is below 1: an image that matches nothing would gain by every match."""
    scores = np.array([[8, 6, 3, np.nan], [np.nan, np.inf, 3, 0]], np.float32)
    got = by_hubness(make_shortlist([[2, 0, 3, -1], [1, 2, 3, 0]]), scores, np.array([1.5, 1, 2, 0.5]))
    np.testing.assert_array_equal(got, np.array([[4, 4, 3, np.nan], [np.nan, np.inf, 3, 0]], np.float32))


@pytest.mark.parametrize(("function", "last"), [(hubness, 2), (by_hubness, np.ones(2))])
def test_scores_below_0_raise(function, last):
    with pytest.raises(InputError, match=r"cohort: .*from 0, .*got -0.5 of grid"):
        function(make_shortlist([[0, 1]]), np.array([[3, -0.5]], np.float32), last, name="grid")


def contents(tmp_path, *hashes):
    names = tuple(f"{number}.png" for number in range(len(hashes)))
    return Contents(ImageFolder(tmp_path, names), tuple(map(Content, hashes)))


def test_no_image_is_scored_with_its_own_place(tmp_path):
    """Nor with an image of the same content; the content of images that cannot be read is unknown."""
    sequence = cohort_sequence(contents(tmp_path, "a", "b", "c", "d", "", "a", "f", ""), 1)
    expected = [[0, 1, 4, 5, 6], [0, 1, 2], [1, 2, 3], [2, 3, 4], [3, 4, 5], [0, 1, 4, 5, 6], [5, 6, 7], [6, 7]]
    assert [sequence.excluded.of(row).tolist() for row in range(8)] == expected
    assert sequence.truth is None


@pytest.mark.parametrize("neighbors", [-1, 2.0, True, "5", 3, 100])
def test_neighbors_that_leave_no_image_or_are_no_number_raise(tmp_path, neighbors):
    with pytest.raises(InputError, match=r"^cohort='?(-1|2\.0|True|5|3|100)'?: .*(frames|half of 6)"):
        cohort_sequence(contents(tmp_path, *"abcdef"), neighbors)
    assert len(cohort_sequence(contents(tmp_path, *"abcdef"), 2).images) == 6


@pytest.fixture(scope="module")
def cache_folder(tmp_path_factory):
    return tmp_path_factory.mktemp("cache_folder")


@pytest.fixture(scope="module")
def evaluation(dataset, cache_folder):
    """The result of two sequences, of all queries and of three; log lines, and labels of progress."""
    [sequence], lines, tracked = dataset.sequences, [], []
    few = replace(sequence.images, names=sequence.images.names[:3])
    both = replace(dataset, sequences=(sequence, replace(sequence, name="few", images=few, truth=None)))

    def track(label):
        tracked.append(label)
        return lambda items, total: items

    result = evaluate_parts(
        both, SIFT, VLAD, SCORERS, candidates=5, cohort=2, fused={"histogram + cohort": Fusion(10.0)},
        correlated={"count + cohort": FrameCorrelation(1)},
        cache=FeatureCache(cache_folder, runtime=mfvpr.Runtime(log=lines.append, progress=track)),
    )  # fmt: skip
    return result, lines, tracked


def test_every_scorer_is_ranked_with_the_cohort_as_well(dataset, cache_folder, evaluation):
    result, *_ = evaluation
    more = ["histogram + cohort", "count + cohort", "histogram + cohort + retrieval", "count + cohort + frames"]
    assert [*result.systems] == ["retrieval", "histogram", "count", *more]
    without = evaluate_parts(dataset, SIFT, VLAD, SCORERS, candidates=5, cache=FeatureCache(cache_folder))
    for name, [ranked] in without.systems.items():
        np.testing.assert_array_equal(result.systems[name][0].rows, ranked.rows)
        np.testing.assert_array_equal(result.systems[name][0].scores, ranked.scores)
    cache = FeatureCache(cache_folder)
    sequence = cohort_sequence(cache.recipes.contents(dataset.database), 2)
    cohort = match_sequence(dataset, sequence, mfvpr.Pipeline(SIFT, VLAD, candidates=5), cache=cache)
    candidates = cohort.candidates
    assert (np.abs(candidates.indices - np.arange(10)[:, None])[candidates.mask] > 2).all()
    for name, scores in stages.score(SCORERS, cohort.by_scale, candidates).items():
        strength = np.array(by_loops(candidates, scores, 10))
        np.testing.assert_allclose(hubness(candidates, scores, 10), strength, rtol=1e-12)
        assert strength.max() > 1.02
        for alone, ranked in zip(result.systems[name], result.systems[f"{name} + cohort"], strict=True):
            divided = alone.scores / np.maximum(strength, 1)[alone.rows]
            order = np.argsort(-divided, axis=1, kind="stable")
            np.testing.assert_allclose(ranked.scores, np.take_along_axis(divided, order, axis=1), rtol=1e-6)
            assert (ranked.scores != alone.scores).any()


def test_sequences_share_a_cohort_that_is_cached(dataset, cache_folder, evaluation):
    result, lines, tracked = evaluation
    matched = [line for line in lines if " to match with 5 candidates" in line]
    assert [line.split(":")[0] for line in matched] == ["cohort matches", "folder matches", "few matches"]
    assert "cohort matches: 10 of 10 queries to match" in matched[0]
    assert {"cohort matching", "cohort scores"} <= {*tracked}
    assert result.seconds["cohort"] > 0
    lines = []
    evaluate_parts(
        dataset,
        SIFT,
        VLAD,
        {},
        candidates=5,
        cohort=2,
        cache=FeatureCache(cache_folder, runtime=mfvpr.Runtime(log=lines.append)),
    )
    assert lines[0].startswith("cohort matches: all 10 queries from ")


def test_names_of_systems_with_a_cohort_are_known_only_with_one(dataset):
    for options in ({"fused": {"count + cohort": Fusion()}}, {"correlated": {"count + cohort": FrameCorrelation()}}):
        with pytest.raises(InputError, match=r"\(histogram, count\)|got count \+ cohort"):
            evaluate_parts(dataset, SIFT, VLAD, SCORERS, **options)
    taken = {"count": mfvpr.MatchCount(), "count + cohort": mfvpr.MatchCount()}
    with pytest.raises(InputError, match=r"count \+ cohort .*system"):
        evaluate_parts(dataset, SIFT, VLAD, taken, cohort=2)


@pytest.fixture(scope="session")
def root(tmp_path_factory):
    return shared(tmp_path_factory)
