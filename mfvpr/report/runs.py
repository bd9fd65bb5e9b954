"""Run folders: each belongs to one run, and its files appear together; the jobs of a multirun; names of files."""

import itertools
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
from pathlib import Path
from typing import Any

from mfvpr.datasets.ground_truth import threshold_words
from mfvpr.report.tables import Table, format_values, read_csv, table_of
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import lock_folder, write_text
from mfvpr.utils.fingerprints import fingerprint, versions

_UNFINISHED = ".unfinished"
LAST = "results.json"  # the file of a run that appears last

_MOST_BYTES = 200  # a file system takes 255, and `replacing` adds some
_PLAIN = re.compile(r'(?!\.)[^\x00-\x1f\x7f/\\:*?"<>|\ud800-\udfff]*[^\x00-\x1f\x7f/\\:*?"<>|\ud800-\udfff. ]')

Figure = tuple[str, Callable[[Path], Any]]  # name of the file, and what draws it there


@contextmanager
def claim_run_folder(folder: Path, *, numbered: bool = False, own: bool = False) -> Iterator[Path]:
    """Make and lock a new or empty folder, until the block or the process ends; it is removed if it is still empty.

    If `numbered`, `folder-2`, `folder-3`, ... stand in for a folder that exists. If only runs write into the folder
    (`own`), files of a killed run are removed. An InputError if the folder cannot be written to, is not empty, or
    another run uses it.
    """
    first, above = folder, [parent for parent in folder.absolute().parents if not parent.exists()]
    if folder.is_symlink() or folder.is_file():
        raise InputError(f"{folder}: expected a new or empty run folder, got a link or a file; name another")
    with ExitStack() as stack:
        try:
            for number in itertools.count(2):
                try:
                    folder.mkdir(parents=True, exist_ok=not numbered)
                    break
                except FileExistsError:
                    folder = first.with_name(f"{first.name}-{number}")
            in_use = InputError(f"{folder}: another run is using this folder; wait until it ends, or name another")
            with suppress(OSError):  # a file system without locks of folders, such as NFS
                stack.enter_context(lock_folder(folder, in_use))
            paths = [*folder.iterdir()]
            names = {path.name for path in paths} - {_UNFINISHED}
            if names and (not own or LAST in names):  # the folder stays as it is
                raise InputError(f"{folder}: expected a new or empty run folder; name another")
            for path in paths:  # of a run that was killed
                shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()
            with tempfile.TemporaryFile(dir=folder):
                pass
        except OSError as error:
            raise InputError(f"{folder}: cannot be written to ({error.strerror}); name another run folder") from None
        try:
            yield folder
        finally:
            with suppress(OSError):  # not empty
                for path in (folder, *above):
                    path.rmdir()


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


def write_about(folder: Path, settings: Mapping[str, Any], truth: Mapping[str, Any], command: str | None) -> None:
    """Write `run.json`: how a run was made."""
    about = {"command": command, "settings": settings, "ground_truth": truth}
    write_json(folder / "run.json", {**about, "commit": commit(Path()), "versions": versions()})


def write_json(path: Path, value: Any) -> None:
    """Write readable JSON, valid for all names of files."""
    write_text(path, json.dumps(value, indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def write_table(folder: Path, table: Table, heading: str, *, name: str = "table") -> None:
    """Write a table as Markdown, CSV and LaTeX."""
    write_text(folder / f"{name}.md", f"{heading}\n\n{table.markdown()}")
    write_text(folder / f"{name}.csv", table.csv())
    write_text(folder / f"{name}.tex", f"% {heading}\n{table.latex()}")


def add_job(multirun: Path, number: int, overrides: Mapping[str, str], run: Path) -> None:
    """Add a finished run to the joint table in the folder of its multirun; jobs may end at the same time."""
    results = json.loads((run / LAST).read_text("utf-8"))
    if isinstance(results, dict) and "axes" in results:  # of a sweep, the chosen setting
        row = {"system": results["scorer"]["method"]}
        for verdict in results["report"]:
            column = f"R@1{threshold_words(results['unit'], verdict['threshold'])}"
            row[column] = f"{100 * verdict['chosen']['recall']:.1f}"
        rows = [row | {"chosen": " / ".join(map(format_values, results["chosen"]))}]
    elif (run / "table.csv").exists():
        table = read_csv(run / "table.csv")
        rows = [{"system" if name == "score" else name: cell for name, cell in row.items()} for row in table]
    else:
        rows = [{"system": next(row["system"] for row in results if row["decides"])}]
    job = {"job": number, "overrides": dict(overrides), "run": str(run), "rows": rows}
    multirun.mkdir(parents=True, exist_ok=True)
    with lock_folder(multirun, None):
        known = json.loads((multirun / LAST).read_text("utf-8"))["jobs"] if (multirun / LAST).exists() else []
        jobs = sorted([*known, job], key=lambda job: job["job"])
        names = dict.fromkeys(name for job in jobs for name in job["overrides"] if name != "out")
        columns = {name for job in jobs for row in job["rows"] for name in row}
        differing = {
            name: f"{name}=" if name in columns else name  # such as system, which is also a column of results
            for name in names
            if len({job["overrides"].get(name) for job in jobs}) > 1
        }
        lines = []
        for each in jobs:
            settings = {column: each["overrides"].get(name, "") for name, column in differing.items()}
            lines += [{"job": str(each["job"])} | settings | row | {"run": each["run"]} for row in each["rows"]]
        table = table_of(lines, ["job", *differing.values(), "system", "sequence"])
        write_table(multirun, table, f"{len(jobs)} jobs")
        write_json(multirun / LAST, {"jobs": jobs})


def file_names(names: Sequence[str]) -> dict[str, str]:
    """File names without suffix, by name; they differ even if the file system ignores case.

    A file name is the name with `_` for ` + `. It ends in a hash instead if the name is not safe on every file system,
    too long, or the same as another.

    Raises:
        InputError: a name is repeated.
    """
    if repeated := [name for name, count in Counter(names).items() if count > 1]:
        raise InputError(f"names: expected different ones, got {repeated[0]} twice. Rename one.")
    files = {name: name.replace(" + ", "_") for name in names}
    folded = {name: unicodedata.normalize("NFC", file.casefold()) for name, file in files.items()}
    counts = Counter(folded.values())
    for name, file in files.items():
        if counts[folded[name]] > 1 or not _PLAIN.fullmatch(file) or len(file.encode()) > _MOST_BYTES:
            files[name] = f"{re.sub('[^A-Za-z0-9]+', '_', name)[:60]}-{fingerprint(name)}"
    return files
