"""Hubs: their strength against a loop over scores, what dividing by it mends, and a cohort in a whole evaluation."""

import json
from dataclasses import replace

import numpy as np
import pytest

import mfvpr
from mfvpr.datasets import ImageFolder, folder_dataset
from mfvpr.datasets.contents import Content, Contents
from mfvpr.evaluation import stages
from mfvpr.evaluation.sequence_matching import match_cohort
from mfvpr.features import Aggregated, Sift, VladFitting
from mfvpr.reranking import FrameCorrelation, Fusion
from mfvpr.reranking.cohort_normalization import PRIOR, by_hubness, cohort_sequence, hubness
from mfvpr.retrieval import Retrieval
from mfvpr.storage import FeatureCache
from mfvpr.types import Shortlist
from mfvpr.utils import InputError
from tests.programs import QUERIES, composed, folder, shared, small, typed

pytestmark = pytest.mark.thorough

SIFT = Sift(max_keypoints=60, image_size=(160, 120))
VLAD = Retrieval(Aggregated(SIFT, VladFitting(num_words=8)))
SCORERS = {"histogram": mfvpr.HistogramOfShifts(), "count": mfvpr.MatchCount()}


def listed(rng, queries, candidates, database):
    """Random candidates, some of them padding, and scores with ties, zeros and NaN where nothing is."""
    rows = np.array([rng.permutation(database)[:candidates] for _ in range(queries)], np.int32)
    rows[rng.random(rows.shape) < 0.2] = -1
    scores = np.where(rows >= 0, rng.integers(0, 6, rows.shape) * 7.5, np.nan).astype(np.float32)
    return Shortlist(rows, np.zeros(rows.shape, np.float32), rows >= 0), scores


def by_loops(candidates, scores, database):
    """Image by image, in Python's own numbers."""
    of_image = [[] for _ in range(database)]
    for rows, values in zip(candidates.indices.tolist(), scores.tolist(), strict=True):
        for row, value in zip(rows, values, strict=True):
            if row >= 0 and np.isfinite(value):
                of_image[row].append(value)
    every = [value for some in of_image for value in some]
    usual = sum(every) / len(every)
    return [(sum(some) + PRIOR * usual) / (len(some) + PRIOR) / usual for some in of_image]


@pytest.mark.parametrize("seed", range(4))
def test_hubness_is_that_of_the_loop(seed):
    rng = np.random.default_rng(seed)
    candidates, scores = listed(rng, 30, 8, 40)
    candidates.indices[candidates.indices == 11] = 12  # twice somewhere, and 11 is nobody's candidate
    scores[rng.random(scores.shape) < 0.1] = np.nan
    scores[3, 0] = np.inf
    got = hubness(candidates, scores, 40)
    np.testing.assert_allclose(got, by_loops(candidates, scores, 40), rtol=1e-12)
    assert got[11] == 1
    assert got.max() > 1.1
    np.testing.assert_allclose(hubness(candidates, 1000 * scores, 40), got, rtol=1e-6)


def test_few_scores_say_little():
    """Of three images that score twice what is usual, the one that was asked most often is the surest hub."""
    rows = np.repeat([0, 1, 2, 3], [1, 10, 100, 1000])[None]
    scores = np.where(rows == 3, 1.0, 2.0)
    strength = hubness(Shortlist(rows, scores, rows >= 0), scores, 5)
    assert 1 < strength[0] < strength[1] < strength[2] < 2
    assert strength[3] < 1
    assert strength[4] == 1


@pytest.mark.parametrize("scores", [np.zeros((2, 3)), np.full((2, 3), np.nan), np.full((2, 3), np.inf)])
def test_where_nothing_scores_there_is_no_hub(scores):
    rows = np.array([[1, 2, -1], [0, 2, -1]])
    np.testing.assert_array_equal(hubness(Shortlist(rows, rows * 0.0, rows >= 0), scores, 4), np.ones(4))


def test_a_hub_is_mended_and_an_empty_image_gains_nothing():
    """Image 0 scores 60 with whatever it is shown, image 4 next to nothing; others 20, and 50 with their own place."""
    usual = np.array([60.0, 20, 20, 20, 0.5])
    everywhere = np.tile(usual, (100, 1)).astype(np.float32)
    rows = np.tile(np.arange(5), (100, 1))
    strength = hubness(Shortlist(rows, everywhere, rows >= 0), everywhere, 5)
    queries = np.tile(usual, (3, 1)).astype(np.float32)
    queries[np.arange(3), np.arange(1, 4)] = 50
    queries[:, 4] = 3  # one chance match: six times what it has elsewhere
    candidates = Shortlist(rows[:3], queries, rows[:3] >= 0)
    assert queries.argmax(axis=1).tolist() == [0, 0, 0]
    got = by_hubness(candidates, queries, strength)
    assert got.dtype == np.float32
    assert got.argmax(axis=1).tolist() == [1, 2, 3]
    assert strength[4] < 0.2
    np.testing.assert_array_equal(got[:, 1:], queries[:, 1:])


def test_each_score_is_divided_by_that_of_its_image():
    rows = np.array([[2, 0, -1], [1, 2, 0]])
    scores = np.array([[8, 6, np.nan], [np.nan, np.inf, 0]], np.float32)
    got = by_hubness(Shortlist(rows, rows * 0.0, rows >= 0), scores, np.array([1.5, 1, 2, 3]))
    np.testing.assert_array_equal(got, np.array([[4, 4, np.nan], [np.nan, np.inf, 0]], np.float32))


def test_scores_below_0_are_refused():
    rows = np.array([[0, 1]])
    candidates, scores = Shortlist(rows, rows * 0.0, rows >= 0), np.array([[3, -0.5]], np.float32)
    words = r"cohort: .*from 0, .*got -0.5 of grid"
    for refused in (
        lambda: hubness(candidates, scores, 2, name="grid"),
        lambda: by_hubness(candidates, scores, np.ones(2), name="grid"),
    ):
        with pytest.raises(InputError, match=words):
            refused()


def contents(tmp_path, *hashes):
    names = tuple(f"{number}.png" for number in range(len(hashes)))
    return Contents(ImageFolder(tmp_path, names), tuple(Content(one) for one in hashes))


def test_no_image_is_scored_with_its_own_place(tmp_path):
    """Nor with one of the same content; also where it cannot be read, so that nobody knows its content."""
    sequence = cohort_sequence(contents(tmp_path, "a", "b", "c", "d", "", "a", "f", ""), 1)
    expected = [[0, 1, 4, 5, 6], [0, 1, 2], [1, 2, 3], [2, 3, 4], [3, 4, 5], [0, 1, 4, 5, 6], [5, 6, 7], [6, 7]]
    assert [sequence.excluded.of(row).tolist() for row in range(8)] == expected
    assert sequence.truth is None


@pytest.mark.parametrize("neighbors", [-1, 2.0, True, "5", 3, 100])
def test_neighbors_that_leave_nothing_or_mean_nothing_are_refused(tmp_path, neighbors):
    with pytest.raises(InputError, match=r"^cohort='?(-1|2\.0|True|5|3|100)'?: .*(frames|half of 6)"):
        cohort_sequence(contents(tmp_path, *"abcdef"), neighbors)
    assert len(cohort_sequence(contents(tmp_path, *"abcdef"), 2).images) == 6


@pytest.fixture(scope="module")
def dataset(small_street):
    return folder_dataset(small_street / "database", small_street / "queries", ground_truth="order")


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    return tmp_path_factory.mktemp("kept")


@pytest.fixture(scope="module")
def result(dataset, kept):
    """Two sequences, of all queries and of three; and what was told meanwhile."""
    [sequence], lines, tracked = dataset.sequences, [], []
    few = replace(sequence.images, names=sequence.images.names[:3])
    both = replace(dataset, sequences=(sequence, replace(sequence, name="few", images=few, truth=None)))

    def track(label):
        tracked.append(label)
        return lambda items, total: items

    found = mfvpr.evaluate(
        both, SIFT, VLAD, SCORERS, candidates=5, cohort=2, cache=FeatureCache(kept, tell=lines.append, track=track),
        fused={"histogram + cohort": Fusion(10.0)}, correlated={"count + cohort": FrameCorrelation(1)},
    )  # fmt: skip
    return found, lines, tracked


def test_every_scorer_is_ranked_with_the_cohort_as_well(dataset, kept, result):
    found, *_ = result
    more = ["histogram + cohort", "count + cohort", "histogram + cohort + filter", "count + cohort + frames"]
    assert [*found.systems] == ["filter", "histogram", "count", *more]
    without = mfvpr.evaluate(dataset, SIFT, VLAD, SCORERS, candidates=5, cache=FeatureCache(kept))
    for name, [ranked] in without.systems.items():
        np.testing.assert_array_equal(found.systems[name][0].rows, ranked.rows)
        np.testing.assert_array_equal(found.systems[name][0].scores, ranked.scores)
    others = match_cohort(dataset, 2, SIFT, VLAD, 5, cache=FeatureCache(kept))
    candidates = others.candidates
    assert (np.abs(candidates.indices - np.arange(10)[:, None])[candidates.mask] > 2).all()
    for name, scores in stages.score(SCORERS, others.by_scale, candidates).items():
        strength = np.array(by_loops(candidates, scores, 10))
        np.testing.assert_allclose(hubness(candidates, scores, 10), strength, rtol=1e-12)
        assert strength.max() > 1.02
        for alone, ranked in zip(found.systems[name], found.systems[f"{name} + cohort"], strict=True):
            divided = alone.scores / np.maximum(strength, 1)[alone.rows]
            order = np.argsort(-divided, axis=1, kind="stable")
            np.testing.assert_allclose(ranked.scores, np.take_along_axis(divided, order, axis=1), rtol=1e-6)
            assert (ranked.scores != alone.scores).any()


def test_sequences_share_a_cohort_that_is_told_and_kept(dataset, kept, result):
    found, lines, tracked = result
    matched = [line for line in lines if " to match with 5 candidates" in line]
    assert [line.split(":")[0] for line in matched] == ["cohort matches", "folder matches", "few matches"]
    assert "cohort matches: 10 of 10 queries to match" in matched[0]
    assert {"cohort matching", "cohort scores"} <= {*tracked}
    assert found.seconds["cohort"] > 0
    again = []
    mfvpr.evaluate(dataset, SIFT, VLAD, {}, candidates=5, cohort=2, cache=FeatureCache(kept, tell=again.append))
    assert again[0].startswith("cohort matches: all 10 queries from ")


def test_names_of_systems_with_a_cohort_are_known_only_with_one(dataset):
    for options in ({"fused": {"count + cohort": Fusion()}}, {"correlated": {"count + cohort": FrameCorrelation()}}):
        with pytest.raises(InputError, match=r"\(histogram, count\)|got count \+ cohort"):
            mfvpr.evaluate(dataset, SIFT, VLAD, SCORERS, **options)
    taken = {"count": mfvpr.MatchCount(), "count + cohort": mfvpr.MatchCount()}
    with pytest.raises(InputError, match=r"count \+ cohort .*system"):
        mfvpr.evaluate(dataset, SIFT, VLAD, taken, cohort=2)


@pytest.fixture(scope="session")
def root(tmp_path_factory):
    return shared(tmp_path_factory)


def test_a_run_names_its_cohort(root, tmp_path, monkeypatch, capsys):
    code, stdout, stderr = typed(monkeypatch, capsys, "evaluate", *small(root), "scorer=histogram", "figures=0",
                                 "cohort=3", f"out={tmp_path}/out")  # fmt: skip
    assert code == 0, stderr
    assert f"cohort matches: {QUERIES} of {QUERIES} queries to match" in stderr
    assert "histogram + cohort + filter" in stdout
    rows = json.loads((tmp_path / "out" / "results.json").read_text())
    parameters = {row["system"]: row["parameters"] for row in rows}
    assert {name: own.get("cohort") for name, own in parameters.items()} == {
        "filter": None, "histogram": None, "histogram + cohort": 3, "histogram + filter": None,
        "histogram + cohort + filter": 3,
    }  # fmt: skip
    assert parameters["histogram + cohort"] == parameters["histogram"] | {"cohort": 3}
    assert parameters["histogram + cohort + filter"] == parameters["histogram + filter"] | {"cohort": 3}
    assert {row["scorer"] for row in rows} == {"none", "histogram"}
    assert (tmp_path / "out" / "predictions" / "histogram_cohort_filter.csv").exists()
    assert json.loads((tmp_path / "out" / "run.json").read_text())["settings"]["cohort"] == 3


def test_there_is_no_cohort_unless_it_is_asked_for():
    assert composed()["cohort"] is None


def test_a_list_of_pairs_must_be_of_database_images_as_well(small_street, tmp_path, monkeypatch, capsys):
    code, _, stderr = typed(monkeypatch, capsys, "evaluate", *folder(small_street), "retrieval=pairs", "cohort=2",
                            "retrieval.queries=pairs.txt", "store=null", f"out={tmp_path}/out")  # fmt: skip
    assert code == 2
    assert f"{small_street}/database: expected" in stderr
    assert f"one of: {small_street}/queries;" in stderr


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["cohort=-1"], "cohort=-1: expected a whole number"),
        (["cohort=2.5"], "cohort=2.5: expected a whole number"),
        (["cohort=all"], "cohort=all: expected a whole number"),
        ([f"cohort={QUERIES // 2}"], f"cohort={QUERIES // 2}: expected less than half of {QUERIES}"),
    ],
)
def test_mistakes_are_one_line_and_exit_code_2(root, tmp_path, monkeypatch, capsys, arguments, words):
    code, stdout, stderr = typed(monkeypatch, capsys, "evaluate", *small(root), *arguments, f"out={tmp_path}/out")
    assert code == 2
    assert words in stderr.splitlines()[-1]
    assert not stdout
