"""`mfvpr.sweep` as users of the library call it."""

import json
from dataclasses import replace

import numpy as np
import pytest

import mfvpr
from mfvpr.evaluation import DriveFilter, Fusion, Ranked, statistics
from mfvpr.features import Aggregated, Sift, VladFitting
from mfvpr.retrieval import Retrieval
from mfvpr.storage import FeatureCache
from mfvpr.tuning import sweeps as rankings
from mfvpr.tuning.sweeps import DriveRanking

pytestmark = pytest.mark.slow

AXES = {"sigma": [5, 10.0, 22.5], "weight": ["fs", "ratio"]}


@mfvpr.value
class MyScorer:
    """Total weight of the matches, the less, the larger their shifts."""

    recipe = "my scorer 1"
    sigma: float = 10.0
    weight: mfvpr.Weight = mfvpr.UnitWeight()

    def __call__(self, matches):
        shifts, weights = mfvpr.match_shifts(matches), mfvpr.match_weights(self.weight, matches)
        return (weights / (1 + (shifts**2).sum(axis=-1) / self.sigma**2)).sum()


@pytest.fixture(scope="module")
def sweep(dataset, tmp_path_factory):
    """Sweeps the small street, whose matches are kept."""
    cache = FeatureCache(tmp_path_factory.mktemp("store"))
    return lambda system, **options: mfvpr.sweep(dataset, system, cache=cache, **{"thresholds": [0, 1]} | options)


@pytest.fixture(scope="module")
def swept(sweep, tmp_path_factory):
    out = tmp_path_factory.mktemp("swept") / "s"
    return out, sweep(MyScorer(), **AXES, split="both", out=out)


def test_the_best_setting_is_honestly_named(swept):
    _, result = swept
    outcome = result.outcome
    assert outcome.own == 6
    assert outcome.axes.own_values == {"sigma": 10.0, "weight": "unit"}
    tuning = outcome.protocol.tuning(outcome.rows)[:, :6, 1].mean(axis=0)
    assert tuning[outcome.best] == tuning.max()
    assert result.best == outcome.settings[outcome.best]
    assert [*result.chosen] == ["first_half", "second_half"]
    hits = outcome.protocol.reported_hits(outcome.rows, outcome.chosen)[1]
    assert result.interval == statistics.estimate(hits)
    assert repr(result).startswith("Sweep(folder, MyScorer: 6 settings; best sigma = ")
    assert len(repr(result)) < 200


@pytest.mark.parametrize("method", ["causal", "smoothed"])
def test_a_sequence_ranks_as_in_an_evaluation(dataset, method):
    """Its queries have been fused with the retrieval before."""
    sift, cache = Sift(), FeatureCache()
    pipeline = mfvpr.Pipeline(sift, Retrieval(Aggregated(sift, VladFitting())))
    fused = mfvpr.System(pipeline, {"mine": MyScorer()}, {"mine": Fusion(0.5)}, final="mine + retrieval",
                         sequences={"mine + retrieval": (DriveFilter(method),)})  # fmt: skip
    rows = mfvpr.sweep(dataset, fused, cache=cache, sigma=[5, 22.5]).outcome.rows
    for number, sigma in enumerate((5.0, 22.5)):
        system = replace(fused, scorers={"mine": MyScorer(sigma)})
        [ranked] = mfvpr.evaluate(dataset, system, cache=cache).only.systems[f"mine + retrieval + {method} sequence"]
        np.testing.assert_array_equal(rows[0, number], ranked.rows[:, : rows.shape[-1]])
    twice = replace(fused, sequences={"mine + retrieval": (DriveFilter(method), DriveFilter("lagged"))})
    with pytest.raises(mfvpr.InputError, match=r"at most one of mine \+ retrieval, got 2"):
        mfvpr.sweep(dataset, twice, cache=cache, sigma=[5])


def test_choosing_for_a_sequence_sees_nothing_of_the_reported_half(dataset):
    """Other scores of the queries that are reported on change no row that is chosen by."""
    sift, cache, number = Sift(), FeatureCache(), len(dataset.queries)
    pipeline = mfvpr.Pipeline(sift, Retrieval(Aggregated(sift, VladFitting())))
    system = mfvpr.System(pipeline, {"mine": MyScorer()}, sequences={"mine": [DriveFilter("smoothed")]})
    swept = mfvpr.sweep(dataset, system, cache=cache, sigma=[5, 22.5], split="both", thresholds=[1])
    rng, protocol = np.random.default_rng(0), swept.outcome.protocol
    rows, scores = np.tile(np.arange(number), (number, 1)), rng.uniform(size=(number, number))
    ranking = DriveRanking(DriveFilter("smoothed"), number, halves=protocol.halves)
    for view, half in enumerate(protocol.halves, start=1):
        assert np.isin(swept.outcome.rows[view][:, half.tune], [-1, *np.flatnonzero(half.allowed)]).all()
        changed = scores.copy()
        changed[half.report] = rng.uniform(size=(len(half.report), number))
        first, second = (ranking.rows(Ranked(rows, each), view)[half.tune] for each in (scores, changed))
        np.testing.assert_array_equal(first, second)


def test_files_are_whole_and_the_same_call_computes_nothing_again(sweep, swept, monkeypatch, tmp_path):
    out, result = swept
    names = {"figures", "rankings", "results.json", "summary.txt", "table.csv", "table.md", "table.tex"}
    assert {path.name for path in out.iterdir()} == names
    assert (out / "table.csv").read_text() == result.table().csv()
    assert json.loads((out / "results.json").read_text())["axes"] == AXES
    assert [path.name for path in (out / "figures").iterdir()] == ["sigma_weight.png"]
    monkeypatch.setattr(rankings, "pair_scores", lambda *_: pytest.fail("computed again"))
    assert str(sweep(MyScorer(), **AXES, split="both", out=out).table()) == str(result.table())
    with pytest.raises(mfvpr.InputError, match="has the result of a sweep of other axes"):
        sweep(MyScorer(), sigma=[5], out=out)
    for _ in range(2):
        result.save(tmp_path / "saved")
    (tmp_path / "thesis" / "figures").mkdir(parents=True)
    with pytest.raises(mfvpr.InputError, match="thesis: expected a new or empty folder"):
        result.save(tmp_path / "thesis")
    assert (tmp_path / "thesis" / "figures").is_dir()
    figure = result.plot("weight", "sigma")
    assert [figure.axes[0].get_ylabel(), figure.axes[0].get_xlabel()] == ["weight", "sigma"]


def test_a_system_that_ranks_by_a_fused_score_is_swept_by_it(sweep):
    sift = Sift()
    pipeline = mfvpr.Pipeline(sift, Retrieval(Aggregated(sift, VladFitting())))
    fused = mfvpr.System(pipeline, {"mine": MyScorer()}, {"mine": Fusion(c=30.0)}, final="mine + retrieval")
    by_system = sweep(fused, sigma=[5, 22.5])
    assert by_system.outcome.axes.own_values == {"c": 30.0, "sigma": 10.0}
    explicit = sweep(MyScorer(), c=[30.0], sigma=[5, 22.5])
    np.testing.assert_array_equal(by_system.outcome.rows[:, :2], explicit.outcome.rows[:, :2])


@pytest.mark.parametrize(("scorer", "options", "words"), [
    (MyScorer(), {}, "sweep: expected at least one axis"),
    (MyScorer(), {"sgma": [1]}, "sgma: expected a parameter of MyScorer, of sigma, weight, max_distance, c"),
    (MyScorer, {"sigma": [1]}, r"got <class .*MyScorer"),
    (MyScorer(), {"sigma": [1], "out": __file__}, "out=.*: expected a new or empty folder"),
])  # fmt: skip
def test_mistakes_are_one_line_before_any_work(dataset, monkeypatch, scorer, options, words):
    monkeypatch.setattr("mfvpr.cli.sweeping.match_sequence", lambda *_, **__: pytest.fail("begun"))
    with pytest.raises(mfvpr.InputError, match=words) as error:
        mfvpr.sweep(dataset, scorer, **options)
    assert "\n" not in str(error.value)
