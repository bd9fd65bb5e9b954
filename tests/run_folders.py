"""A made-up run folder whose names are hostile, as the files of an evaluation would have them."""

import numpy as np
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from mfvpr.evaluation.rankings import Ranked
from mfvpr.report import Table, write_json
from mfvpr.report.evaluations import sequence_folder
from mfvpr.report.figures import ABOUT
from mfvpr.report.run_files import write_predictions
from mfvpr.report.runs import file_names, write_csv
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


def write_run(folder, *, sequences=("</style><b onclick=alert(3)>",), ranks=RANKS, truth=True, **changes):
    """A run folder; `changes` of what all rows of its results say alike. Sequences share the places of one map."""
    several = len(sequences) > 1
    known = {"kind": "order", "files": [], "exclude_neighbors": None}
    known |= {"unit": "frames", "thresholds": TOLERANCES} if truth else {}
    common = {
        "retrieval": {"name": HOSTILE[0]}, "features": {"name": HOSTILE[1]}, "matching": {}, "candidates": CANDIDATES,
        "queries": len(HOSTILE) * len(sequences), "database": len(HOSTILE), "dataset": sequences[0],
        "description": f"{HOSTILE[0]}: {'recall in %' if truth else 'no ground truth: rankings only'}",
        "data_fingerprint": {"database": "0"}, "ground_truth": known, "seconds": {HOSTILE[2]: 1.5, "scores": 2.0},
        "versions": {"mfvpr": "</script>"}, **changes,
    }  # fmt: skip
    rows = []
    for system in ranks:
        for name in (*sequences, "mean", "pooled") if several else (None,):
            for place, tolerance in enumerate(TOLERANCES if truth else [None]):
                hits = np.array(ranks[system])
                recall = {str(k): float(((hits > 0) & (hits <= k)).mean()) * (place + 1) / 3 for k in KS}
                of = {"system": system, "scorer": system, "decides": system == HEADLINE, "parameters": {"a": [1, "<"]}}
                of |= {"sequence": name} if several else {}
                of |= {"tolerance": tolerance, "recall_at": recall} if truth else {"recall_at": {}}
                rows.append(of | common)
    write_json(folder / "results.json", rows)
    settings = {"out": HOSTILE[5], "a": {}, "dataset": {}}
    write_json(folder / "run.json", {"command": HOSTILE[3], "commit": None, "settings": settings})
    for number, name in enumerate(sequences):
        _write_answers(sequence_folder(folder, sequences, number), ranks, truth)
        for outcome, query in (("correct", 0), ("incorrect", 6)):
            _write_figure(folder / "figures" / (name if several else "") / f"{outcome}_{number:04d}.png", name, query)
    if truth:
        _write_tables(folder, ranks, sequences)
    return folder


def _write_answers(folder, ranks, truth):
    files = file_names([*ranks])
    for system, first in ranks.items():
        correct = np.array(first)[:, None] == np.arange(1, CANDIDATES + 1)
        rows = (np.arange(len(HOSTILE))[:, None] + np.arange(CANDIDATES)) % len(HOSTILE)
        scores = np.arange(len(HOSTILE))[:, None] + 10.0 - np.arange(CANDIDATES)
        rankings = HOSTILE, HOSTILE[::-1], Ranked(rows, scores), correct if truth else None
        write_predictions(folder / "predictions" / f"{files[system]}.csv", *rankings)
    if truth:
        header = ["query", "place", *(column for name in ranks for column in (name, f"{name} rank"))]
        lines = []
        for query, name in enumerate(HOSTILE):
            first = [column[query] for column in ranks.values()]
            lines.append([name, query, *(cell for rank in first for cell in (int(rank == 1), rank or ""))])
        write_csv(folder / "gains.csv", header, lines)


def _write_figure(path, sequence, query):
    about, info = (HEADLINE, sequence, path.name.split("_")[0], HOSTILE[query], HOSTILE[-1 - query]), PngInfo()
    for keyword, text in zip(ABOUT, about, strict=True):
        info.add_text(keyword, printable(text))
    path.parent.mkdir(parents=True, exist_ok=True)
    noise = np.random.default_rng(query).integers(0, 255, (300, 1300, 3), dtype=np.uint8)
    Image.fromarray(noise).save(path, pnginfo=info)


def _write_tables(folder, ranks, sequences):
    names = [*sequences, "mean", "pooled"] if len(sequences) > 1 else []
    recall = [[name, *([part] if part else []), f"{100 * np.mean(np.array(first) == 1):.1f}"]
              for name, first in ranks.items() for part in names or [None]]  # fmt: skip
    header = ["system", *(["sequence"] if names else []), "R@1 ±2"]
    (folder / "table.csv").write_text(Table(header, recall).csv(), encoding="utf-8")
    write_csv(folder / "confidence.csv", ["system", "AP by score"], [[HEADLINE, "90.0"]])
    points = [[HEADLINE, "score", 3, 1, 0.25], [HEADLINE, "score", 2, 1, 0.5], [HEADLINE, "score", 1, 0.75, 0.75]]
    write_csv(folder / "precision_recall.csv", ["system", "by", "threshold", "precision", "recall"], points)
    write_csv(folder / "skipped.csv", ["folder", "image", "reason"], [["queries", HOSTILE[1], HOSTILE[0]]])
