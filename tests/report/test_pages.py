"""Pages of run folders: their contents, hostile names, and files that are no run."""

import base64
import hashlib
import json
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser

import numpy as np
import pytest

from mfvpr.evaluation import mcnemar, precision_recall
from mfvpr.evaluation.statistics import path_test, recall_interval
from mfvpr.report import pages
from mfvpr.report.pages import write_comparison, write_report
from mfvpr.utils import InputError
from tests.programs import typed
from tests.run_folders import HEADLINE, HOSTILE, RANKS, SYSTEMS, TOLERANCES, ranking, write_run

pytestmark = pytest.mark.thorough

TWO = ("</style><b onclick=alert(3)>", "{{7*7}}")


class Parsed(HTMLParser):
    """A page as a browser's parser sees it: elements, texts by element, and rows of cells."""

    def __init__(self, path):
        super().__init__()
        self.elements, self.open, self.text, self.rows, self.scripts = [], [], "", [], []
        self.feed(path.read_text("utf-8"))

    def handle_starttag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))
        self.open = [*self.open, tag]
        if tag == "tr":
            self.rows.append([])
        elif tag in ("td", "th"):
            self.rows[-1].append("")
        elif tag == "script":
            self.scripts.append("")

    def handle_endtag(self, tag):
        self.open = self.open[: len(self.open) - 1 - self.open[::-1].index(tag)]

    def handle_data(self, data):
        if self.open[-1:] == ["script"]:
            self.scripts[-1] += data
        elif self.open[-1:] != ["style"]:
            self.text += data
            if {"td", "th"} & {*self.open}:
                self.rows[-1][-1] += data

    def of(self, tag):
        return [attributes for name, attributes in self.elements if name == tag]

    @property
    def charts(self):
        charts = json.loads(self.scripts[0], parse_constant=lambda word: pytest.fail(f"{word} is not JSON"))
        return {chart["name"]: chart for chart in charts}


def text_on_page(text):
    """A name as a parser reads it from a page: every end of a line is the same."""
    return text.encode("utf-8", "backslashreplace").decode().replace("\r", "\n")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return write_run(tmp_path_factory.mktemp("runs") / "one")


@pytest.fixture(scope="module")
def page(run):
    return Parsed(write_report(run))


@pytest.fixture(scope="module")
def several(tmp_path_factory):
    return Parsed(write_report(write_run(tmp_path_factory.mktemp("runs") / "several", sequences=TWO)))


def test_names_are_nothing_but_text(page, several):
    for parsed in (page, several):
        for name in (*HOSTILE, SYSTEMS[2], TWO[0]):
            assert text_on_page(name) in parsed.text.replace("\r", "\n")
        assert len(parsed.scripts) == 3
        attributes = {name for _, names in parsed.elements for name in names}
        assert not {name for name in attributes if name.startswith("on")}
        assert not {tag for tag, _ in parsed.elements} & {"b", "svg", "iframe", "object"}
        assert len(parsed.of("img")) == len(parsed.of("figcaption"))
        assert not re.search(r"[<>&]", parsed.scripts[0])


def test_nothing_comes_from_elsewhere(page):
    for tag, attributes in page.elements:
        assert not {"srcset", "action", "style", "data", "formaction"} & {*attributes}
        assert attributes.get("src", "data:").startswith("data:")
        assert attributes.get("href", "#").startswith("#")
        assert tag not in ("link", "base", "iframe", "object", "embed")
    [policy] = [meta["content"] for meta in page.of("meta") if "default-src" in meta.get("content", "")]
    assert policy.startswith("default-src 'none'; script-src 'sha256-")
    assert "img-src data:" in policy
    for script in page.scripts[1:]:
        assert f"'sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}'" in policy


def test_a_page_replaces_only_a_page(run, tmp_path):
    first = write_report(run, tmp_path / "page.html").read_bytes()
    assert write_report(run, tmp_path / "page.html").read_bytes() == first
    (tmp_path / "query.jpg").write_bytes(b"precious")
    with pytest.raises(InputError, match=r"query\.jpg: expected a new file"):
        write_comparison([run], tmp_path / "query.jpg")
    assert (tmp_path / "query.jpg").read_bytes() == b"precious"


def test_recall_and_its_intervals_are_those_of_the_files(page):
    table = page.rows[: len(SYSTEMS) + 1]
    assert table[0] == ["system", "R@1 ±0", "R@1 ±2", "R@1 ±5", "R@2 ±2", "R@1 ±2, 95 %"]
    for row, name in zip(table[1:], SYSTEMS, strict=True):
        hits = np.array(RANKS[name]) == 1
        low, high = recall_interval(hits)
        assert [row[0], row[2], row[-1]] == [name, f"{100 * hits.mean():.1f}", f"[{100 * low:.1f}, {100 * high:.1f}]"]
    for (_, points), ranks in zip(page.charts["depths"]["data"], RANKS.values(), strict=True):
        assert points == [[k, 10 * sum(0 < rank <= k for rank in ranks)] for k in (1, 2, 3)]
    [[_, bars]] = page.charts["intervals"]["data"]
    assert [(name, recall) for name, recall, _ in bars] == [*zip(SYSTEMS, (30.0, 80.0, 60.0), strict=True)]
    assert bars[0][2] == [100 * end for end in recall_interval(np.array(RANKS["retrieval"]) == 1)]
    for (_, points), ranks in zip(page.charts["tolerances"]["data"], RANKS.values(), strict=True):
        distance = np.abs(ranking(ranks).rows[:, 0] - np.arange(10))
        assert points == [[at, pytest.approx(100 * np.mean(distance <= at))] for at in TOLERANCES]
    [name, points] = page.charts["precision-score"]["data"][1]
    curve = precision_recall(ranking(RANKS[HEADLINE]).scores[:, 0], np.array(RANKS[HEADLINE]) == 1)
    assert name == f"{HEADLINE}: AP {100 * curve.average_precision:.1f}"
    np.testing.assert_allclose(points, 100 * np.stack([curve.recall, curve.precision], axis=1), atol=1e-3)


def test_sequences_have_bars_and_rows_of_their_own(several):
    for group, name in zip(several.charts["intervals"]["data"], SYSTEMS, strict=True):
        assert group[0] == name
        assert [recall for _, recall, _ in group[1]] == [10.0 * RANKS[name].count(1)] * 3
    rows = several.rows[1 : 1 + 4 * len(SYSTEMS)]
    assert [row[1] for row in rows] == [*TWO, "mean", "pooled"] * len(SYSTEMS)
    hits = np.repeat(np.array(RANKS["retrieval"]) == 1, 2)  # two drives, in the order of the one map
    low, high = recall_interval(hits)
    assert [row[-1] for row in rows[2:4]] == ["", f"[{100 * low:.1f}, {100 * high:.1f}]"]


def test_answers_are_pictures_and_rows(page, several, run):
    images = page.of("img")
    assert [image["alt"].split()[0] for image in images] == ["correct", "incorrect"]
    assert text_on_page(HOSTILE[6]) in images[1]["alt"]
    for image in images:
        assert (image["width"], image["height"]) == ("1000", "231")
        assert base64.b64decode(image["src"].removeprefix("data:image/jpeg;base64,"))[:3] == b"\xff\xd8\xff"
    rows = [row for row in page.rows if len(row) == 6 and row[4] in ("correct", "incorrect")]
    assert [row[0] for row in rows] == [HEADLINE] * 10 + ["retrieval"] * 10 + [SYSTEMS[2]] * 10
    expected = [HEADLINE, text_on_page(HOSTILE[3]), text_on_page(HOSTILE[-1]), "13", "incorrect", "2"]
    assert [cell.replace("\r", "\n") for cell in rows[3]] == expected
    assert [choice["id"] for choice in page.of("select")] == ["filter-system", "filter-outcome"]
    assert [choice["id"] for choice in several.of("select")] == ["filter-system", "filter-sequence", "filter-outcome"]
    assert len([row for row in several.rows if len(row) == 7 and row[5] in ("correct", "incorrect")]) == 60


@pytest.mark.parametrize("truth", [True, False])
def test_refused_queries_are_neither_correct_nor_incorrect(tmp_path, truth):
    page = Parsed(write_report(write_run(tmp_path / "run", truth=truth, sequences=TWO, refused=(6, 9))))
    words = {0: "incorrect", 1: "correct"} if truth else dict.fromkeys((0, 1), "best")
    outcomes = [words[rank == 1] for rank in RANKS[HEADLINE]]
    outcomes[6] = outcomes[9] = "refused"
    rows = [row for row in page.rows if len(row) == 7 and row[5] in (*words.values(), "refused")]
    assert [row[5] for row in rows if row[0] == HEADLINE] == outcomes * 2
    assert "refused" not in {row[5] for row in rows if row[0] != HEADLINE}  # the system that decides refuses alone
    assert {row[3] for row in rows if row[5] == "refused"} == {text_on_page(HOSTILE[0]), text_on_page(HOSTILE[-1])}
    shown = [span["class"] for span in page.of("span") if "outcome" in span.get("class", "")]
    assert shown.count("outcome refused") == 2 + 4  # pictures and rows
    assert [image["alt"].split()[0] for image in page.of("img")] == ["correct", "refused"] * 2


def test_without_ground_truth_there_are_answers_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(pages, "MOST_PREDICTIONS", 7)
    page = Parsed(write_report(write_run(tmp_path / "run", truth=False)))
    assert page.charts == {}
    assert [row[4] for row in page.rows if len(row) == 6 and row[0] in SYSTEMS] == ["best"] * 7
    assert "It has the first 7" in page.text


def test_runs_of_the_same_queries_are_compared_query_by_query(tmp_path):
    other = RANKS | {HEADLINE: [2, 0, 1, 1, 1, 1, 1, 0, 0, 0]}
    runs = [write_run(tmp_path / "a"), write_run(tmp_path / "b", ranks=other)]
    write_comparison(runs, tmp_path / "page.html")
    page = Parsed(tmp_path / "page.html")
    hits = [np.array(ranks[HEADLINE]) == 1 for ranks in (RANKS, other)]
    test, path = mcnemar(*hits), path_test(*hits)
    [row] = [row for row in page.rows if row and row[0] == f"a: {HEADLINE}"]
    assert row == [f"a: {HEADLINE}", f"b: {HEADLINE}", "5", "2", *(f"{value:.2g}" for value in (test.p_value, *path))]
    [[_, bars]] = page.charts["intervals"]["data"]
    assert [recall for _, recall, _ in bars] == [80.0, 50.0]
    recalls = [row[:2] for row in page.rows if row[0] in ("a", "b") and row[1] in SYSTEMS]
    assert recalls == [[run, system] for run in "ab" for system in SYSTEMS]
    truth = json.loads((runs[0] / "results.json").read_text("utf-8"))[0]["ground_truth"]
    changes = {
        "other images": {"data_fingerprint": {"database": "1"}},
        "other queries": {"sequences": TWO, "ground_truth": truth},
        "another ground truth": {"ground_truth": {"kind": "order", "unit": "m", "thresholds": [25]}},
    }
    others = [write_run(tmp_path / name, **values) for name, values in changes.items()]
    write_comparison([runs[0], *others], tmp_path / "page.html")
    pairs = [row for row in Parsed(tmp_path / "page.html").rows if row[0] == f"a: {HEADLINE}"]
    assert pairs == [[f"a: {HEADLINE}", f"{reason}: {HEADLINE}", reason] for reason in changes]


def test_the_program_says_where_the_page_is_or_what_is_wrong(run, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    again = write_run(tmp_path / "again")
    for arguments, page in (([run], f"{run}/report.html"), ([run, again, "--out", "a.html"], "a.html")):
        assert typed(monkeypatch, capsys, "report", *arguments) == (0, f"report: {page}\n", "")
    assert {path.name for path in tmp_path.iterdir()} == {"again", "a.html"}
    figure = shutil.copytree(run, tmp_path / "figure")
    (figure / "figures" / "correct_0009.png").write_bytes(b"no image")
    for folders in ([tmp_path / "none"], [figure], [run, run.parent / "." / "one"]):
        code, stdout, stderr = typed(monkeypatch, capsys, "report", *folders)
        assert (code, stdout, stderr.count("\n")) == (2, "", 1)
        assert stderr.startswith(f"error: {folders[0]}")


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("results.json", '{"settings": []}', "not enough values"),
        ("gains.csv", "query,retrieval,retrieval rank\na,1,1\n", "place"),
        ("predictions/histogram.csv", "query,rank\na,1,1\n", "histogram.csv: expected lines of 2"),
    ],
)
def test_damaged_files_are_errors_of_one_line(tmp_path, name, text, words):
    (write_run(tmp_path / "run") / name).write_text(text)
    with pytest.raises(InputError, match=words) as error:
        write_report(tmp_path / "run")
    assert "expected the run folder of an evaluation of this version" in str(error.value)


def test_the_library_and_its_evaluation_wait_for_no_optional_package():
    code = ("import sys; from mfvpr import Map, match; from mfvpr.cli import evaluation; "
            "assert not {'plotly', 'jinja2', 'playwright', 'optax', 'orbax'} & {*sys.modules}")  # fmt: skip
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stderr) == (0, "")
