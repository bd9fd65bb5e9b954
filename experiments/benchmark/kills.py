"""Kill the tasks of small sharded evaluations at random moments, and compare the results with undisturbed ones.

Two shards of an evaluation run side by side and receive SIGKILL at any moment. They are started again until both are
done. Then a run without a shard, which is killed as well, writes the results. The rows in the stores and the tables
must equal those of undisturbed tasks byte by byte, and no row may have been written twice.
"""

import hashlib
import math
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from experiments.benchmark.harness import duration, write_report
from experiments.console import bar
from experiments.settings import SettingsError
from mfvpr.datasets.streets import streets_folder
from mfvpr.report import Table
from mfvpr.report.runs import LAST

KILLS = 200
SHARDS, NO_SHARD = ("0/2", "1/2"), "null"  # values of the setting `shard`
FRAMES, IMAGE_SIZE = 40, (160, 120)
POLL = 0.02  # seconds

FileStates = dict[str, tuple[int, int]]  # path -> inode and time of modification


def run(rounds: int | None, out: Path) -> None:
    """Kill `rounds` tasks, and count during which stage each was killed."""
    total, evaluations, kills = rounds or KILLS, 0, Counter[str]()
    with tempfile.TemporaryDirectory(prefix="mfvpr-kills-") as temporary:
        root, rng = Path(temporary), random.Random(0)
        street = streets_folder(root, num_frames=FRAMES, image_size=IMAGE_SIZE)
        os.environ["JAX_COMPILATION_CACHE_DIR"] = f"{root}/programs"
        _evaluate(root / "first", street)  # fills the compilation cache
        _evaluate(root / "undisturbed", street)
        expected = file_hashes(root / "undisturbed")
        seconds = duration(lambda: _start_task(root / "undisturbed", street, SHARDS[0]).wait())  # with nothing to do
        with bar("kills", total) as progress:
            while kills.total() < total:
                folder = root / f"{evaluations}"
                new_kills = _evaluate(folder, street, rng, seconds, total - kills.total())
                hashes = file_hashes(folder)
                differing = sorted(name for name in {*hashes, *expected} if hashes.get(name) != expected.get(name))
                if differing:
                    raise SettingsError(f"kills: {len(differing)} files differ from an undisturbed run: {differing[0]}")
                kills += new_kills
                evaluations += 1
                progress.update(new_kills.total())
    lines = [[stage, str(count)] for stage, count in [*kills.items(), ("in all", kills.total())]]
    title = f"{evaluations} evaluations in shards: rows and tables equal undisturbed ones, rows written once"
    content = {"evaluations": evaluations, "kills": dict(kills)}
    write_report(out, title, [Table(["killed during", "times"], lines)], content)


def _evaluate(
    folder: Path, street: Path, rng: random.Random | None = None, seconds: float = 0.0, max_kills: int = 0
) -> Counter[str]:
    """Run an evaluation, kill its tasks after about `seconds`, and count the kills by stage."""
    kills, states = Counter[str](), {}
    for shards in (SHARDS, [NO_SHARD]):
        while pending := [shard for shard in shards if not _is_complete(folder, shard)]:
            delays = {shard: _delay(rng, seconds) if rng else math.inf for shard in pending}
            kills += _run_tasks(folder, street, delays, states, max_kills - kills.total())
    return kills


def _run_tasks(
    folder: Path, street: Path, delays: dict[str, float], states: FileStates, max_kills: int
) -> Counter[str]:
    """Run tasks side by side until each has ended or was killed after its delay; count the kills by stage."""
    kills, start = Counter[str](), time.monotonic()
    tasks = {shard: _start_task(folder, street, shard) for shard in delays}
    while tasks:
        time.sleep(POLL)
        for shard, task in list(tasks.items()):
            if task.poll() is not None:
                if task.returncode:
                    error = f"failed with {task.returncode}: {_log(folder, shard).read_text('utf-8')[-200:]}"
                    raise SettingsError(f"kills: the task shard={shard} {error}")
                del tasks[shard]
            elif time.monotonic() - start > delays[shard] and kills.total() < max_kills:
                kills[_stage(folder, shard)] += 1
                task.kill()
                task.wait()
                del tasks[shard]
        _check_rows(states, folder)
    return kills


def _delay(rng: random.Random, seconds: float) -> float:
    """Seconds from start to kill: about when the task has read the stores. One of four tasks is not killed."""
    return math.inf if rng.random() < 0.25 else rng.uniform(0.6, 1.8) * seconds


def _start_task(folder: Path, street: Path, shard: str) -> subprocess.Popen[bytes]:
    settings = [
        "dataset=folder", f"dataset.database={street}/database", f"dataset.queries={street}/queries",
        "dataset.ground_truth=index", f"dataset.index_file={street}/ground_truth.csv", "dataset.widen_index=true",
        "features.max_keypoints=200", f"features.image_size=[{IMAGE_SIZE[0]},{IMAGE_SIZE[1]}]", "retrieval.num_words=8",
        "candidates=20", "figures=2", f"cache={folder}/store", f"out={folder}/out", f"shard={shard}",
    ]  # fmt: skip
    folder.mkdir(exist_ok=True)
    shutil.rmtree(folder / "out", ignore_errors=True)  # of a run that was killed
    with _log(folder, shard).open("w", encoding="utf-8") as log:
        command = [sys.executable, "-m", "experiments.evaluate", *settings]
        return subprocess.Popen(command, stdout=log, stderr=log)


def _log(folder: Path, shard: str) -> Path:
    return folder / f"{shard.replace('/', '-of-')}.log"


def _is_complete(folder: Path, shard: str) -> bool:
    if shard == NO_SHARD:
        return (folder / "out" / LAST).exists()
    log = _log(folder, shard)
    return log.exists() and "are done" in log.read_text("utf-8")


def _row_files(folder: Path) -> dict[str, Path]:
    return {str(path.relative_to(folder)): path for path in (folder / "store").rglob("[0-9]*-*.npz")}


def _check_rows(states: FileStates, folder: Path) -> None:
    """Add new files to `states`, and raise if a file was replaced."""
    for name, path in _row_files(folder).items():
        state = path.stat()
        if states.setdefault(name, (state.st_ino, state.st_mtime_ns)) != (state.st_ino, state.st_mtime_ns):
            raise SettingsError(f"kills: {name} was written twice")


def _stage(folder: Path, shard: str) -> str:
    """Stage under way, according to the files in the stores."""
    if shard == NO_SHARD:
        return "results and report"
    kinds = {path.relative_to(folder / "store").parts[0].partition("-")[0] for path in _row_files(folder).values()}
    return "matching" if "matches" in kinds else "extraction" if kinds else "before the first row"


def file_hashes(folder: Path) -> dict[str, str]:
    """SHA-256 of all rows of all stores and of all tables, by name."""
    files = _row_files(folder) | {path.name: path for path in (folder / "out").glob("*.csv")}
    return {name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in files.items()}
