"""Pages of run folders, read from their files: of one run, of a search or a multirun, of several runs compared."""

import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Int

from mfvpr.datasets.datasets import MEANS
from mfvpr.datasets.ground_truth import middle, threshold_words
from mfvpr.evaluation.confidence import PrecisionRecall
from mfvpr.evaluation.rankings import RETRIEVAL
from mfvpr.evaluation.statistics import Estimate, estimate
from mfvpr.report.evaluations import sequence_folder
from mfvpr.report.rendering import (
    PAGE,
    Chart,
    Gallery,
    Section,
    amount_chart,
    bar_chart,
    embed,
    flat,
    line_chart,
    pictures,
    values_table,
    write_page,
)
from mfvpr.report.run_files import difference_cells, matched_content
from mfvpr.report.runs import LAST, file_names
from mfvpr.report.tables import Table, format_estimate, format_interval, read_csv, read_table
from mfvpr.utils.errors import InputError

MOST_PREDICTIONS = 5000  # rows of a table that a browser still sorts at once
_NAMELESS = "folder"  # the default name of a data set of own folders
_CURVE_POINTS = 200
_WITH_TRUTH = ("table", "differences", "confidence", "rerank_share", "precision_recall")  # tables
_OF_SOME = ("changes", "skipped")  # tables that not every run has
_SIZES = {"queries": "queries", "database": "database images", "candidates": "candidates of a query"}
_SEARCH_TABLES = {"rows": "All scores", "axes": "All settings", "jobs": "All jobs"}  # by a name in results.json
_IN_TABLES = {"settings", "rows", "queries", "report", "jobs"}  # names in results.json
_INTERVALS = "intervals are 95 % and know that neighbors along the path fail together."


@dataclass(frozen=True)
class Run:
    """The content of a run folder.

    Attributes:
        results: rows of `results.json`.
        about: the content of `run.json`.
        tables: of CSV files, by name without suffix.
        systems: names in the order of the results; the `headline` decides.
        sequences: names; a single one without a name has the data set's.
        thresholds: of a correct prediction, ascending; none without ground truth.
        within: the threshold of ranks, as it stands behind R@K.
        queries: names of the Q queries of all sequences with ground truth; none without.
        sequence_of: numbers of their sequences.
        places: along the map.
        ranks: of the first correct candidates by system, 0 = no candidate is correct.
    """

    folder: Path
    results: Sequence[Mapping[str, Any]]
    about: Mapping[str, Any]
    tables: Mapping[str, Table]
    systems: Sequence[str]
    headline: str
    sequences: Sequence[str]
    thresholds: Sequence[float]
    within: str
    queries: Sequence[str]
    sequence_of: Int[np.ndarray, " queries"]
    places: Int[np.ndarray, " queries"]
    ranks: Mapping[str, Int[np.ndarray, " queries"]]

    @property
    def common(self) -> Mapping[str, Any]:
        """Values that all rows of the results share, among others."""
        return self.results[0]

    def hits(self, system: str, k: int = 1, sequence: int | None = None) -> Bool[np.ndarray, " queries"]:
        """In the order of the path, whether one of the first k candidates is correct; `sequence` None = of all."""
        path = np.argsort(self.places, kind="stable")
        path = path if sequence is None else path[self.sequence_of[path] == sequence]
        return ((self.ranks[system] > 0) & (self.ranks[system] <= k))[path]

    def recall(self, system: str, sequence: int | None = None) -> Estimate:
        """Recall at 1 and its 95 % interval."""
        return estimate(self.hits(system, 1, sequence))

    def description(self) -> str:
        """One line that says what was evaluated."""
        common, correct = self.common, "no ground truth: rankings only"
        several = f" in {len(self.sequences)} sequences" if len(self.sequences) > 1 else ""
        if self.queries:
            correct = f"correct within{self.within}" if self.within else "correct by the ground truth"
        lacks = f"; incomplete: {', '.join(common['incomplete'])}" if common.get("incomplete") else ""
        return (
            f"{common['queries']} queries{several}, {common['database']} database images, {common['candidates']} "
            f"candidates ({common['retrieval']['name']}), {matched_content(common)}; {correct}{lacks}"
        )

    def predictions(self) -> Iterator[dict[str, str]]:
        """The first predictions of all systems for each query, those of the system that decides first.

        A row has texts: `system`, `sequence`, `query`, `prediction` and `score`, empty without one; `outcome`, which
        is "correct", "incorrect", or "best" without ground truth; and `rank` of the first correct candidate, empty if
        there is none or if it is unknown.
        """
        systems, files = sorted(self.systems, key=lambda name: name != self.headline), file_names(self.systems)
        for system, (number, sequence) in itertools.product(systems, enumerate(self.sequences)):
            folder = sequence_folder(self.folder, self.sequences, number) / "predictions"
            first = {row["query"]: row for row in read_csv(folder / f"{files[system]}.csv") if row["rank"] == "1"}
            if self.queries:
                members = np.flatnonzero(self.sequence_of == number).tolist()
                ranks = {self.queries[row]: self.ranks[system][row] for row in members}
            for query in ranks if self.queries else first:
                row, rank = first.get(query, {}), ranks[query] if self.queries else None
                yield {
                    "system": system,
                    "sequence": sequence,
                    "query": query,
                    "prediction": row.get("database", ""),
                    "score": row.get("score", ""),
                    "outcome": "best" if rank is None else "correct" if rank == 1 else "incorrect",
                    "rank": str(rank or ""),
                }


Curves = Mapping[str, tuple[Run, str]]  # a run and one of its systems, by the name of their curve


def read_run(folder: Path) -> Run:
    """Read the files of a run folder; InputError if they are not those of an evaluation."""
    with _reading(folder):
        results, about = _read_json(folder / LAST), _read_json(folder / "run.json")
        systems = list(dict.fromkeys(row["system"] for row in results))
        headline = next(row["system"] for row in results if row["decides"])
        parts, truth = dict.fromkeys(row.get("sequence", row["dataset"]) for row in results), results[0]["ground_truth"]
        sequences, thresholds = [name for name in parts if name not in MEANS], truth.get("thresholds", [])
        names = [*_WITH_TRUTH] if thresholds else []
        names += [name for name in _OF_SOME if (folder / f"{name}.csv").exists()]
        within = threshold_words(truth["unit"], middle(thresholds)) if thresholds else ""
        lines, sequence_of = list[dict[str, str]](), list[int]()
        for number in range(len(sequences) if thresholds else 0):
            lines += read_csv(sequence_folder(folder, sequences, number) / "gains.csv")
            sequence_of += [number] * (len(lines) - len(sequence_of))
        queries, places = [line["query"] for line in lines], np.array([line["place"] for line in lines], int)
        ranks = {name: np.array([line[f"{name} rank"] or 0 for line in lines], int) for name in systems if lines}
        return Run(
            folder,
            results,
            about,
            tables={name: read_table(folder / f"{name}.csv") for name in names},
            systems=systems,
            headline=headline,
            sequences=sequences,
            thresholds=thresholds,
            within=within,
            queries=queries,
            sequence_of=np.array(sequence_of, int),
            places=places,
            ranks=ranks,
        )


def _read_json(path: Path) -> Any:
    return json.loads(path.read_text("utf-8"))


@contextmanager
def _reading(folder: Path) -> Iterator[None]:
    """Turn the errors of files that are not those of a run into an InputError of one line."""
    try:
        yield
    except (ValueError, LookupError, TypeError, AttributeError, OSError, SyntaxError) as error:
        reason = error.strerror if isinstance(error, OSError) else " ".join(f"{type(error).__name__}: {error}".split())
        raise InputError(f"{folder}: expected the run folder of an evaluation of this version ({reason})") from None


def write_report(folder: Path, path: Path | None = None) -> Path:
    """Write the page of a run folder, by default into it, and return its path; InputError for other folders."""
    path = path or folder / PAGE
    with _reading(folder):
        results = _read_json(folder / LAST)
    if isinstance(results, dict):
        _write_search_page(folder, results, path)
        return path
    run = read_run(folder)
    with _reading(folder):
        images, predictions = pictures(folder), [*itertools.islice(run.predictions(), MOST_PREDICTIONS)]
    common, sections, facts = run.common, [], {"decides": run.headline}
    if run.queries:
        sections.append(_recall_section(run))
        if run.tables["differences"].rows:
            words, tests = paired_tests("system", run.tables["differences"].rows)
            sections.append(Section("differences", "Differences", words, tables={"Every two systems": tests}))
    if "changes" in run.tables and (changes := run.tables["changes"].rows):
        verdicts = {"1": "correct", "0": "incorrect", "": ""}
        rows = [[*cells[:4], verdicts[cells[4]], cells[5], verdicts[cells[6]]] for cells in changes]
        columns = ["system", "sequence", "query", "alone", "", "with the other queries", ""]
        words = "First predictions that the other queries of a drive change."
        tables = {"Changed predictions": Table(columns, rows, len(columns))}
        sections.append(Section("sequence", "Sequences", words, tables=tables))
    if run.queries:
        sections.append(_confidence_section(run))
        for name in dict.fromkeys((run.headline, RETRIEVAL)):
            recall, interval = run.recall(name)
            words = f"{100 * recall:.1f} % {format_interval(interval)}"
            facts[f"{name}, R@1{run.within}"] = words.replace(" ", "\N{NO-BREAK SPACE}").replace("%\xa0", "% ")
    facts["seconds in all"] = f"{sum(common['seconds'].values()):.1f}"
    left_out = max(0, len(run.systems) * len(run.queries) - len(predictions))
    words = "Query and top prediction with their heaviest matches, and the histogram of their shifts. An incorrect "
    words += "prediction has the correct image below it. The table has the queries without a picture, too."
    gallery = Gallery(run.headline, run.systems, run.sequences, images, predictions, left_out)
    sections.append(Section("predictions", "Predictions", words, gallery=gallery))
    title, dataset = common["dataset"], run.about["settings"]["dataset"]
    if title == _NAMELESS and isinstance(dataset.get("queries"), str):  # the ends of the paths of its folders
        title = " in ".join("/".join(Path(dataset[side]).parts[-2:]) for side in ("queries", "database"))
    sections += [_costs_section(common), _settings_section(run)]
    write_page(path, title=title, words=run.description(), facts=facts, sections=sections)
    return path


def _write_search_page(folder: Path, results: Mapping[str, Any], path: Path) -> None:
    """Write the page of a sweep, of a learning comparison, or of the jobs of a multirun."""
    with _reading(folder):
        [caption] = [caption for name, caption in _SEARCH_TABLES.items() if name in results]
        heading = (folder / "table.md").read_text("utf-8").splitlines()[0]
        summary = (folder / "summary.txt").read_text("utf-8") if (folder / "summary.txt").exists() else ""
        figures = {file.stem: embed(file) for file in sorted((folder / "figures").glob("*.png"))}
        tables = {caption: read_table(folder / "table.csv")}
    about = values_table({name: value for name, value in results.items() if name not in _IN_TABLES})
    title, _, words = heading.partition(": ")
    text = summary.removeprefix(heading).strip()
    sections = [
        Section("results", "Results", text=text, images=figures, tables=tables),
        Section("settings", "Settings and versions", tables={"Run": about}),
    ]
    write_page(path, title=title, words=words, facts={}, sections=sections)


def _recall_section(run: Run) -> Section:
    several, curves = len(run.sequences) > 1, {name: (run, name) for name in run.systems}
    parts = (
        dict(zip(run.sequences, range(len(run.sequences)), strict=True)) | {MEANS[-1]: None} if several else {"": None}
    )
    recalls = {system: {name: run.recall(system, part) for name, part in parts.items()} for system in run.systems}
    groups = recalls if several else {"recall": {system: parts[""] for system, parts in recalls.items()}}
    intervals = bar_chart("intervals", f"Recall at 1{run.within}, with intervals", groups, axis="recall at 1, %")
    charts = [intervals, *_tolerance_charts(curves), _depths_chart(f"Recall over K{run.within}", curves)]
    words = f"In %. Results of single queries are those at the middle tolerance{run.within}; {_INTERVALS}"
    table, rows = run.tables["table"], []
    for row in table.rows:
        recall = recalls[row[0]].get(row[1] if several else "")  # the plain mean of sequences has none
        rows.append([*row, format_interval(recall.interval) if recall else ""])
    shown = Table([*table.header, f"R@1{run.within}, 95 %"], rows, 1 + several)
    return Section("recall", "Recall", words, charts, {"Recall of every system": shown})


def _depths_chart(title: str, curves: Curves) -> Chart:
    """Recall at K from 1 to all candidates, at all small Ks and some larger ones."""
    points = {}
    for name, (run, system) in curves.items():
        largest = max(run.common["candidates"], 1)
        depths = np.unique(np.geomspace(1, largest, _CURVE_POINTS).round().astype(int)).tolist()
        points[name] = [(k, 100 * float(run.hits(system, k).mean())) for k in depths]
    return line_chart("depths", title, points, axes=("K, the first candidates", "recall at K, %"), scale="log")


def _tolerance_charts(curves: Curves) -> list[Chart]:
    """Recall of all queries over the threshold, a chart for each unit and depth of runs with several thresholds."""
    by_kind: dict[tuple[str, str], dict[str, list[tuple[float, float]]]] = {}
    for name, (run, system) in curves.items():
        if len(run.thresholds) > 1:
            unit, k = run.common["ground_truth"]["unit"], min(run.common["recall_at"], key=int)
            rows = [row for row in run.results if row["system"] == system]
            recalls = [row["recall_at"][k] for row in rows if row.get("sequence", MEANS[-1]) == MEANS[-1]]
            points = [(at, 100 * recall) for at, recall in zip(run.thresholds, recalls, strict=True)]
            by_kind.setdefault((unit, k), {})[name] = points
    charts = []
    for number, ((unit, k), points) in enumerate(by_kind.items()):
        axes, name = (f"tolerance, {unit}", f"recall at {k}, %"), f"tolerances-{number}" if number else "tolerances"
        charts.append(line_chart(name, "Recall over tolerance", points, axes=axes, marked=True))
    return charts


def _precision_charts(curves: Curves, by: str = "score", words: str = "by the score") -> list[Chart]:
    """Precision against recall, if the runs have them; names of curves have their average precision."""
    points = {}
    for name, (run, system) in curves.items():
        rows = [row for row in run.tables["precision_recall"].rows if row[:2] == [system, by]]
        if rows:
            curve = PrecisionRecall(*np.array([row[2:] for row in rows], float).T)
            shown = np.unique(np.linspace(0, len(rows) - 1, _CURVE_POINTS).round().astype(int))
            pairs = zip(curve.recall[shown], curve.precision[shown], strict=True)
            label = f"{name}: AP {100 * curve.average_precision:.1f}"
            points[label] = [(round(100 * x, 3), round(100 * y, 3)) for x, y in pairs]
    axes = "recall of queries with a correct image, %", "precision, %"
    title = f"Precision and recall {words}"
    return [line_chart(f"precision-{by}", title, points, axes=axes, scale="percent")] if points else []


def paired_tests(kind: str, lines: Sequence[Sequence[str]]) -> tuple[str, Table]:
    """Explanation and table of paired tests of systems or of runs (`kind`), of lines as in `differences.csv`."""
    words = (
        f"How many queries only one of two {kind}s predicts correctly, and how probable that is if neither is better, "
        "by McNemar's exact test, which takes queries for independent, and by a test along the path."
    )
    rows = [[*line[:4], *(f"{float(cell):.2g}" for cell in line[4:])] for line in lines]
    columns = kind, "other", f"only {kind}", "only other", "McNemar p", "queries worth one", "p along the path"
    return words, Table(columns, rows, text_columns=2)


def _confidence_section(run: Run) -> Section:
    """Precision against recall, and recall over the share that is re-ranked; with ground truth."""
    table, shares = run.tables["confidence"], run.tables["rerank_share"]
    curves = {name: (run, name) for name in run.systems}
    charts = _precision_charts(curves) + _precision_charts(curves, "confidence", "by confidence")
    if shares.rows and len(shares.header) > 1:
        share, *recalls = np.array(shares.rows, float).T.tolist()
        points = {RETRIEVAL: [(0.0, recalls[0][0]), (100.0, recalls[0][0])]}  # alone, it re-ranks nothing
        for name, recall in zip(shares.header[1:], recalls, strict=True):
            points[name] = [(100 * x, y) for x, y in zip(share, recall, strict=True)]
        axes, title = ("queries re-ranked, %", "recall at 1, %"), "Re-ranking only what retrieval is unsure of"
        charts.append(line_chart("shares", title, points, axes=axes, scale="percent"))
    tables = {"Confidence of top predictions, in %": table} if table.rows else {}
    words = "AP is the average precision, R@100P the recall at 100 % precision, ECE the expected calibration error of "
    return Section("confidence", "Precision and recall", f"{words}confidence.", charts, tables)


def _costs_section(common: Mapping[str, Any]) -> Section:
    seconds, queries = common["seconds"], max(common["queries"], 1)
    rows = [[stage, f"{value:.3f}", f"{value / queries:.4f}"] for stage, value in seconds.items()]
    sizes = [[words, f"{common[name]}"] for name, words in _SIZES.items()]
    chart = amount_chart("seconds", "Seconds by stage", seconds, axis="seconds")
    tables = {"Seconds": Table(["stage", "seconds", "per query"], rows), "Sizes": Table(["what", "number"], sizes)}
    words = "What was in the stores already was not computed again."
    return Section("costs", "Seconds and sizes", words, [chart], tables)


def _settings_section(run: Run) -> Section:
    about = {name: run.about.get(name) for name in ("command", "commit")}
    about |= {name.replace("_", " "): run.common[name] for name in ("ground_truth", "data_fingerprint")}
    tables = {
        "Run": values_table(about),
        "Settings": values_table(run.about["settings"]),
        "Versions": values_table(run.common["versions"]),
        "Systems": values_table({row["system"]: row["parameters"] for row in run.results}),
    }
    if skipped := run.tables.get("skipped"):
        tables["Images that could not be used"] = Table(skipped.header, skipped.rows, 3)
    return Section("settings", "Settings and versions", tables=tables)


def write_comparison(folders: Sequence[Path], path: Path) -> None:
    """Write a page of several runs side by side; InputError for a folder twice, or of no evaluation."""
    paths = [folder.resolve() for folder in folders]
    if twice := [folder for folder in folders if paths.count(folder.resolve()) > 1]:
        raise InputError(f"{twice[0]}: expected different run folders, got this one twice")
    labels, length = [""], 0
    while len({*labels}) < len(paths):  # the shortest ends of the paths that differ
        length += 1
        labels = ["/".join(path.parts[-length:]) for path in paths]
    runs = dict(zip(labels, map(read_run, folders), strict=True))
    overview, facts = [], {}
    for label, run in runs.items():
        seconds = f"{sum(run.common['seconds'].values()):.1f}"
        overview.append([label, run.common["dataset"], run.headline, run.description(), seconds])
        if run.queries:
            facts[f"{label}, R@1{run.within}"] = f"{100 * run.recall(run.headline).recall:.1f} %"
    header = ["run", "data set", "decides", "what was evaluated", "seconds"]
    sections = [Section("runs", "Runs", tables={"Runs": Table(header, overview, 4)})]
    if facts:
        sections += [_recalls_section({label: run for label, run in runs.items() if run.queries}), _pairs_section(runs)]
    settings = {}
    for label, run in runs.items():
        about = {name: run.about.get(name) for name in ("command", "commit", "settings", "ground_truth")}
        settings[label] = dict(
            flat(about | {name: run.common[name] for name in ("data_fingerprint", "versions", "seconds")})
        )
    names = dict.fromkeys(name for values in settings.values() for name in values)
    rows = [[name, *(values.get(name, "") for values in settings.values())] for name in names]
    tables = {
        "What differs": Table(["name", *settings], [row for row in rows if len({*row[1:]}) > 1], 1 + len(settings)),
        "What is alike": Table(["name", "value"], [row[:2] for row in rows if len({*row[1:]}) == 1], 2),
    }
    sections.append(Section("settings", "Settings and versions", tables=tables))
    words = "The systems that decide, beside each other; each run has a page of its own."
    title = f"{', '.join(dict.fromkeys(run.common['dataset'] for run in runs.values()))}: {len(runs)} runs compared"
    write_page(path, title=title, words=words, facts=facts, sections=sections)


def why_not(first: Run, second: Run) -> str | None:
    """The reason that two runs cannot be compared query by query; None = they can."""
    if not (first.queries and second.queries):
        return "a run has no ground truth"
    if first.common["data_fingerprint"] != second.common["data_fingerprint"]:
        return "other images"
    ours, theirs = first.common["ground_truth"], second.common["ground_truth"]
    if differ := [name for name in ours | theirs if ours.get(name) != theirs.get(name)]:
        return f"another ground truth ({', '.join(differ)})"
    same = first.queries == second.queries and first.sequences == second.sequences
    return None if same else "other queries"


def _recalls_section(runs: Mapping[str, Run]) -> Section:
    """Recall of all systems side by side; of the headline systems with intervals and over K."""
    curves = {label: (run, run.headline) for label, run in runs.items()}
    headlines = {"recall": {label: run.recall(run.headline) for label, run in runs.items()}}
    charts = [
        bar_chart("intervals", "Recall at 1, with intervals", headlines, axis="recall at 1, %"),
        _depths_chart("Recall over K", curves),
        *_tolerance_charts(curves),
        *_precision_charts(curves),
    ]
    rows = []
    for system in dict.fromkeys(name for run in runs.values() for name in run.systems):
        recalls = [format_estimate(run.recall(system)) if system in run.systems else "" for run in runs.values()]
        rows.append([system, *recalls])
    header = ["system", *(f"{label}{run.within}" for label, run in runs.items())]
    words = f"In %, of all queries, correct at the middle tolerance of each run; {_INTERVALS}"
    if any(why_not(*pair) for pair in itertools.combinations(runs.values(), 2)):
        words += " Not all of these runs have the same queries and the same ground truth: see below."
    return Section("recall", "Recall", words, charts, {"Recall at 1 of every system": Table(header, rows)})


def _pairs_section(runs: Mapping[str, Run]) -> Section:
    """Tests of every two runs, query by query, and the pairs that cannot be compared."""
    rows, incomparable = [], []
    for (label, run), (other, second) in itertools.combinations(runs.items(), 2):
        if reason := why_not(run, second):
            incomparable.append([label, other, reason])
        else:
            pair = run.hits(run.headline), second.hits(second.headline)
            rows.append([f"{label}: {run.headline}", f"{other}: {second.headline}", *difference_cells(*pair)])
    words, tests = paired_tests("run", rows)
    tables = {"Every two runs of the same queries": tests} if rows else {}
    if incomparable:
        tables["Not comparable query by query"] = Table(["run", "other", "why"], incomparable, 3)
    return Section("pairs", "Every two runs", words, tables=tables)
