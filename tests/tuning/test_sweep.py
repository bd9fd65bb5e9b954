"""Sweeps against one evaluation after the other."""

import sys
from dataclasses import replace

import jax
import numpy as np
import pytest

import mfvpr
from mfvpr.core.scorer import with_parameters
from mfvpr.core.types import Shortlist
from mfvpr.datasets import Positives
from mfvpr.evaluation import DriveFilter, rankings
from mfvpr.matchers import Scales
from mfvpr.matchers.match_set import shapes
from mfvpr.tuning import sweeps
from mfvpr.tuning.sweeps import DriveRanking, group_by_program
from mfvpr.utils import InputError
from tests.builders import match_set_of, random_matches
from tests.scorers import FOREIGN, Sampled, Strongest, Wrapped, title
from tests.storage.synthetic_features import DAMAGE, interrupt_after

pytestmark = pytest.mark.thorough

FS, DMF = mfvpr.FeatureScoreWeight(), mfvpr.DescriptorDistanceWeight()
QUERIES, CANDIDATES, DATABASE = 7, 5, 9


def make_set():
    """Few to many matches a pair, with a confidence, some pairs without; images of two sizes on either side; and a
    shortlist that ends early for one query."""
    rng = np.random.default_rng(4)
    pairs = []
    for query in range(QUERIES):
        size = ((168, 168), (320, 240))[query % 2]
        counts = enumerate(rng.permutation([0, 3, 20, 33, 60]))
        pairs.append([random_matches(rng, n, sizes=(size, ((168, 168), (200, 150))[row % 2])) for row, n in counts])
    indices = np.stack([rng.permutation(DATABASE)[:CANDIDATES] for _ in range(QUERIES)]).astype(np.int32)
    indices[2, 3:] = -1
    scores = np.sort(rng.random((QUERIES, CANDIDATES)).astype(np.float32))[:, ::-1]
    return match_set_of(pairs, 96), Shortlist(indices, scores, indices >= 0)


@pytest.fixture(scope="module")
def data():
    return make_set()


def rank(scorer, settings, *data, views=None, **options):
    """Rows of the rankings by every setting."""
    return sweeps.rank_settings(scorer, settings, *data, views=views, options=sweeps.SweepOptions(**options))


def one_by_one(scorer, setting, match_set, candidates, view=None, **options):
    """Rows of one setting, by the functions that an evaluation calls."""
    setting = dict(setting)
    limit, fused, c = setting.pop("max_distance", np.inf), "c" in setting, setting.pop("c", None)
    scorer = with_parameters(scorer, setting)
    scores = []
    for query in range(QUERIES):
        padded = match_set[query]
        scores.append(mfvpr.score_candidates(scorer, replace(padded, mask=padded.mask & (padded.distance <= limit))))
    view = candidates.mask if view is None else view
    seen = replace(candidates, mask=candidates.mask & view)
    scores = np.array(scores, np.float32)
    scores = np.asarray(rankings.fuse(seen.scores, scores, seen.mask, c)) if fused else scores
    order = rankings.rank_shortlist(seen, scores, **options)
    return np.where(np.take_along_axis(seen.mask, order, 1), np.take_along_axis(candidates.indices, order, 1), -1)


CASES = [
    (mfvpr.HistogramOfShifts(), {"sigma": [9.0, 22.5], "bin_size": [14.0, 15.0, 16.0], "weight": [FS, DMF]}),
    (mfvpr.HistogramOfShifts(), {"max_distance": [0.8, 2.0], "align": ["min_edge", "zero_edge"], "c": [None, 0.5, 0]}),
    (mfvpr.HistogramOfShifts(bin_size=20.0), {"temperature": [None, 0.5], "c": [0.0]}),
    (mfvpr.HistogramOfShifts(bin_size=4.0), {"sigma": [9.0, 22.5]}),  # by branch and bound
    (mfvpr.AnchorPoints(), {"num_bins": [6, 8], "window": [4, 6], "tolerance": [1, 2.5], "weight": [DMF, FS]}),
    (mfvpr.AggregatedScore(), {"weight": [FS, DMF], "max_distance": [1.0, 2.0], "mean": ["unweighted", "median"]}),
    (mfvpr.MatchCount(), {"max_distance": [0.5, 1.0, 1.5]}),
    (mfvpr.RapidSpatialScore(), {"reach": ["image_size", "largest_shift"], "per_feature": [True], "c": [None, 1.0]}),
    (mfvpr.VisualPhrases(), {"length": [1, 3], "cell_size": [9.0, 30.0], "align": ["zero_center", "zero_edge"]}),
    (mfvpr.LostScore(), {"form": ["weighted", "unweighted"], "mirrored": [False, True], "max_distance": [0.8, 2.0]}),
    (Wrapped(), {"inner.sigma": [9.0, 22.5], "inner.bin_size": [14.0, 16.0], "inner.align": ["min_edge", "zero_edge"]}),
    *((scorer, {"max_distance": [0.8, 3.0], "c": [None, 0.0]}) for scorer in FOREIGN),
    (mfvpr.HistogramOfShifts(), [
        {"sigma": 9.0, "max_distance": 2.0, "weight": FS},
        {"sigma": 30.0, "max_distance": 0.9, "weight": DMF},
        {"sigma": 14.0, "max_distance": 2.0, "weight": DMF},
    ]),
]  # fmt: skip


@pytest.mark.first_case
@pytest.mark.parametrize(
    ("scorer", "axes"), CASES, ids=lambda value: "" if isinstance(value, dict | list) else title(value)
)
def test_sweep_is_one_evaluation_per_setting(data, scorer, axes):
    settings = axes if isinstance(axes, list) else sweeps.grid(axes)
    got = rank(scorer, settings, *data, ks=[CANDIDATES])
    assert got.shape == (1, len(settings), QUERIES, CANDIDATES)
    for rows, setting in zip(got[0], settings, strict=True):
        np.testing.assert_array_equal(rows, one_by_one(scorer, setting, *data), err_msg=str(setting))


def test_one_setting_beside_a_grid_leaves_it_whole(data):
    """The grid's weightings still share their Gaussians."""
    scorer = mfvpr.HistogramOfShifts()
    settings = sweeps.grid({"sigma": [9.0, 20.0, 30.0], "weight": [FS, DMF], "max_distance": [0.8, 2.0]})
    settings.insert(3, {"sigma": 9.0, "weight": FS, "max_distance": 1.1})
    programs = list(group_by_program(scorer, settings, data[0].image_sizes))
    assert sorted(group.rows.shape for group in programs) == [(1, 5), (2, 4)]
    assert sorted(row for group in programs for row in group.rows.reshape(-1)) == list(range(13))
    for rows, setting in zip(rank(scorer, settings, *data)[0], settings, strict=True):
        np.testing.assert_array_equal(rows[:, :CANDIDATES], one_by_one(scorer, setting, *data))


@pytest.mark.first_case
@pytest.mark.parametrize("settings_per_block", [1, 5, 100])
@pytest.mark.parametrize("queries_per_block", [1, 4, 100])
def test_chunks_change_nothing(data, settings_per_block, queries_per_block):
    settings = sweeps.grid(CASES[0][1] | {"c": [None, 1.0]})
    got = rank(
        CASES[0][0], settings, *data,
        settings_per_block=settings_per_block, queries_per_block=queries_per_block,
    )  # fmt: skip
    np.testing.assert_array_equal(got, rank(CASES[0][0], settings, *data))


def test_views_hide_candidates_and_ties_may_go_by_index(data):
    _, candidates = data
    view = np.random.default_rng(1).random(candidates.mask.shape) < 0.6
    settings = [{"max_distance": limit, "c": c} for limit in (0.05, 2.0) for c in (None, 0.0)]  # 0.05: mostly ties
    got = rank(mfvpr.MatchCount(), settings, *data, views=[candidates.mask, view], ties="index")
    for seen, by_view in zip((candidates.mask, view), got, strict=True):
        for first_rows, setting in zip(by_view, settings, strict=True):
            expected = one_by_one(mfvpr.MatchCount(), setting, *data, view=seen, ties="index")
            np.testing.assert_array_equal(first_rows[:, :CANDIDATES], expected)
            assert (first_rows[:, CANDIDATES:] == -1).all()


@pytest.fixture
def block_scores(monkeypatch):
    """Scores of every block that the test computes."""
    computed, module = [], vars(sys.modules["mfvpr.tuning.sweeps"])
    scores = module["pair_scores"]
    monkeypatch.setitem(module, "pair_scores", lambda *inputs: computed.append(scores(*inputs)) or computed[-1])
    return computed


def test_rows_are_read_and_missing_or_damaged_ones_are_made_again(data, tmp_path, block_scores):
    scorer, settings = mfvpr.HistogramOfShifts(), sweeps.grid({"sigma": [9.0, 12.0, 20.0], "c": [None, 0.5]})
    more = sweeps.grid({"sigma": [9.0, 15.0, 20.0], "c": [None, 0.5]})
    expected, expected_of_more = (rank(scorer, each, *data) for each in (settings, more))
    block_scores.clear()
    chunks = {"settings_per_block": 1, "queries_per_block": 3, "folder": tmp_path}
    with pytest.raises(KeyboardInterrupt):
        rank(scorer, settings, *data, runtime=mfvpr.Runtime(progress=lambda _: interrupt_after(7)), **chunks)
    files = sorted(tmp_path.rglob("*.npz"))
    assert len(files) == 4  # two of three scores, each with two c
    DAMAGE["flipped"](files[0])
    block_scores.clear()
    np.testing.assert_array_equal(rank(scorer, settings, *data, **chunks), expected)
    assert len(block_scores) == 2 * 3  # the damaged and the missing score, in three parts of the queries
    np.testing.assert_array_equal(rank(scorer, settings, *data, **chunks), expected)
    np.testing.assert_array_equal(rank(scorer, more, *data, **chunks), expected_of_more)
    assert len(block_scores) == 3 * 3  # another setting


def test_one_program_per_shape_and_capacity(data, compilations):
    match_set, _ = data
    axes = {"sigma": [9.0, 22.5, 30.0], "bin_size": [12.5, 14.9, 15.0], "max_distance": [0.8, 2.0]}
    rank(mfvpr.HistogramOfShifts(), sweeps.grid(axes), *data)
    compilations.reset()
    axes = {"sigma": [7.0, 21.5, 33.0], "bin_size": [12.4, 14.8, 15.1], "max_distance": [0.7, 1.0]}
    rank(mfvpr.HistogramOfShifts(), sweeps.grid(axes), *data)
    assert compilations.count == 0
    rank(mfvpr.HistogramOfShifts(), sweeps.grid(axes | {"bin_size": [8.0, 12.0, 12.1]}), *data)
    assert 1 <= compilations.count <= 2 * len(shapes(match_set))  # two capacities


def with_points(match_set, points):
    """The matches of every query with other points in the candidates."""
    return replace(match_set, matches=[replace(each, points1=points(each.points1)) for each in match_set.matches])


def test_rows_of_other_data_options_or_scorers_in_the_same_folder_are_not_taken(data, tmp_path):
    matches, listed = data
    view, histogram = np.random.default_rng(1).random(listed.mask.shape) < 0.6, mfvpr.HistogramOfShifts(bin_size=20.0)
    other_indices = np.where(listed.mask, listed.indices[:, ::-1], -1)
    excluded = Positives.from_rows([[query] for query in range(QUERIES)], DATABASE)
    causal = DriveRanking(DriveFilter("causal"), DATABASE)
    cases = [
        (matches, listed, histogram, {}),
        (with_points(matches, lambda points: points[::-1].copy()), listed, histogram, {}),
        (matches, replace(listed, indices=other_indices), histogram, {}),
        (matches, replace(listed, scores=listed.scores[:, ::-1]), histogram, {}),
        (Scales([matches], weights=[0.01]), listed, histogram, {}),
        (matches, listed, replace(histogram, sigma=40.0), {}),
        (matches, listed, mfvpr.AggregatedScore(), {}),
        (matches, listed, mfvpr.AggregatedScore(), {"views": [view]}),
        (matches, listed, mfvpr.AggregatedScore(), {"views": [~view]}),
        (matches, listed, mfvpr.AggregatedScore(), {"ties": "index"}),
        (matches, listed, mfvpr.AggregatedScore(), {"retrieval_score": "negative_euclidean"}),
        (matches, listed, mfvpr.AggregatedScore(), {"ks": [2]}),
        (matches, listed, mfvpr.AggregatedScore(), {"sequence": causal}),
        (matches, listed, mfvpr.AggregatedScore(), {"sequence": replace(causal, excluded=excluded)}),
    ]
    for number, (changed_matches, changed_listed, scorer, options) in enumerate(cases, start=1):
        settings = [{"max_distance": limit, "c": c} for limit, c in ((0.3, 0.5), (2.0, 0.5), (2.0, 20.0))]
        expected = rank(scorer, settings, changed_matches, changed_listed, **options)
        stored = rank(scorer, settings, changed_matches, changed_listed, **options, folder=tmp_path)
        np.testing.assert_array_equal(stored, expected)
        assert len([*tmp_path.iterdir()]) == number


def test_results_of_a_scorer_without_a_recipe_are_not_kept(data, tmp_path):
    lines = []
    options = {"folder": tmp_path, "runtime": mfvpr.Runtime(log=lines.append)}
    for sign in (1, -1):
        scorer = lambda matches, sign=sign: sign * mfvpr.MatchCount()(matches)  # noqa: E731
        got = rank(scorer, [{"max_distance": 2.0}], *data, **options)
        np.testing.assert_array_equal(got, rank(scorer, [{"max_distance": 2.0}], *data))
    assert not list(tmp_path.iterdir())
    assert "no results are kept" in lines[0]


def test_whole_numbers_and_keys_are_swept_and_kept(data, tmp_path):
    settings = [{"place": 0}, {"place": 2}]
    got = rank(Strongest(), settings, *data, folder=tmp_path)
    for rows, setting in zip(got[0], settings, strict=True):
        np.testing.assert_array_equal(rows[:, :CANDIDATES], one_by_one(Strongest(), setting, *data))
    sampled, settings = Sampled(jax.random.key(3)), [{"scale": 10.0}]
    for _ in range(2):
        got = rank(sampled, settings, *data, folder=tmp_path)
        np.testing.assert_array_equal(got[0, 0, :, :CANDIDATES], one_by_one(sampled, settings[0], *data))


def all_nan(matches):
    return mfvpr.MatchCount()(matches) / 0 * 0


def test_scores_that_no_ranking_can_use_are_refused(data):
    """They would leave the order of the retrieval, and win where that is good."""
    with pytest.raises(InputError, match=r"sigma=0\.0: expected a number"):
        sweeps.Axes(mfvpr.HistogramOfShifts(), {"sigma": [0.0, 10.0]})
    with pytest.raises(InputError, match="NaN or infinite"):
        sweeps.rank_settings(all_nan, [{"max_distance": 1.0}], *data)
