"""Pages of run folders, read from their files: of one run, of a search or a multirun, of several runs compared.

A page is one HTML file that needs no network. Names of images may be anything: they are data, and all is escaped.
"""

import itertools
import json
from base64 import b64encode
from collections.abc import Iterator, Mapping, Sequence
from hashlib import sha256
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool

from mfvpr.datasets.datasets import MEANS
from mfvpr.datasets.ground_truth import middle, threshold_words
from mfvpr.datasets.image_reading import open_image
from mfvpr.evaluation.confidence import PrecisionRecall
from mfvpr.evaluation.rankings import RETRIEVAL
from mfvpr.evaluation.statistics import Estimate, estimate, mcnemar, path_test
from mfvpr.io.containers import reading
from mfvpr.report.evaluations import NO_PLACE, sequence_folder
from mfvpr.report.figures import ABOUT, REFUSED
from mfvpr.report.runs import LAST, Table, file_names, format_estimate, format_interval, read_csv, table_of
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import require_replaceable, write_text

# Jinja2 and plotly are imported where they are needed: the rest of the library does not depend on them.
PAGE = "report.html"  # in a run folder
MOST_PREDICTIONS = 5000  # rows of a table that a browser still sorts at once
_MOST_PICTURES = 60
_PICTURE_WIDTH, _QUALITY = 1000, 75  # px, of JPEG: some 60 kB each
_POLICY = b"default-src 'none'; script-src "  # at the start of every page
_TEMPLATES = Path(__file__).parent / "templates"
_EXPECTED = "expected the run folder of an evaluation of this version"
_NAMELESS = "folder"  # the default name of a data set
_CURVE_POINTS = 200
_POOLED = MEANS[-1]
_OUTCOMES = {"1": "correct", "0": "incorrect", "": "best"}  # by `correct` of predictions
_SEARCH_TABLES = {"rows": "All scores", "axes": "All settings", "jobs": "All jobs"}  # by a name in results.json
_IN_TABLES = {"settings", "rows", "queries", "report", "jobs"}  # names in results.json


def write_page(path: Path, template: str = "sections.html", **content: Any) -> None:
    """Write one HTML file; the same bytes for the same values. An earlier page is replaced; InputError for other files.

    Every page has a `title`, `words` below it, and `facts`, the most important values by name. sections.html has
    `parts`, by title: the `words`, `links`, `text`, `images` and `tables` of each, as far as it has them. Links are
    words and relative addresses, images `data:` URIs by name, and tables are by caption.
    """
    require_replaceable(path, _POLICY)
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup
    from plotly.offline import get_plotlyjs

    environment = Environment(loader=FileSystemLoader(_TEMPLATES), autoescape=True, undefined=StrictUndefined)
    environment.trim_blocks = environment.lstrip_blocks = True
    environment.filters["flat"] = flat
    environment.policies["json.dumps_kwargs"] = {"sort_keys": True, "allow_nan": False}
    scripts = [get_plotlyjs(), (_TEMPLATES / "script.js").read_text("utf-8")]
    hashes = [b64encode(sha256(script.encode()).digest()).decode() for script in scripts]
    text = environment.get_template(template).render(
        {"recall": None, "charts": [], **content},
        scripts=map(Markup, scripts),  # of this package and of plotly, as is the style
        style=Markup((_TEMPLATES / "style.css").read_text("utf-8")),
        hashes=" ".join(f"'sha256-{each}'" for each in hashes),
    )
    write_text(path, text)


def flat(values: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Nested values as (dotted name, text)."""
    for name, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from ((f"{name}.{inner}", text) for inner, text in flat(value))
        else:
            yield name, value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)


def embed(content: bytes, kind: str = "png") -> str:
    """The content of an image file as a `data:` URI."""
    return f"data:image/{kind};base64,{b64encode(content).decode()}"


class Run:
    """The content of a run folder.

    Attributes:
        results: rows of `results.json`; `common` is the first, for values that all share. `about` is run.json.
        tables: rows of CSV files, by name without suffix.
        systems: names in the order of the results; the `headline` decides.
        sequences: names; a single one without a name has the data set's.
        within: the middle of the `thresholds`, as it stands behind R@K; "" without ground truth.
        queries: names of the Q queries of all sequences along the path; none without ground truth.
        sequence_of: names of their sequences `[Q]`.
        ranks: of their first correct candidates `[Q]` by system, 0 = no candidate is correct.
    """

    def __init__(self, folder: Path) -> None:
        """Read the files; InputError if they are not those of an evaluation."""
        self.folder = folder
        with reading(folder / LAST, mend=_EXPECTED):
            self.results: list[dict[str, Any]] = _read_json(folder / LAST)
            self.about: dict[str, Any] = _read_json(folder / "run.json")
            self.common = self.results[0]
            truth = self.common["ground_truth"]
            self.systems = list(dict.fromkeys(row["system"] for row in self.results))
            self.headline = next(row["system"] for row in self.results if row["decides"])
            sequences = dict.fromkeys(row.get("sequence", row["dataset"]) for row in self.results)
            self.sequences = [name for name in sequences if name not in MEANS]
            self.thresholds: list[float] = truth.get("thresholds", [])
            self.within = threshold_words(truth["unit"], middle(self.thresholds)) if self.thresholds else ""
            names = ["table", "confidence", "precision_recall"] if self.thresholds else []
            names += ["skipped"] if (folder / "skipped.csv").exists() else []
            self.tables = {name: read_csv(folder / f"{name}.csv") for name in names}
            lines = list[tuple[str, dict[str, str]]]()
            for number, name in enumerate(self.sequences if self.thresholds else ()):
                gains = read_csv(sequence_folder(folder, self.sequences, number) / "gains.csv")
                lines += [(name, line) for line in gains]
            lines.sort(key=lambda line: int(line[1]["place"]))
            self.queries, self.sequence_of = [line["query"] for _, line in lines], np.array([name for name, _ in lines])
            ranks = {name: [line[f"{name} rank"] or 0 for _, line in lines] for name in self.systems if lines}
            self.ranks = {name: np.array(column, int) for name, column in ranks.items()}

    def hits(self, system: str, k: int = 1) -> Bool[np.ndarray, " queries"]:
        """Along the path, whether one of the first k candidates is correct."""
        return (self.ranks[system] > 0) & (self.ranks[system] <= k)

    def recall(self, system: str, sequence: str = _POOLED) -> Estimate:
        """Recall at 1 of a sequence, or of all queries, and its 95 % interval."""
        hits = self.hits(system)
        return estimate(hits if sequence == _POOLED else hits[self.sequence_of == sequence])

    def predictions(self) -> Iterator[dict[str, str]]:
        """The first candidates of all systems for each query that has one, those of the system that decides first.

        A row has texts: `system`, `sequence`, `query`, `prediction`, `score`; `outcome`, which is "correct",
        "incorrect", "best" without ground truth, or "refused" if the system that decides predicts no place; and the
        rank of the `first_correct`, empty without one.
        """
        systems, files = sorted(self.systems, key=lambda name: name != self.headline), file_names(self.systems)
        for system, (number, sequence) in itertools.product(systems, enumerate(self.sequences)):
            folder = sequence_folder(self.folder, self.sequences, number)
            rows = read_csv(folder / "predictions" / f"{files[system]}.csv")
            decided = read_csv(folder / "predictions.csv") if system == self.headline else []
            refused = {row["query"] for row in decided if row["database"] == NO_PLACE}
            ranks = {row["query"]: row["rank"] for row in reversed(rows) if row["correct"] == "1"}
            for row in rows:
                if row["rank"] == "1":
                    outcome, rank = _OUTCOMES[row["correct"]], ranks.get(row["query"], "")
                    outcome = REFUSED if row["query"] in refused else outcome
                    about = {"system": system, "sequence": sequence, "outcome": outcome, "first_correct": rank}
                    yield {"query": row["query"], "prediction": row["database"], "score": row["score"], **about}

    def pictures(self) -> list[dict[str, Any]]:
        """Figures of queries and their predictions, by their files; evenly chosen if there are many.

        A picture has the values of the keywords `ABOUT`, its `source` as a `data:` URI, and its `size`, px.
        """
        paths, shown = sorted((self.folder / "figures").rglob("*_[0-9]*.png")), list[dict[str, Any]]()
        for path in paths[:: max(1, -(-len(paths) // _MOST_PICTURES))]:
            with open_image(path) as image:
                image.load()
                about, small, file = {name: str(image.info[name]) for name in ABOUT}, image.convert("RGB"), BytesIO()
            small.thumbnail((_PICTURE_WIDTH, small.height))
            small.save(file, "JPEG", quality=_QUALITY, optimize=True)
            shown.append(about | {"source": embed(file.getvalue(), "jpeg"), "size": small.size})
        return shown


def _read_json(path: Path) -> Any:
    return json.loads(path.read_text("utf-8"))


def write_report(folder: Path, path: Path | None = None) -> Path:
    """Write the page of a run folder, by default into it, and return its path; InputError for other folders."""
    path = path or folder / PAGE
    with reading(folder / LAST, mend=_EXPECTED):
        results = _read_json(folder / LAST)
    if isinstance(results, dict):
        _write_search_page(folder, results, path)
        return path
    run = Run(folder)
    common, facts, recall = run.common, {"decides": run.headline}, dict[str, Any]()
    if run.queries:
        recall = _recall({"": run}, {name: (run, name) for name in run.systems})
        for name in (run.headline, RETRIEVAL):
            facts[f"{name}, R@1{run.within}, %"] = format_estimate(run.recall(name))
    facts["seconds in all"] = f"{sum(common['seconds'].values()):.1f}"
    with reading(folder / LAST, mend=_EXPECTED):
        pictures, predictions = run.pictures(), [*itertools.islice(run.predictions(), MOST_PREDICTIONS + 1)]
    per_query = 1 / max(common["queries"], 1)
    seconds = [[stage, f"{value:.3f}", f"{value * per_query:.4f}"] for stage, value in common["seconds"].items()]
    provenance = {name: run.about.get(name) for name in ("command", "commit")}
    provenance |= {name.replace("_", " "): common[name] for name in ("ground_truth", "data_fingerprint")}
    skipped = run.tables.get("skipped", [])
    title, dataset = common["dataset"], run.about["settings"]["dataset"]
    if title == _NAMELESS and isinstance(dataset.get("queries"), str):  # the ends of the paths of its folders
        title = " in ".join("/".join(Path(dataset[side]).parts[-2:]) for side in ("queries", "database"))
    write_page(
        path,
        "run.html",
        title=title,
        words=common["description"],
        facts=facts,
        pictures=pictures,
        predictions=predictions[:MOST_PREDICTIONS],
        is_cut=len(predictions) > MOST_PREDICTIONS,
        seconds=Table(["stage", "seconds", "per query"], seconds),
        run=run,
        provenance=provenance,
        systems={row["system"]: row["parameters"] for row in run.results},
        skipped=skipped and table_of(skipped, [*skipped[0]]),
        **recall,
    )
    return path


def write_comparison(folders: Sequence[Path], path: Path) -> None:
    """Write a page of several runs side by side; InputError for a folder twice, or of no evaluation."""
    paths = [folder.resolve() for folder in folders]
    if twice := [folder for folder in folders if paths.count(folder.resolve()) > 1]:
        raise InputError(f"{twice[0]}: expected different run folders, got this one twice")
    labels, length = [""], 0
    while len({*labels}) < len(paths):  # the shortest ends of the paths that differ
        length += 1
        labels = ["/".join(path.parts[-length:]) for path in paths]
    runs = dict(zip(labels, map(Run, folders), strict=True))
    overview, facts, settings = [], {}, {}
    for label, run in runs.items():
        overview.append([label, run.common["dataset"], run.headline, run.common["description"]])
        if run.queries:
            facts[f"{label}, R@1{run.within}, %"] = format_estimate(run.recall(run.headline))
        about = {name: run.about.get(name) for name in ("command", "commit", "settings", "ground_truth")}
        about |= {name: run.common[name] for name in ("data_fingerprint", "versions", "seconds")}
        settings[label] = dict(flat(about))
    header, recall = ["run", "data set", "decides", "description"], dict[str, Any]()
    if known := {label: run for label, run in runs.items() if run.queries}:
        recall = _recall(known, {f"{label}: {run.headline}": (run, run.headline) for label, run in known.items()})
    names = dict.fromkeys(name for values in settings.values() for name in values)
    rows = [[name, *(values.get(name, "") for values in settings.values())] for name in names]
    write_page(
        path,
        "comparison.html",
        title=f"{', '.join(dict.fromkeys(run.common['dataset'] for run in runs.values()))}: {len(runs)} runs compared",
        words="The systems that decide, beside each other; each run also has a page.",
        facts=facts,
        runs=Table(header, overview, text_columns=4),
        differing=Table(["name", *settings], [row for row in rows if len({*row[1:]}) > 1], 1 + len(settings)),
        **recall,
    )


def _write_search_page(folder: Path, results: Mapping[str, Any], path: Path) -> None:
    """Write the page of a sweep, of a learning comparison, or of the jobs of a multirun."""
    with reading(folder / LAST, mend=_EXPECTED):
        [caption] = [caption for name, caption in _SEARCH_TABLES.items() if name in results]
        heading = (folder / "table.md").read_text("utf-8").splitlines()[0]
        summary = (folder / "summary.txt").read_text("utf-8") if (folder / "summary.txt").exists() else ""
        figures = {file.stem: embed(file.read_bytes()) for file in sorted((folder / "figures").glob("*.png"))}
        rows = read_csv(folder / "table.csv")
        tables = {caption: table_of(rows, [*rows[0]][:1])}
    title, _, words = heading.partition(": ")
    settings = {name: value for name, value in results.items() if name not in _IN_TABLES}
    content = {"text": summary.removeprefix(heading).strip(), "images": figures, "tables": tables}
    parts = {"Results": content} | ({"Settings and versions": {"tables": {"Run": settings}}} if settings else {})
    write_page(path, title=title, words=words, facts={}, parts=parts)


Curves = Mapping[str, tuple[Run, str]]  # a run and one of its systems, by the name of their curve
Chart = dict[str, Any]  # for script.js: points (x, y in %) by the name of their curve, or bars by that of their group


def _recall(runs: Mapping[str, Run], curves: Curves) -> dict[str, Any]:
    """Content of recall.html: of all systems of runs by name; of the curves, charts, and tests of every two."""
    rows = list[dict[str, str]]()
    groups = {"recall": {name: run.recall(system) for name, (run, system) in curves.items()}}
    for label, run in runs.items():
        for row in run.tables["table"]:
            if (sequence := row.get("sequence", _POOLED)) != MEANS[0]:  # the plain mean has no interval
                row[f"R@1{run.within}, 95 %"] = format_interval(run.recall(row["system"], sequence).interval)
            rows.append({"run": label} | row if label else row)
        if len(run.sequences) > 1 and len(runs) == 1:
            groups = {name: {part: run.recall(name, part) for part in (*run.sequences, _POOLED)} for name in curves}
    bars = {
        name: [(member, 100 * bar.recall, [100 * end for end in bar.interval]) for member, bar in group.items()]
        for name, group in groups.items()
    }
    intervals = {"name": "intervals", "title": "Recall at 1, with intervals", "axes": ("recall at 1, %", "")}
    confidences = {label: run.tables["confidence"] for label, run in runs.items()}
    charts = [
        intervals | {"scale": "share", "data": [*bars.items()]},
        _tolerance_chart(curves),
        _depths_chart(curves),
        *(_precision_chart(curves, by) for by in ("score", "confidence")),
    ]
    return {
        "recall": table_of(rows, ("run", "system", "sequence")),
        "confidences": {label: table_of(table, ["system"]) for label, table in confidences.items() if table},
        "charts": [chart for chart in charts if chart["data"]],
        **_differences(curves),
    }


def _depths_chart(curves: Curves) -> Chart:
    """Recall at K from 1 to all candidates, at all small Ks and some larger ones."""
    points = {}
    for name, (run, system) in curves.items():
        largest = max(run.common["candidates"], 1)
        depths = np.unique(np.geomspace(1, largest, _CURVE_POINTS).round().astype(int)).tolist()
        points[name] = [(k, 100 * float(run.hits(system, k).mean())) for k in depths]
    axes = "K, the first candidates", "recall at K, %"
    return {"name": "depths", "title": "Recall over K", "axes": axes, "scale": "log", "data": [*points.items()]}


def _tolerance_chart(curves: Curves) -> Chart:
    """Recall of all queries over the threshold, of the runs with several thresholds in the unit of the first."""
    points, (first, _) = dict[str, list[tuple[float, float]]](), next(iter(curves.values()))
    unit, k = first.common["ground_truth"]["unit"], min(first.common["recall_at"], key=int)
    for name, (run, system) in curves.items():
        if len(run.thresholds) > 1 and run.common["ground_truth"]["unit"] == unit and k in run.common["recall_at"]:
            rows = [row for row in run.results if row["system"] == system]
            recalls = [row["recall_at"][k] for row in rows if row.get("sequence", _POOLED) == _POOLED]
            points[name] = [(at, 100 * recall) for at, recall in zip(run.thresholds, recalls, strict=True)]
    axes = f"tolerance, {unit}", f"recall at {k}, %"
    chart = {"name": "tolerances", "title": "Recall over tolerance", "axes": axes}
    return chart | {"scale": "linear", "data": [*points.items()]}


def _precision_chart(curves: Curves, by: str) -> Chart:
    """Precision against recall, if the runs have them; names of curves have their average precision."""
    points = {}
    for name, (run, system) in curves.items():
        rows = [row for row in run.tables["precision_recall"] if (row["system"], row["by"]) == (system, by)]
        if rows:
            curve = PrecisionRecall(*np.array([[*row.values()][2:] for row in rows], float).T)
            shown = np.unique(np.linspace(0, len(rows) - 1, _CURVE_POINTS).round().astype(int))
            pairs = np.stack([curve.recall, curve.precision], axis=1)[shown]
            points[f"{name}: AP {100 * curve.average_precision:.1f}"] = (100 * pairs).round(3).tolist()
    axes = "recall of queries with a correct image, %", "precision, %"
    chart = {"name": f"precision-{by}", "title": f"Precision and recall by {by}", "axes": axes}
    return chart | {"scale": "percent", "data": [*points.items()]}


def _differences(curves: Curves) -> dict[str, Table]:
    """Tests of every two curves, query by query, and the pairs that cannot be compared."""
    rows, incomparable = [], []
    for names in itertools.combinations(curves, 2):
        (run1, system1), (run2, system2) = (curves[name] for name in names)
        reasons = {
            "other images": run1.common["data_fingerprint"] != run2.common["data_fingerprint"],
            "another ground truth": run1.common["ground_truth"] != run2.common["ground_truth"],
            "other queries": (run1.queries, run1.sequences) != (run2.queries, run2.sequences),
        }
        if any(reasons.values()):
            incomparable.append([*names, next(reason for reason, holds in reasons.items() if holds)])
            continue
        hits = run1.hits(system1), run2.hits(system2)
        test, path = mcnemar(*hits), path_test(*hits)
        numbers = (f"{value:.2g}" for value in (test.p_value, *path))
        rows.append([*names, str(test.only_first), str(test.only_second), *numbers])
    header = ["system", "other", "only system", "only other", "McNemar p", "queries worth one", "p along the path"]
    pairs = Table(["run", "other", "why"], incomparable, text_columns=3)
    return {"differences": Table(header, rows, text_columns=2), "incomparable": pairs}
