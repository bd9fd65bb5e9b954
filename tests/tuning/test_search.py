"""The search over a small path, against sweeps and loops over queries."""

import math

import numpy as np
import pytest

import mfvpr
from mfvpr import InputError
from mfvpr.baselines.learned_weight import named_weight
from mfvpr.core import hits
from mfvpr.datasets import FrameTruth
from mfvpr.evaluation import best_setting, evaluation_protocol, statistics
from mfvpr.report import searches
from mfvpr.tuning import sweeps as sweeping
from mfvpr.tuning.sweeps import Axes, suggest_setting
from tests.needs import needs
from tests.scorers import Wrapped
from tests.tuning.learning.paths import QUERIES, TOLERANCES, split
from tests.tuning.test_sweep import rank

TRUTH = FrameTruth(tuple((row,) for row in range(QUERIES)), QUERIES)
SUM = mfvpr.AggregatedScore()
WEIGHTS = {"weight": ["fs", "unit"], "c": [0, "auto"]}


@pytest.fixture(scope="module")
def data():
    path = split()
    return path.match_set, path.candidates


@pytest.fixture(scope="module")
def outcome(data):
    axes = Axes(SUM, WEIGHTS, {"weight": "dmf", "c": 2})
    return sweeping.search_grid(
        axes, evaluation_protocol(TRUTH, TOLERANCES, "both"), *data, sweeping.SweepOptions(ks=[5, 1])
    )


def test_words_become_values():
    axes = Axes(mfvpr.HistogramOfShifts(), {"weight": ["fs"], "truncate": [None, 2.0]})
    plain = {"weight": "dmf", "truncate": None, "max_distance": None, "c": "auto", "sigma": 3.0}
    assert axes.setting(plain) == {
        "weight": mfvpr.DescriptorDistanceWeight(), "truncate": math.inf, "max_distance": math.inf, "c": None,
        "sigma": 3.0,
    }  # fmt: skip
    assert axes.setting({"max_distance": 0.5, "c": 2}) == {"max_distance": 0.5, "c": 2.0}
    assert axes.size == 2
    assert axes.grid() == [{"weight": "fs", "truncate": None}, {"weight": "fs", "truncate": 2.0}]
    assert Axes(Wrapped(), {}, {}).setting({"inner.sigma": 9.0}) == {"inner.sigma": 9.0}  # declared nowhere


def test_bins_that_do_not_fit_are_refused_before_any_work(data):
    axes = Axes(mfvpr.HistogramOfShifts(), {"bin_size": [15.0, 0.01]})
    options = sweeping.SweepOptions(runtime=mfvpr.Runtime(log=lambda _: pytest.fail("begun")))
    with pytest.raises(InputError, match=r"bin_size=0\.01: expected at most 1024 bins"):
        sweeping.search_grid(axes, evaluation_protocol(TRUTH, TOLERANCES), *data, options)


def test_own_values_follow_from_the_scorer_unless_they_are_given():
    axes = Axes(mfvpr.HistogramOfShifts(), {"sigma": np.array([5, 10]), "truncate": [None], "weight": ["ratio"]})
    assert axes.values["sigma"] == [5, 10]
    assert type(axes.values["sigma"][0]) is int
    assert axes.own_values == {"sigma": 22.5, "truncate": None, "weight": "fs"}
    learned = mfvpr.AggregatedScore(weight=named_weight("learned_aliked"))
    assert Axes(learned, {"weight": ["fs"]}).own_values == {"weight": "learned_aliked"}
    wrapped = Axes(Wrapped(), {"inner.sigma": [9.0], "c": ["auto"], "max_distance": [0.5]}, {"c": 2, "sigma": 1})
    assert wrapped.own_values == {"inner.sigma": 18.0, "c": 2, "max_distance": None}


@pytest.mark.parametrize(("values", "words"), [
    ({"weight": ["unti"]}, "weight='unti': expected one of fs, dmf, ratio, unit"),
    ({"sigma": [1.0]}, "sigma: expected a parameter of AggregatedScore, of clamp, mean, temperature, weight"),
    ({"c": 2}, "c=2: expected different values, in a list"),
    ({"c": [2, 2.0]}, "expected different values, in a list"),
    ({"weight": "fs"}, "weight='fs': expected different"),
    ({"c": []}, r"c=\[\]: expected different"),
])  # fmt: skip
def test_axes_that_cannot_be_swept_are_refused_in_one_line(values, words):
    with pytest.raises(InputError, match=words):
        Axes(SUM, values)


def test_every_setting_of_the_grid_is_ranked_and_then_the_scorers_own(data, outcome):
    assert outcome.settings == [*sweeping.grid(WEIGHTS), {"weight": "dmf", "c": 2}]
    assert outcome.own == 4
    assert outcome.ks == [1, 5]
    weights = {"fs": mfvpr.FeatureScoreWeight(), "unit": mfvpr.UnitWeight(), "dmf": mfvpr.DescriptorDistanceWeight()}
    settings = [
        {"weight": weights[row["weight"]], "c": None if row["c"] == "auto" else row["c"]} for row in outcome.settings
    ]
    rows = rank(SUM, settings, *data, views=outcome.protocol.views, ks=[5])
    np.testing.assert_array_equal(outcome.rows, rows)


def test_each_half_is_reported_by_what_was_chosen_on_the_other(outcome):
    """The scorer's own values are beside the grid, and never chosen."""
    right = outcome.protocol.positives[1]
    first, of_scorer = [], []
    for view, half, chosen in zip((1, 2), outcome.protocol.halves, outcome.chosen, strict=True):
        tuned = hits(outcome.rows[view][:4, half.tune], right.take(half.tune)).mean(axis=1)
        assert chosen == best_setting(tuned, WEIGHTS)
        first += hits(outcome.rows[0][chosen], right)[half.report].tolist()
        of_scorer += hits(outcome.rows[0][4], right)[half.report].tolist()
    path = np.argsort(np.concatenate([half.report for half in outcome.protocol.halves]))
    first, of_scorer = np.array(first)[path], np.array(of_scorer)[path]
    verdict = outcome.report[1]
    assert (verdict.threshold, verdict.queries) == (TOLERANCES[1], QUERIES)
    assert verdict.chosen == statistics.estimate(first) == (np.mean(first), verdict.chosen.interval)
    assert verdict.chosen.interval == statistics.recall_interval(first)
    assert verdict.mcnemar == statistics.mcnemar(first, of_scorer)
    assert verdict.path_test == statistics.path_test(first, of_scorer)


@needs("optuna")
def test_optuna_draws_within_the_axes():
    import optuna

    values = {"num_bins": [4, 9], "tolerance": [1.5, 4.0], "weight": ["fs", "unit"], "window": [6]}
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=1))
    drawn = [suggest_setting(study.ask(), Axes(mfvpr.AnchorPoints(), values, {})) for _ in range(20)]
    for setting in drawn:
        assert type(setting["num_bins"]) is int
        assert 4 <= setting["num_bins"] <= 9
        assert 1.5 <= setting["tolerance"] <= 4
        assert setting["weight"] in values["weight"]
        assert setting["window"] == 6
    assert len({setting["tolerance"] for setting in drawn}) == 20


@needs("optuna")
def test_optuna_proposes_after_the_own_values_and_learns_from_the_queries_that_choose(data, monkeypatch):
    import optuna

    values, tell = [], optuna.Study.tell
    monkeypatch.setattr(optuna.Study, "tell", lambda *arguments: values.append(arguments[-1]) or tell(*arguments))
    axes = Axes(SUM, {"weight": ["fs", "unit"], "c": [0.5, 3.0]}, {"weight": "dmf", "c": 2})
    protocol = evaluation_protocol(TRUTH, TOLERANCES, "both")
    outcome = sweeping.search_optuna(axes, protocol, *data, sweeping.SweepOptions(ks=[1]), trials=3, seed=1)
    assert outcome.settings[0] == axes.own_values
    assert outcome.rows.shape == (3, 4, QUERIES, 1)
    trials = outcome.protocol.tuning(outcome.rows)[:, 1:, 1]  # the own values are no choice
    assert outcome.chosen == (1 + np.argmax(trials, axis=1)).tolist()
    assert searches.sweep_figures(outcome) == []
    settings = [axes.setting(plain) for plain in outcome.settings]
    rows = rank(SUM, settings, *data, views=outcome.protocol.views, ks=[1])
    np.testing.assert_array_equal(outcome.rows, rows)
    tuning = outcome.protocol.tuning(outcome.rows)[:, 1:, outcome.protocol.main].mean(axis=0)
    np.testing.assert_array_equal(values, tuning)
    assert (tuning != outcome.recall[1:, outcome.protocol.main]).all()  # of all queries, reported ones among them
