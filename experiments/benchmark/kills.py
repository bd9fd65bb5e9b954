"""Shards of small evaluations that are killed (SIGKILL) at random moments: what is left, and whether it is the same.

Two tasks of an evaluation run beside each other, die at any moment between their start and their end, and those that
are missing are started again, until the results are there. Then the stores' rows and the tables must be those of tasks
that nobody disturbed, byte by byte, and no row may have been written twice.
"""

import hashlib
import json
import math
import os
import platform
import random
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from experiments import sharding
from experiments.console import bar
from experiments.settings import SettingsError
from mfvpr.datasets.streets import streets_folder
from mfvpr.report import Table
from mfvpr.utils.files import write_text
from mfvpr.utils.versions import versions

KILLS, SHARDS = 200, 2
FRAMES, IMAGE_SIZE = 40, (160, 120)
POLL = 0.02  # seconds

Rows = dict[str, tuple[int, int]]  # by path, the file itself: its inode and time


def run(rounds: int | None, out: Path) -> None:
    """Print a table and write it as JSON to `out`; `rounds` is the number of kills."""
    kills, wanted, runs, where = 0, rounds or KILLS, 0, Counter[str]()
    with tempfile.TemporaryDirectory(prefix="mfvpr-kills-") as root:
        place, rng = Path(root), random.Random(0)
        street = streets_folder(place, num_frames=FRAMES, image_size=IMAGE_SIZE)
        os.environ["JAX_COMPILATION_CACHE_DIR"] = f"{place}/programs"
        _undisturbed(place / "first", street)  # whose programs the others take
        expected = _undisturbed(place / "undisturbed", street)
        start = time.perf_counter()
        _task(place / "undisturbed", street, 0).wait()  # which finds that all is done
        seconds = time.perf_counter() - start
        shown = bar("kills", wanted)
        while kills < wanted:
            disturbed = _disturbed(place / f"{runs}", street, seconds, rng, wanted - kills)
            if (found := content(place / f"{runs}")) != expected:
                wrong = sorted(name for name in {*found, *expected} if found.get(name) != expected.get(name))
                raise SettingsError(f"kills: {wrong[0]} and {len(wrong) - 1} more differ from an undisturbed run")
            where += disturbed
            shown.update(disturbed.total())
            kills, runs = kills + disturbed.total(), runs + 1
        shown.close()
    report(where, runs, out)


def _undisturbed(place: Path, street: Path) -> dict[str, str]:
    while missing := _missing(place):
        for index in missing:
            if _task(place, street, index).wait():
                raise SettingsError(f"kills: the task {index}/{SHARDS} of an undisturbed run failed")
    return content(place)


def _disturbed(place: Path, street: Path, seconds: float, rng: random.Random, most: int) -> Counter[str]:
    """Kills, by what the task had said last, until the results are there; and that no row was written twice."""
    where, rows = Counter[str](), {}
    while missing := _missing(place):
        tasks = {index: (_task(place, street, index), time.monotonic() + _delay(rng, seconds)) for index in missing}
        while tasks:
            time.sleep(POLL)
            _check_rows(rows, place)
            for index, (task, end) in list(tasks.items()):
                if task.poll() is not None:
                    if task.returncode:
                        raise SettingsError(f"kills: the task {index}/{SHARDS} failed with {task.returncode}: "
                                            f"{_said(place, index)}")  # fmt: skip
                    del tasks[index]
                elif time.monotonic() > end and where.total() < most:
                    stage = _stage(place)
                    task.kill()
                    task.wait()
                    where[stage] += 1
                    del tasks[index]
    _check_rows(rows, place)
    return where


def _delay(rng: random.Random, seconds: float) -> float:
    """When a task is killed, from its start: about when it has found what is done; one of four is left alone."""
    return math.inf if rng.random() < 0.25 else rng.uniform(0.6, 1.8) * seconds


def _task(place: Path, street: Path, index: int) -> subprocess.Popen[bytes]:
    settings = [
        "dataset=folder", f"dataset.database={street}/database", f"dataset.queries={street}/queries",
        "dataset.ground_truth=index", f"dataset.index_file={street}/ground_truth.csv", "dataset.widen_index=true",
        "features.max_keypoints=200", f"features.image_size=[{IMAGE_SIZE[0]},{IMAGE_SIZE[1]}]", "retrieval.num_words=8",
        "candidates=20", "figures=2", f"store={place}/store", f"out={place}/out", f"shard={index}/{SHARDS}",
    ]  # fmt: skip
    command = [sys.executable, "-m", "experiments.evaluate", *settings]
    place.mkdir(exist_ok=True)
    with (place / f"{index}.log").open("w", encoding="utf-8") as log:
        return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=log)


def _said(place: Path, index: int) -> str:
    """The last line of a task."""
    return ([*(place / f"{index}.log").read_text("utf-8").splitlines()] or ["nothing"])[-1]


def _missing(place: Path) -> list[int]:
    if not (place / "out" / sharding.SHARDS / "run.json").exists():
        return list(range(SHARDS))
    return sharding.missing(place / "out")


def _rows(place: Path) -> dict[str, Path]:
    return {str(path.relative_to(place)): path for path in (place / "store").glob("*/shards/*/[0-9]*-*.npz")}


def _check_rows(rows: Rows, place: Path) -> None:
    """That the files of rows are those that were there before."""
    for name, path in _rows(place).items():
        state = path.stat()
        if rows.setdefault(name, (state.st_ino, state.st_mtime_ns)) != (state.st_ino, state.st_mtime_ns):
            raise SettingsError(f"kills: {name} was written twice")


def _stage(place: Path) -> str:
    """What is under way, as the stores tell."""
    kinds = {path.relative_to(place / "store").parts[0].partition("-")[0] for path in _rows(place).values()}
    queries = {path.name.partition("-")[0] for path in (place / "store").glob("scores-*/shards/*/[0-9]*-*.npz")}
    if len(queries) == FRAMES:
        return "results and report"
    return "matching and scoring" if "matches" in kinds else "extraction" if kinds else "before the first row"


def content(place: Path) -> dict[str, str]:
    """SHA-256 of all rows of all stores, and of all tables, by name."""
    tables = {path.name: path for path in (place / "out").glob("*.csv")}
    files: Mapping[str, Path] = _rows(place) | tables
    return {name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in files.items()}


def report(where: Mapping[str, int], runs: int, out: Path) -> None:
    """Print the table, and write everything as JSON."""
    lines: Sequence[Sequence[str]] = [[stage, str(number)] for stage, number in where.items()]
    print(Table(["killed during", "times"], [*lines, ["in all", str(sum(where.values()))]]).text())
    print(f"{runs} evaluations in {SHARDS} shards: rows and tables as undisturbed, byte by byte; no row written twice")
    found = {"machine": platform.machine(), "versions": versions(), "evaluations": runs, "kills": dict(where)}
    write_text(out, json.dumps(found, indent=1) + "\n")
    print(f"results: {out}")
