"""Run folders whose names are hostile, written by the library from made-up rankings."""

import json
from types import SimpleNamespace

import numpy as np
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from mfvpr.datasets import Dataset, FrameTruth, ImageFolder, QuerySequence
from mfvpr.evaluation import RankedDataset
from mfvpr.evaluation.rankings import Ranked
from mfvpr.report import write_json
from mfvpr.report.evaluations import EvaluationReport
from mfvpr.report.figures import ABOUT
from mfvpr.report.run_files import RunDescription, write_run_folder
from mfvpr.utils.files import printable

HOSTILE = (
    "<img src=x onerror=alert(1)>.png",
    "</script><script>alert(1)</script>.png",
    "\"'><svg onload=alert(1)>.png",
    "{{7*7}}{% raw %}.png",
    "two\nlines\r.png",
    "not utf-8 \udcff.png",
    "\u202egnp.txt",
    "&lt;b&gt; %{x} <a href='https://a.b'>$x$</a>.png",
    "-->]]>\u2028\u2029.png",
    "plain 0009.png",
)
SYSTEMS = ("retrieval", "histogram", "<script>alert(2)</script>")
HEADLINE = "histogram"
RANKS = {  # of the first correct candidate of three, 0 = none, of each query
    "retrieval": [1, 2, 0, 2, 3, 1, 0, 0, 1, 2],
    "histogram": [1, 1, 1, 2, 1, 1, 0, 1, 1, 1],
    "<script>alert(2)</script>": [0, 1, 1, 1, 1, 2, 3, 1, 0, 1],
}
CANDIDATES, KS, TOLERANCES = 3, (1, 2), [0, 2, 5]
ROWS = range(len(HOSTILE))  # of queries, and of the database images that show their places


def ranking(ranks):
    """Candidates of each query: its place at a rank, among rows beyond the middle tolerance; and their scores."""
    rows = []
    for query, rank in zip(ROWS, ranks, strict=True):
        others = [row for row in ROWS if abs(row - query) > TOLERANCES[1]]
        rows.append(([*others[: rank - 1], query, *others[rank - 1 :]] if rank else others)[:CANDIDATES])
    return Ranked(np.array(rows), np.array(ROWS)[:, None] + 10.0 - np.arange(CANDIDATES))


def write_run(folder, *, sequences=("</style><b onclick=alert(3)>",), ranks=RANKS, truth=True, refused=(), **changes):
    """A run folder; `changes` of what all rows of its results say alike. Sequences share the places of one map.

    Queries in `refused` have no place, for low confidence.
    """
    known = FrameTruth(tuple((row,) for row in ROWS), len(ROWS)) if truth else None
    drives = tuple(QuerySequence(name, ImageFolder("queries", HOSTILE), known) for name in sequences)
    scores = {name: SimpleNamespace(name=name, base=None, step=None, scorers=()) for name in ranks}
    pipeline = SimpleNamespace(candidates=CANDIDATES, retriever=None)
    ranked = RankedDataset(
        Dataset(sequences[0], ImageFolder("database", HOSTILE[::-1]), drives),
        SimpleNamespace(headline=HEADLINE, final_scores=scores, scorers={}, pipeline=pipeline),
        [SimpleNamespace(sequence=each, bad_queries={1: HOSTILE[0]}, bad_database={}) for each in drives],
        {name: [ranking(first)] * len(drives) for name, first in ranks.items()},
        {HOSTILE[2]: 1.5, "scores": 2.0},
    )
    about = {"kind": "order", "unit": "frames", "thresholds": TOLERANCES} if truth else {"kind": "none"}
    names = {"retrieval": {"name": HOSTILE[0]}, "features": {"name": HOSTILE[1]}, "matching": {}}
    settings = names | {"scorer": {name: {"a": [1, "<"]} for name in ranks}}
    description = RunDescription(about, "no ground truth: rankings only", {}, settings)
    fits = {HEADLINE: lambda ranked: np.where(np.isin(np.arange(len(ranked.rows)) % len(ROWS), refused), 0.1, 0.9)}
    report = EvaluationReport(ranked, TOLERANCES, KS, *((fits, 0.5) if refused else ()))
    write_run_folder(folder, report, description)
    rows = json.loads((folder / "results.json").read_text("utf-8"))
    write_json(folder / "results.json", [row | {"versions": {"mfvpr": "</script>"}} | changes for row in rows])
    settings = {"out": HOSTILE[5], "a": {}, "dataset": {}}
    write_json(folder / "run.json", {"command": HOSTILE[3], "commit": None, "settings": settings})
    for number, name in enumerate(sequences):
        for outcome, query in (("correct", 0), ("incorrect", 6)):
            place = folder / "figures" / (name if len(drives) > 1 else "")
            outcome = "refused" if query in refused else outcome
            _write_figure(place / f"{outcome}_{number:04d}.png", name, query)
    return folder


def _write_figure(path, sequence, query):
    about, info = (HEADLINE, sequence, path.name.split("_")[0], HOSTILE[query], HOSTILE[-1 - query]), PngInfo()
    for keyword, text in zip(ABOUT, about, strict=True):
        info.add_text(keyword, printable(text))
    path.parent.mkdir(parents=True, exist_ok=True)
    noise = np.random.default_rng(query).integers(0, 255, (300, 1300, 3), dtype=np.uint8)
    Image.fromarray(noise).save(path, pnginfo=info)
