"""Run folders: their files, also after errors, on full disks, and with names that are not UTF-8."""

import json
import os
import resource
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mfvpr.cli import evaluation, jobs
from mfvpr.datasets import AllowedTruth, Positives
from mfvpr.evaluation import mcnemar
from mfvpr.report import runs
from mfvpr.report.figures import SequenceFigures, query_figures
from mfvpr.utils.errors import InputError
from tests.programs import CANDIDATES, QUERIES, ROOT, composed, csv_rows, settings_of, small

pytestmark = pytest.mark.thorough

LINES = ("scorer=histogram", "figures=4")
SYSTEMS = ("retrieval", "histogram", "histogram + retrieval")


@pytest.fixture(scope="session")
def evaluated(root, tmp_path_factory):
    out = tmp_path_factory.mktemp("evaluated") / "out"
    evaluation.evaluate(settings_of(*small(root), *LINES, f"out={out}"))
    return out


@pytest.fixture(scope="session")
def outcome(root):
    return evaluation.evaluation_of(settings_of(*small(root), *LINES, "candidates=3"))


# --- contents ----------------------------------------------------------------------------------------------------


def test_predictions_are_long_and_agree_with_the_recall(evaluated):
    entries = json.loads((evaluated / "results.json").read_text())
    for system in SYSTEMS:
        lines = csv_rows(evaluated / "predictions" / f"{system.replace(' + ', '_')}.csv")
        assert list(lines[0]) == ["query", "rank", "database", "score", "correct", "refused"]
        assert [int(line["rank"]) for line in lines] == QUERIES * [*range(1, CANDIDATES + 1)]
        scores = np.array([float(line["score"]) for line in lines]).reshape(QUERIES, -1)
        assert np.all(np.diff(scores) <= 0)
        correct = np.array([int(line["correct"]) for line in lines]).reshape(QUERIES, -1)
        recall = next(row["recall_at"] for row in entries if row["system"] == system and row["tolerance"] == 1)
        assert correct[:, 0].mean() == pytest.approx(recall["1"], abs=1e-6)
        assert correct[:, :5].any(axis=1).mean() == pytest.approx(recall["5"], abs=1e-6)
    assert (evaluated / "predictions.csv").read_bytes() == (evaluated / "predictions" / "histogram.csv").read_bytes()


def test_gains_are_what_the_predictions_say_of_each_query(evaluated):
    gains, hits = csv_rows(evaluated / "gains.csv"), {}
    assert [line["place"] for line in gains] == [*map(str, range(QUERIES))]
    for system in SYSTEMS:
        lines = csv_rows(evaluated / "predictions" / f"{system.replace(' + ', '_')}.csv")
        for line in gains:
            correct = [entry["rank"] for entry in lines if entry["query"] == line["query"] and entry["correct"] == "1"]
            assert line[f"{system} rank"] == (correct[0] if correct else "")
            assert line[system] == str(int(correct[:1] == ["1"]))
        hits[system] = np.array([line[system] == "1" for line in gains])
    assert {line["histogram rank"] for line in gains} > {"", "1"}
    *_, line = csv_rows(evaluated / "differences.csv")
    first, second = hits[line["system"]], hits[line["other"]]
    assert [line["only_system"], line["only_other"]] == [str((first > second).sum()), str((first < second).sum())]
    assert float(line["mcnemar_p"]) == pytest.approx(mcnemar(first, second).p_value, rel=1e-6)


def test_without_ground_truth_nothing_is_right_or_failed(root, tmp_path, capsys):
    none = ("dataset.ground_truth=none", "dataset.index_file=null", "figures=2", f"out={tmp_path}/out")
    evaluation.evaluate(settings_of(*small(root), *LINES, *none))
    assert "no ground truth: rankings only" in capsys.readouterr().out
    entries = json.loads((tmp_path / "out" / "results.json").read_text())
    assert [(row["system"], row["recall_at"]) for row in entries] == [(system, {}) for system in SYSTEMS]
    assert {line["correct"] for line in csv_rows(tmp_path / "out" / "predictions.csv")} == {""}
    files = {"results.json", "run.json", "predictions.csv", "predictions", "shifts.csv", "figures", "report.html"}
    assert {path.name for path in (tmp_path / "out").iterdir()} == files
    assert {path.name.split("_")[0] for path in (tmp_path / "out" / "figures").iterdir()} == {"best"}
    assert json.loads((tmp_path / "out" / "run.json").read_text())["ground_truth"]["kind"] == "none"


def test_results_heading_and_tables_say_what_made_them(evaluated):
    entries = json.loads((evaluated / "results.json").read_text())
    for row in entries:
        assert {*row["recall_at"]} == {"1", "5"}
        assert (row["queries"], row["database"], row["candidates"]) == (QUERIES, QUERIES, CANDIDATES)
        assert {"data", "features", "retrieval", "scores"} <= {*row["seconds"]}
        assert {"mfvpr", "jax", "numpy"} <= {*row["versions"]}
    assert next(row for row in entries if row["system"] == "histogram")["parameters"]["sigma"] == 22.5
    truth = entries[0]["ground_truth"]
    assert (truth["kind"], truth["unit"], truth["thresholds"]) == ("index", "frames", [0, 1])
    heading, *_ = (evaluated / "table.md").read_text().splitlines()
    assert heading == entries[0]["description"]
    for line in csv_rows(evaluated / "table.csv"):
        assert f"{' & '.join(line.values())} \\\\\n" in (evaluated / "table.tex").read_text()


def test_a_run_says_how_it_was_made(root, tmp_path, monkeypatch, succeed):
    subprocess.run(["git", "init", "--quiet", tmp_path], check=True)
    identity = ("-c", "user.name=a", "-c", "user.email=a@b.c")
    subprocess.run(["git", *identity, "commit", "--quiet", "--allow-empty", "-m", "x"], cwd=tmp_path, check=True)
    monkeypatch.chdir(tmp_path)
    stdout, _ = succeed("evaluate", *small(root), "scorer=count", "figures=0", "out=a b")
    assert stdout.endswith("results: a b\nreport: a b/report.html\n")
    content = json.loads((tmp_path / "a b" / "run.json").read_text())
    assert content["command"].endswith(" scorer=count figures=0 'out=a b'")
    assert content["settings"] == composed(*small(root), "scorer=count", "figures=0", "out='a b'") | {"cluster": {}}
    head = subprocess.run(["git", "rev-parse", "HEAD"], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert content["commit"] == head.stdout.strip()
    assert runs.commit(Path("/")) is None


def test_a_wrong_figure_has_the_right_image_below(evaluated, outcome):
    assert len([*(evaluated / "figures").glob("*_0*.png")]) == 4
    page = page_of(outcome)
    [ranked], correct = outcome.report.ranked.systems["histogram"], outcome.report.correct["histogram"]
    query_by_case = {bool(correct[query].any()): query for query in np.flatnonzero(~correct[:, 0])}
    names = outcome.report.ranked.dataset.database.names
    query = query_by_case[True]
    rank = int(np.argmax(correct[query]))
    [prediction] = page.correct_candidates(query)
    score = f"{ranked.scores[query, rank]:.5g}"
    assert prediction.caption == f"correct: {names[ranked.rows[query, rank]]}, rank {rank + 1}, score {score}"
    assert float(prediction.explanation.score) == pytest.approx(float(score), rel=1e-3)
    [prediction] = page.correct_candidates(query_by_case[False])
    place = outcome.report.ranked.dataset.truth.place(query_by_case[False])
    assert prediction.caption == f"correct: {names[place]}, not among the 3 candidates"
    assert prediction.matches is None


def page_of(outcome, **changes):
    ranked = outcome.report.ranked
    dataset = replace(ranked.dataset, sequences=(replace(ranked.dataset.only, **changes),))
    report = replace(outcome.report, ranked=replace(ranked, dataset=dataset))
    return SequenceFigures(report, 0)


def test_what_does_not_count_is_never_shown_as_right(outcome):
    """If the nearest image is excluded, the page shows another correct image, or none."""
    correct = outcome.report.correct["histogram"]
    query = int(np.flatnonzero(~correct.any(axis=1))[0])
    names, truth = outcome.report.ranked.dataset.database.names, outcome.report.ranked.dataset.truth
    excluded = np.zeros((len(outcome.report.ranked.dataset.queries), len(names)), bool)
    excluded[query, truth.place(query)] = True

    def predictions(excluded):
        page = page_of(outcome, truth=AllowedTruth(truth, Positives(excluded)))
        return [prediction.caption for prediction in page.correct_candidates(query)]

    other = int(np.argmax(outcome.report.positives.dense()[query] & ~excluded[query]))
    assert predictions(excluded) == [f"correct: {names[other]}, not among the 3 candidates"]
    assert predictions(np.ones_like(excluded)) == []


def test_figures_of_chosen_queries(outcome):
    query_rows, dataset = evaluation.query_rows, outcome.report.ranked.dataset
    assert query_rows([5, "0002.png", 5], dataset) == [5, 2]
    assert query_rows(7, dataset) == 7
    for incorrect in (24, -1, "nope.png"):
        with pytest.raises(InputError, match=r"rows .*0 to 23, .*0000"):
            query_rows([0, incorrect], dataset)
    assert list(page_of(outcome).outcomes([5, 2])) == [5, 2]


def test_figures_of_refused_queries_say_so(outcome, tmp_path, monkeypatch):
    correct, drawn = outcome.report.correct["histogram"], []
    first, second = (int(np.flatnonzero(correct[:, 0] == hit)[0]) for hit in (True, False))
    refuses = {"histogram": lambda ranked: np.where(np.isin(np.arange(QUERIES), [first, second]), 0.1, 0.9)}
    report = replace(outcome.report, confidences=refuses, least_confidence=0.5)
    page, words = SequenceFigures(report, 0), {True: "correct", False: "incorrect"}
    expected = {query: words[bool(hit)] for query, hit in enumerate(correct[:, 0])}
    assert page.outcomes([*range(QUERIES)]) == expected | {first: "refused", second: "refused"}
    assert page.outcomes(4).keys() == page_of(outcome).outcomes(4).keys()
    draw_pair = lambda _, image, candidates, **words: drawn.append((len(candidates), words))  # noqa: E731
    monkeypatch.setattr("mfvpr.report.figures.histogram_figure", draw_pair)
    figures = {name: draw for name, draw in query_figures(report, [first, second])}
    assert [*figures] == [f"refused_{query:04d}.png" for query in (first, second)]
    for draw in figures.values():
        draw(tmp_path / "figure.png")
    assert [count for count, _ in drawn] == [1, 2]  # below an incorrect candidate, a correct one
    assert [words["about"]["outcome"] for _, words in drawn] == ["refused"] * 2
    assert all("histogram, refused (low confidence): " in words["title"] for _, words in drawn)


# --- the claim ---------------------------------------------------------------------------------------------------


def test_a_folder_in_use_is_refused_at_the_start(root, tmp_path, monkeypatch, call):
    monkeypatch.setattr(evaluation, "evaluation_of", lambda *_: pytest.fail("it was begun"))
    with runs.claim_run_folder(tmp_path / "out"):
        code, stdout, stderr = call("evaluate", *small(root), f"out={tmp_path}/out")
    assert (code, stdout, stderr.count("\n")) == (2, "", 1)
    assert stderr.startswith(f"error: {tmp_path}/out: another run")
    assert list(tmp_path.iterdir()) == []


def test_the_claim_of_a_killed_run_is_free(tmp_path):
    code = ("import sys; from pathlib import Path; from mfvpr.report import runs\n"
            "with runs.claim_run_folder(Path(sys.argv[1])) as folder, runs.writing(folder) as new:\n"
            "    (new / 'half').write_text('written'); print('held', flush=True); sys.stdin.read()")  # fmt: skip
    process = subprocess.Popen([sys.executable, "-c", code, tmp_path / "out"], cwd=ROOT, stdin=subprocess.PIPE,
                               stdout=subprocess.PIPE, text=True)  # fmt: skip
    with process:
        assert process.stdout.readline() == "held\n"
        with pytest.raises(InputError, match="another run is using"), runs.claim_run_folder(tmp_path / "out"):
            pass
        process.send_signal(signal.SIGKILL)
    assert list((tmp_path / "out").iterdir()) != []
    with runs.claim_run_folder(tmp_path / "out") as folder:
        assert list(folder.iterdir()) == []
        with runs.writing(folder) as new:
            (new / "results.json").write_text("all")
    assert [path.name for path in folder.iterdir()] == ["results.json"]


# --- what goes wrong at the end ----------------------------------------------------------------------------------


def test_a_full_disk_costs_no_table(root, evaluated, tmp_path, call, monkeypatch):
    """The table is printed if files cannot grow beyond 2,000 bytes, as on a full disk."""
    before, write_results = resource.getrlimit(resource.RLIMIT_FSIZE), jobs.write_results

    def limited(*arguments, **named):
        resource.setrlimit(resource.RLIMIT_FSIZE, (2000, before[1]))
        try:
            write_results(*arguments, **named)
        finally:  # at once: the log of the tests is a file, too
            resource.setrlimit(resource.RLIMIT_FSIZE, before)

    monkeypatch.setattr(jobs, "write_results", limited)
    code, stdout, stderr = call("evaluate", *small(root), *LINES, f"out={tmp_path}/out")
    assert code == 2
    assert "\nhistogram + retrieval " in stdout
    assert stderr.splitlines()[-1].endswith(": File too large")
    assert list(tmp_path.iterdir()) == []


def test_a_figure_that_cannot_be_drawn_costs_a_warning(root, evaluated, tmp_path, monkeypatch, succeed):
    def fail(*_, **__):
        raise OSError("full")

    monkeypatch.setattr("mfvpr.report.figures.histogram_figure", fail)
    _, stderr = succeed("evaluate", *small(root), *LINES, "figures=2", f"out={tmp_path}/out")
    assert stderr.count("not drawn (full)") == 2
    assert (tmp_path / "out/predictions.csv").read_bytes() == (evaluated / "predictions.csv").read_bytes()
    assert "/queries in " in (tmp_path / "out/report.html").read_text("utf-8").partition("</title>")[0]


def test_ctrl_c_while_figures_are_drawn_keeps_the_tables(root, evaluated, tmp_path, monkeypatch, call):
    monkeypatch.setattr("mfvpr.report.figures.histogram_figure", lambda *_, **__: os.kill(os.getpid(), signal.SIGINT))
    code, stdout, stderr = call("evaluate", *small(root), *LINES, f"out={tmp_path}/out")
    assert code == 130
    assert "\nhistogram + retrieval " in stdout
    assert stderr.splitlines()[-1].startswith("interrupted")
    names = {path.name for path in evaluated.iterdir()} - {"figures", "report.html"}
    assert {path.name for path in (tmp_path / "out").iterdir()} == names
