"""Run folders: each belongs to one run, and its files appear together; the jobs of a multirun; names of files."""

import json
import os
import re
import shutil
import subprocess
import tempfile
import unicodedata
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import Any

from mfvpr.datasets.ground_truth import threshold_words
from mfvpr.report.tables import Table, format_value, read_csv
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import lock_folder, write_text
from mfvpr.utils.fingerprints import fingerprint
from mfvpr.utils.versions import versions

_UNFINISHED = ".unfinished"
LAST = "results.json"  # the file of a run that appears last

_MOST_BYTES = 200  # a file system takes 255, and `replacing` adds some
_PLAIN = re.compile(r'(?!\.)[^\x00-\x1f\x7f/\\:*?"<>|\ud800-\udfff]*[^\x00-\x1f\x7f/\\:*?"<>|\ud800-\udfff. ]')
_HASHED = re.compile(r".*-[0-9a-f]{16}", re.IGNORECASE | re.DOTALL)

Figure = tuple[str, Callable[[Path], None]]  # name of the file, and what draws it there


def new_run_folder(root: Path, name: str) -> Path:
    """The path `root/name/<time>`, for `claim_run_folder`."""
    return root / name / datetime.now().strftime("%Y-%m-%d_%H-%M-%S")


@contextmanager
def claim_run_folder(folder: Path, *, numbered: bool = False, own: bool = False) -> Iterator[Path]:
    """Make and lock a new or empty folder, until the block or the process ends.

    An empty folder is removed at the end, with the parents that were made for it.

    Args:
        folder: of the run.
        numbered: take `folder-2`, `folder-3`, ... if the folder exists.
        own: only runs write into the folder; files of a killed run are removed.

    Raises:
        InputError: the folder cannot be made or written to, is not empty, or another run uses it.
    """
    above = [parent for parent in folder.absolute().parents if not parent.exists()]
    with ExitStack() as stack:
        try:
            folder = _make(folder, numbered)
            in_use = InputError(f"{folder}: another run is using this folder; wait until it ends, or name another")
            with suppress(OSError):  # a file system without locks of folders, such as NFS
                stack.enter_context(lock_folder(folder, in_use))
            _clear(folder, own)  # a folder that is refused must stay
        except OSError as error:
            raise InputError(f"{folder}: cannot be written to ({error.strerror}); name another run folder") from None
        try:
            yield folder
        finally:
            with suppress(OSError):  # not empty
                for path in (folder, *above):
                    path.rmdir()


def _make(folder: Path, numbered: bool) -> Path:
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise InputError(f"{folder}: expected a new or empty run folder, got a link or a file; name another")
    free, number = folder, 1
    while True:
        try:
            free.mkdir(parents=True, exist_ok=not numbered)
            return free
        except FileExistsError:
            number += 1
            free = folder.with_name(f"{folder.name}-{number}")


def _clear(folder: Path, only_runs: bool) -> None:
    """Remove files of a killed run, and check that the folder is empty and writable."""
    paths = [*folder.iterdir()]
    names = {path.name for path in paths}
    if only_runs and LAST not in names:
        for path in paths:
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink()
    elif names - {_UNFINISHED}:
        raise InputError(f"{folder}: expected a new or empty run folder; name another")
    shutil.rmtree(folder / _UNFINISHED, ignore_errors=True)  # of a run that was killed
    with tempfile.TemporaryFile(dir=folder):
        pass


@contextmanager
def writing(folder: Path) -> Iterator[Path]:
    """A temporary folder in a run folder; its files move up when the block ends without an error.

    `results.json` moves last: a folder that has it is complete.
    """
    temporary = folder / _UNFINISHED
    temporary.mkdir(parents=True)  # the user may have removed the empty folder meanwhile
    try:
        yield temporary
        for path in sorted(temporary.iterdir(), key=lambda path: path.name == LAST):
            os.replace(path, folder / path.name)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def commit(place: Path) -> str | None:
    """The commit of the repository of a folder, with `-dirty` if files differ from it; None without a repository."""
    command = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        output = subprocess.run(command, cwd=place, capture_output=True, text=True, timeout=10, check=True).stdout
    except (OSError, subprocess.SubprocessError):
        return None
    return output.strip() or None


def write_about(
    folder: Path, settings: Mapping[str, Any], ground_truth: Mapping[str, Any], command: str | None = None
) -> None:
    """Write `run.json`: how a run was made."""
    write_json(folder / "run.json", {
        "command": command, "settings": settings, "ground_truth": ground_truth, "commit": commit(Path()),
        "versions": versions(),
    })  # fmt: skip


def write_json(path: Path, value: Any) -> None:
    """Write readable JSON, valid for all names of files."""
    text = json.dumps(value, indent=1, ensure_ascii=False, allow_nan=False)
    write_text(path, re.sub("[\ud800-\udfff]", lambda surrogate: f"\\u{ord(surrogate[0]):04x}", text) + "\n")


def write_table(folder: Path, table: Table, heading: str, *, name: str = "table") -> None:
    """Write a table as Markdown, CSV and LaTeX."""
    write_text(folder / f"{name}.md", f"{heading}\n\n{table.markdown()}")
    write_text(folder / f"{name}.csv", table.csv())
    write_text(folder / f"{name}.tex", f"% {heading}\n{table.latex()}")


def add_job(multirun: Path, number: int, overrides: Mapping[str, str], run: Path) -> None:
    """Add a finished run to the joint table in the folder of its multirun; jobs may end at the same time."""
    job = {"job": number, "overrides": dict(overrides), "run": str(run), "rows": list(_rows(run))}
    multirun.mkdir(parents=True, exist_ok=True)
    with lock_folder(multirun, None):
        known = json.loads((multirun / LAST).read_text("utf-8"))["jobs"] if (multirun / LAST).exists() else []
        jobs = sorted([*known, job], key=lambda job: job["job"])
        names = dict.fromkeys(name for job in jobs for name in job["overrides"])
        differing = [name for name in names if len({job["overrides"].get(name) for job in jobs}) > 1 and name != "out"]
        columns = list(dict.fromkeys(name for job in jobs for row in job["rows"] for name in row))
        lines = [
            [str(job["job"]), *(job["overrides"].get(name, "") for name in differing),
             *(row.get(name, "") for name in columns), job["run"]]
            for job in jobs for row in job["rows"]
        ]  # fmt: skip
        table = Table(["job", *differing, *columns, "run"], lines, text_columns=len(differing) + 2)
        write_table(multirun, table, f"{len(jobs)} jobs")
        write_json(multirun / LAST, {"jobs": jobs})


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


def file_names(names: Sequence[str]) -> dict[str, str]:
    """File names without suffix, by name; they differ even if the file system ignores case.

    A file name is the name with `_` for ` + `. It ends in a hash instead if the name is not safe on every file system,
    too long, or the same as another.

    Raises:
        InputError: a name is repeated.
    """
    if repeated := [name for name, count in Counter(names).items() if count > 1]:
        raise InputError(f"names: expected different ones, got {repeated[0]} twice. Rename one.")
    plain = {name: name.replace(" + ", "_") for name in names}
    counts = Counter(map(_fold_case, plain.values()))
    files = {}
    for name, file in plain.items():
        is_safe = _PLAIN.fullmatch(file) and not _HASHED.fullmatch(file) and len(file.encode()) <= _MOST_BYTES
        hashed = f"{re.sub('[^A-Za-z0-9]+', '_', name)[:60]}-{fingerprint(name)}"
        files[name] = file if is_safe and counts[_fold_case(file)] == 1 else hashed
    return files


def _fold_case(file: str) -> str:
    return unicodedata.normalize("NFC", file.casefold())
