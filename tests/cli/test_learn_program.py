"""`mfvpr learn` as its users meet it: what it learns from, what it reports, its checkpoints, and mistakes."""

import csv
import json
import shutil

import numpy as np
import pytest

from mfvpr.baselines.learned_weight import read_weight
from mfvpr.cli import evaluation, learning, sweeping
from mfvpr.tuning.learning import models, training
from mfvpr.tuning.learning.splits import TrainingSplit
from mfvpr.tuning.learning.training import Fit, Record
from tests.programs import QUERIES, job_of, results, settings_of, small

pytestmark = pytest.mark.slow

SUM = ("scorer=sum",)
SHORT = (*SUM, "split=first_half", "steps=4", "every=2", "batch=4", "learning_rate=0.05")
ROWS = [name + fused for name in ("paper", "1 - ratio", "grid search", "gradient", "match weights", "match labels")
        for fused in ("", " + retrieval")]  # fmt: skip
WIDEST = 1  # frames


@pytest.fixture(scope="session")
def learn(root):
    """Learns into a folder."""
    return job_of(root, "learn", learning.learn, (learning.searches, "comparison_figures"))


@pytest.fixture(scope="session")
def learned(learn, tmp_path_factory):
    out = tmp_path_factory.mktemp("learned") / "out"
    return out, learn(out, *SHORT, pictures=True)


@pytest.fixture
def untrained(monkeypatch):
    """Replace the training by its start values, and record its options."""
    calls = []

    def start(parameters, objective, batches, schedule, **options):
        calls.append(options)
        for step in range(schedule.steps):
            batches(step)
        return Fit(parameters, 0, (Record(0, None, 1.0),), "nothing was learned")

    monkeypatch.setattr(models, "fit", start)
    return calls


def rows_of(results):
    return {row["score"]: row for row in results["rows"]}


def test_all_rows_in_every_file(learned):
    out, content = learned
    assert [row["score"] for row in content["rows"]] == ROWS
    with (out / "table.csv").open() as file:
        header, *lines = csv.reader(file)
    assert header == ["score", "R@1 ±0", "R@1 ±1", "95 % at ±1", "against paper", "p", "p along the path"]
    assert [line[0] for line in lines] == ROWS
    for line, row in zip(lines, content["rows"], strict=True):
        assert [float(cell) for cell in line[1:3]] == [round(100 * value, 1) for value in row["recall_at_1"].values()]
        for tolerance, (low, high) in row["interval"].items():
            assert 0 <= low <= row["recall_at_1"][tolerance] <= high <= 1
    trained = [row["halves"]["first_half"] for row in content["rows"][6:10]]
    for fit in trained:
        assert [record[0] for record in fit["history"]] == [0, 2, 4]
        assert fit["steps"] in (0, 2, 4)
        assert fit["values"]["temperature"] > 0
    assert [sorted(fit["values"]) for fit in trained] == 2 * [["temperature"], ["c", "temperature"]]
    assert any(fit["steps"] > 0 for fit in trained)
    assert (out / "figures" / "curves.png").is_file()
    for name in ("match_weights", "match_weights_retrieval", "match_labels"):
        weight, origin = read_weight(out / "weights" / f"first_half_{name}.json")
        assert weight.hidden.shape == (5, 16)
        assert origin["settings"]["seed"] == 0
        assert origin["training"].startswith("first_half: match ")


def test_hand_set_and_searched_rows_are_those_of_a_sweep(root, learned, tmp_path):
    grid = ("scorer=sum", "split=first_half", "grid.weight=[fs,dmf,ratio,unit]")
    sweeping.sweep_program(settings_of(*small(root), *grid, f"out={tmp_path}/out", config="sweep"))
    swept = results(tmp_path / "out")
    rows = rows_of(learned[1])
    assert [rows["grid search"]["halves"]["first_half"]["values"]] == swept["chosen"]
    for line in swept["report"]:
        for row, name in (("paper", "own"), ("grid search", "chosen")):
            assert rows[row]["recall_at_1"][f"{line['threshold']}"] == pytest.approx(line[name]["recall"])


def test_nothing_that_is_reported_on_was_seen(learn, untrained, tmp_path, monkeypatch):
    """Check both halves: neither the reported queries and places nor their neighbors, while learning or validating."""
    seen, batch = [], TrainingSplit.batch

    def watched(split, queries, size):
        seen.append((split, queries))
        return batch(split, queries, size)

    monkeypatch.setattr(TrainingSplit, "batch", watched)
    content = learn(
        tmp_path / "out", *SUM, "split=both", "steps=6", "batch=2", "fusion.retrieval_score=negative_euclidean"
    )
    reported = dict(zip(("first_half", "second_half"), content["queries"]["reported"], strict=True))
    assert sorted(query for half in reported.values() for query in half) == list(range(QUERIES))
    for chosen_on, (half, reported_rows) in zip(content["queries"]["chosen_on"], reported.items(), strict=True):
        assert len(chosen_on) >= 8
        assert min(abs(row - other) for row in chosen_on for other in reported_rows) > 2 * WIDEST
        taught = {int(query) for split, queries in seen if split.name == half for query in queries}
        assert len(taught) >= 5
        assert taught <= set(chosen_on)
    for split, queries in seen:
        assert np.all(split.candidates.scores < 0)  # as it was asked
        places = {int(place) for query in queries for place in split.candidates.indices[query][split.usable[query]]}
        assert min(abs(place - other) for place in places for other in reported[split.name]) > WIDEST
        assert min(abs(row - other) for row in split.train for other in split.validation) > 2 * WIDEST
        assert {*queries} <= {*split.train} or {*queries} <= {*split.validation}


@pytest.mark.parametrize("changes", [(), ("matching.max_distance=0.3", "ties=index")])
def test_the_papers_rows_are_an_evaluation(root, learn, untrained, tmp_path, changes):
    changes = ("scorer=sum", "fusion.c=1e6", *changes)
    rows = rows_of(learn(tmp_path / "out", *SUM, *changes, "steps=1"))
    evaluation.evaluate(settings_of(*small(root), *changes, "figures=0", f"out={tmp_path}/evaluated"))
    expected = json.loads((tmp_path / "evaluated" / "results.json").read_text())
    names = {"sum": "paper", "sum + retrieval": "paper + retrieval"}
    for row in expected:
        if row["system"] in names:
            recall = rows[names[row["system"]]]["recall_at_1"][f"{row['tolerance']}"]
            assert recall == pytest.approx(row["recall_at"]["1"], abs=1e-6)


def test_an_interrupted_learning_goes_on_to_the_same_end(root, learn, learned, tmp_path, monkeypatch):
    saved, save = [], training.save_checkpoint

    def interrupted(folder, state):
        saved.append((folder.name.rpartition("-")[0], state.step))
        if len(saved) == 4:
            raise KeyboardInterrupt
        save(folder, state)

    monkeypatch.setattr(training, "save_checkpoint", interrupted)
    again = (*SHORT, f"checkpoints={tmp_path}/kept")
    with pytest.raises(KeyboardInterrupt):
        learn(tmp_path / "out", *again)
    assert [path.name for path in tmp_path.iterdir()] == ["kept"]
    assert learn(tmp_path / "out", *again) == learned[1]
    assert saved[:4] == [(f"first_half-gradient{more}", step) for more in ("", "_retrieval") for step in (2, 4)]
    assert saved[4:6] == [("first_half-gradient_retrieval", 4), ("first_half-match_weights", 2)]


def test_whatever_changes_the_result_changes_the_checkpoint(root, untrained, tmp_path, monkeypatch):
    """Else one training would go on with what another one left."""
    monkeypatch.setattr(learning.searches, "comparison_figures", lambda *_: [])
    shifted = tmp_path / "shifted.csv"
    shifted.write_text("query,database\n" + "".join(f"{row},{(row + 1) % QUERIES}\n" for row in range(QUERIES)))
    changes = [
        "seed=0", "seed=1", "hidden=4", "inputs=absolute", "batch=3", "learning_rate=0.5", "loss=recall",
        "candidates=7", "every=1", "fusion.retrieval_score=negative_euclidean", f"dataset.index_file={shifted}",
    ]  # fmt: skip
    for change in changes:
        fixed = (*SUM, "grid.c=[1]", "split=second_half", "steps=1", f"out={tmp_path}/out")
        learning.learn(settings_of(*small(root), *fixed, change, config="learn"))
        shutil.rmtree(tmp_path / "out")
    assert len({json.dumps(call["checkpoints"].recipe) for call in untrained}) == 5 * len(changes)
