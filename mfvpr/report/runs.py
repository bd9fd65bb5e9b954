"""Tables, and run folders: each belongs to one run, and its files appear together; the jobs of a multirun."""

import csv
import itertools
import json
import os
import re
import shutil
import subprocess
import tempfile
import unicodedata
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from mfvpr.datasets.ground_truth import threshold_words
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import lock_folder, replacing, write_text
from mfvpr.utils.fingerprints import fingerprint, versions

if TYPE_CHECKING:
    from pandas import DataFrame

LAST = "results.json"  # the file of a run that appears last
_UNFINISHED = ".unfinished"
_MOST_BYTES = 200  # a file system takes 255, and `replacing` adds some
_PLAIN = re.compile(r'(?!\.)[^\x00-\x1f\x7f/\\:*?"<>|\ud800-\udfff]*[^\x00-\x1f\x7f/\\:*?"<>|\ud800-\udfff. ]')
_LATEX = str.maketrans(
    {character: rf"\{character}" for character in "&%_#${}"}
    | {"\\": r"\textbackslash{}", "^": r"\textasciicircum{}", "~": r"\textasciitilde{}", "±": r"$\pm$"}
)

Figure = tuple[str, Callable[[Path], Any]]  # name of the file, and what draws it there


@dataclass(frozen=True)
class Table:
    """A header and rows of text; the first `text_columns` are left-aligned, the numbers after them right."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    text_columns: int = 1

    def text(self) -> str:
        """Text for the terminal."""
        columns = []
        for number, column in enumerate(zip(self.header, *self.rows, strict=True)):
            width, is_text = max(map(len, column)), number < self.text_columns
            columns.append([cell.ljust(width) if is_text else cell.rjust(width) for cell in column])
        first, *lines = ("  ".join(cells).rstrip() for cells in zip(*columns, strict=True))
        return "\n".join([first, "-" * len(first), *lines]) + "\n"

    __str__ = text

    def markdown(self) -> str:
        """GitHub's Markdown."""
        rule = [":--"] * self.text_columns + ["--:"] * (len(self.header) - self.text_columns)
        escaped = ([cell.replace("|", "\\|") for cell in row] for row in (self.header, rule, *self.rows))
        return "".join(f"| {' | '.join(row)} |\n" for row in escaped)

    def csv(self) -> str:
        """Comma-separated lines that end in \\n; every cell with an end of a line is quoted."""
        return _csv([self.header, *self.rows])

    def latex(self) -> str:
        """A `tabular` for the booktabs package."""
        lines = [" & ".join(cell.translate(_LATEX) for cell in row) + r" \\" for row in (self.header, *self.rows)]
        columns = "l" * self.text_columns + "r" * (len(self.header) - self.text_columns)
        body = [rf"\begin{{tabular}}{{{columns}}}", r"\toprule", lines[0], r"\midrule", *lines[1:], r"\bottomrule"]
        return "\n".join([*body, r"\end{tabular}", ""])


def data_frame(rows: Sequence[Mapping[str, Any]]) -> "DataFrame":
    """Rows by column as a `DataFrame`; InputError if pandas is not installed."""
    try:
        import pandas
    except ImportError:
        raise InputError("to_pandas: expected pandas, got none; run pip install 'mfvpr[pandas]'") from None
    return pandas.DataFrame(rows)


def table_of(rows: Sequence[Mapping[str, str]], text_columns: Sequence[str]) -> Table:
    """Table of rows by column, those with text first; cells that a row lacks are empty."""
    known = dict.fromkeys(name for row in rows for name in row)
    texts = [name for name in text_columns if name in known]
    header = list(dict.fromkeys([*texts, *known]))
    return Table(header, [[row.get(name, "") for name in header] for row in rows], len(texts))


def read_csv(path: Path) -> list[dict[str, str]]:
    """Rows of a file of `write_csv` by column; a ValueError if the file is cut off."""
    with path.open(encoding="utf-8", errors="surrogateescape", newline="") as file:
        header, *rows = csv.reader(file)
    if any(len(row) != len(header) for row in rows):
        raise ValueError(f"{path.name}: expected lines of {len(header)} cells")
    return [dict(zip(header, row, strict=True)) for row in rows]


def write_csv(path: Path, header: Sequence[str], lines: Iterable[Iterable[Any]]) -> None:
    """Write names as the very bytes that the file system has; floating-point numbers with 7 digits, NaN as nothing.

    A spreadsheet may take a name that begins with `=`, `+`, `-` or `@` for a formula: import such columns as text.
    """

    def text(cell: Any) -> Any:
        if isinstance(cell, float | np.floating):
            return "" if np.isnan(cell) else f"{cell:.7g}"
        return cell

    with replacing(path) as temporary:
        temporary.write_bytes(_csv([header, *(map(text, line) for line in lines)]).encode("utf-8", "surrogateescape"))


def _csv(rows: Iterable[Iterable[Any]]) -> str:
    """Lines that end in \\n, where every cell with an end of a line is quoted."""
    lines = list[str]()
    file: Any = SimpleNamespace(write=lines.append)
    csv.writer(file).writerows(rows)  # which quotes both characters of its line ends
    return "".join(line.removesuffix("\r\n") + "\n" for line in lines)


def format_value(value: Any) -> str:
    """A parameter's value in a cell."""
    return "none" if value is None else f"{value:g}" if isinstance(value, float | np.floating) else str(value)


def format_values(values: Mapping[str, Any]) -> str:
    """Parameters and their values in a line."""
    return ", ".join(f"{name} = {format_value(value)}" for name, value in values.items())


def format_interval(interval: tuple[float, float]) -> str:
    """An interval of fractions, in %."""
    return f"[{100 * interval[0]:.1f}, {100 * interval[1]:.1f}]"


def format_estimate(estimate: tuple[float, tuple[float, float]]) -> str:
    """A fraction with its interval, in %."""
    return f"{100 * estimate[0]:.1f} {format_interval(estimate[1])}"


@contextmanager
def claim_run_folder(folder: Path, *, numbered: bool = False, is_exclusive: bool = False) -> Iterator[Path]:
    """Make and lock a new or empty folder, until the block or the process ends; it is removed if it is still empty.

    If `numbered`, `folder-2`, `folder-3`, ... stand in for one that exists. If only runs write into it, `is_exclusive`,
    files of a killed run are removed. An InputError if it cannot be written to, is not empty, or another run uses it.
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
            if names and (not is_exclusive or LAST in names):  # the folder stays as it is
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
        rows = [{"system": results["scorer"]["method"]}]
        for verdict in results["report"]:
            words = threshold_words(results["unit"], verdict["threshold"])
            rows[0][f"R@1{words}"] = f"{100 * verdict['chosen']['recall']:.1f}"
        rows[0]["chosen"] = " / ".join(map(format_values, results["chosen"]))
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
        of_results = {name for job in jobs for row in job["rows"] for name in row}
        differing = [name for name in names if len({job["overrides"].get(name) for job in jobs}) > 1]
        # Such as system, which is also a column of results.
        columns = {name: f"{name}=" if name in of_results else name for name in differing}
        lines = []
        for each in jobs:
            settings = {column: each["overrides"].get(name, "") for name, column in columns.items()}
            lines += [{"job": str(each["job"])} | settings | row | {"run": each["run"]} for row in each["rows"]]
        table = table_of(lines, ["job", *columns.values(), "system", "sequence"])
        write_table(multirun, table, f"{len(jobs)} jobs")
        write_json(multirun / LAST, {"jobs": jobs})


def file_names(names: Sequence[str]) -> dict[str, str]:
    """File names without suffix, by name; they differ even if the file system ignores case.

    A file name is the name with `_` for ` + `. It ends in a hash instead if the name is not safe on every file system,
    too long, or the same as another. An InputError if a name is repeated.
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
