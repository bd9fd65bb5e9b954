"""A run folder: of one run alone, and its files appear together."""

import json
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import Any

from mfvpr.report.tables import Table
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import write_text
from mfvpr.utils.locks import lock_folder

_UNFINISHED = ".unfinished"
LAST = "results.json"  # of the files of a run

Figure = tuple[str, Callable[[Path], None]]  # name of the file, and what draws it there


def new_run_folder(root: Path, name: str) -> Path:
    """`root/name/<time>`, to be `claimed`."""
    return root / name / datetime.now().strftime("%Y-%m-%d_%H-%M-%S")


@contextmanager
def claimed(folder: Path, *, numbered: bool = False, own: bool = False, beside: Collection[str] = ()) -> Iterator[Path]:
    """A new or empty folder for this process alone, until the block ends or the process does, however that ends.

    It is removed again, with the folders that were made for it, where nothing was left in it.

    Args:
        folder: of the run.
        numbered: where there is such a folder, `folder-2`, `folder-3`, ... is taken instead.
        own: nobody but runs puts anything into it; what one left that was killed is removed.
        beside: names of what may be there, and stays.

    Raises:
        InputError: the folder cannot be made or written to, is not empty, or another run has it.
    """
    above = [parent for parent in folder.absolute().parents if not parent.exists()]
    with _telling_why(folder):
        folder = _made(folder, numbered)
    error = InputError(f"{folder}: another run is using this folder; wait until it ends, or name another")
    with ExitStack() as stack:
        with suppress(OSError):  # a file system without locks of folders, such as NFS
            stack.enter_context(lock_folder(folder, error))
        _clear(folder, own, {*beside})  # until then it may be another's, and must stay
        try:
            yield folder
        finally:
            with suppress(OSError):  # not empty
                for path in (folder, *above):
                    path.rmdir()


def _made(folder: Path, numbered: bool) -> Path:
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise InputError(f"{folder}: expected a new or empty run folder, got a link or a file; name another")
    wanted, number = folder, 1
    while True:
        try:
            wanted.mkdir(parents=True, exist_ok=not numbered)
            return wanted
        except FileExistsError:
            number += 1
            wanted = folder.with_name(f"{folder.name}-{number}")


def _clear(folder: Path, own: bool, beside: set[str]) -> None:
    """Remove leftovers of killed runs, and check that a run can be written into the folder."""
    with _telling_why(folder):
        found = {path.name for path in folder.iterdir()} - beside
        if own and LAST not in found:
            _empty(folder, beside)
        elif found - {_UNFINISHED}:
            raise InputError(f"{folder}: expected a new or empty run folder; remove it, or name another")
        shutil.rmtree(folder / _UNFINISHED, ignore_errors=True)  # of a run that was killed
        with tempfile.TemporaryFile(dir=folder):
            pass


def _empty(folder: Path, beside: set[str]) -> None:
    """Without what a run had moved there when it was killed."""
    for path in (path for path in folder.iterdir() if path.name not in beside):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()


@contextmanager
def _telling_why(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise InputError(f"{folder}: cannot be written to ({error.strerror}); name another run folder") from None


@contextmanager
def writing(folder: Path) -> Iterator[Path]:
    """A temporary folder in a `claimed` one, whose files move up when the block ends without an error.

    `results.json` comes last: where it is, everything is.
    """
    temporary = folder / _UNFINISHED
    temporary.mkdir(parents=True)  # should somebody have removed the empty folder meanwhile
    try:
        yield temporary
        for path in sorted(temporary.iterdir(), key=lambda path: path.name == LAST):
            os.replace(path, folder / path.name)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def commit(place: Path) -> str | None:
    """The commit of the repository that a folder lies in, `-dirty` where files differ from it; None without one."""
    asked = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        found = subprocess.run(asked, cwd=place, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return found.stdout.strip() or None


def write_json(path: Path, value: Any) -> None:
    """Readable JSON, valid whatever the names of files."""
    text = json.dumps(value, indent=1, ensure_ascii=False, allow_nan=False)
    write_text(path, re.sub("[\ud800-\udfff]", lambda found: f"\\u{ord(found[0]):04x}", text) + "\n")


def write_table(folder: Path, table: Table, heading: str, *, name: str = "table") -> None:
    """The same table as Markdown, CSV and LaTeX."""
    write_text(folder / f"{name}.md", f"{heading}\n\n{table.markdown()}")
    write_text(folder / f"{name}.csv", table.csv())
    write_text(folder / f"{name}.tex", f"% {heading}\n{table.latex()}")
