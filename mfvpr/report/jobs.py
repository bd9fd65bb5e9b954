"""The joint table of the jobs of a multirun: a line per job and system, with the settings that differ."""

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from mfvpr.datasets.truth import threshold_words
from mfvpr.report.runs import LAST, write_json, write_table
from mfvpr.report.tables import Table, format_value, read_csv
from mfvpr.utils.locks import lock


def add_job(multirun: Path, number: int, overrides: Mapping[str, str], run: Path) -> None:
    """Add a finished run to the joint table in the folder of its multirun; jobs may end at the same time."""
    job = {"job": number, "overrides": dict(overrides), "run": str(run), "rows": list(_rows(run))}
    multirun.mkdir(parents=True, exist_ok=True)
    with lock(multirun, os.O_RDONLY | os.O_DIRECTORY, lambda _: None):
        known = json.loads((multirun / LAST).read_text("utf-8"))["jobs"] if (multirun / LAST).exists() else []
        jobs = sorted([*known, job], key=lambda job: job["job"])
        write_table(multirun, _joint_table(jobs), f"{len(jobs)} jobs")
        write_json(multirun / LAST, {"jobs": jobs})


def _joint_table(jobs: Sequence[Mapping[str, Any]]) -> Table:
    names = dict.fromkeys(name for job in jobs for name in job["overrides"])
    differing = [name for name in names if len({job["overrides"].get(name) for job in jobs}) > 1 and name != "out"]
    columns = list(dict.fromkeys(name for job in jobs for row in job["rows"] for name in row))
    lines = [
        [str(job["job"]), *(job["overrides"].get(name, "") for name in differing),
         *(row.get(name, "") for name in columns), job["run"]]
        for job in jobs for row in job["rows"]
    ]  # fmt: skip
    return Table(["job", *differing, *columns, "run"], lines, text_columns=len(differing) + 2)


def _rows(run: Path) -> Iterator[dict[str, str]]:
    """Cells by column of every system of a run: an evaluation, a sweep or a learning comparison."""
    results = json.loads((run / LAST).read_text("utf-8"))
    if isinstance(results, dict) and "axes" in results:
        chosen = ("; ".join(f"{name} = {format_value(value)}" for name, value in setting.items())
                  for setting in results["chosen"])  # fmt: skip
        recalls = {f"R@1{threshold_words(results['unit'], verdict['threshold'])}":
                   f"{100 * verdict['chosen']['recall']:.1f}" for verdict in results["report"]}  # fmt: skip
        yield {"system": results["scorer"]["method"], **recalls, "chosen": " / ".join(chosen)}
    elif (run / "table.csv").exists():
        for row in read_csv(run / "table.csv"):
            yield {"system" if name == "score" else name: cell for name, cell in row.items()}
    else:
        yield {"system": next(row["system"] for row in results if row["decides"])}
