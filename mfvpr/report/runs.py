"""A run folder: appears whole under its name, or not at all."""

import json
import os
import platform
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from mfvpr.data.files import write_text
from mfvpr.errors import InputError
from mfvpr.report.tables import Table

PACKAGES = ("jax", "jaxlib", "numpy", "scipy", "opencv-python-headless", "pillow")


def new_run_folder(root: Path, name: str) -> Path:
    """`root/name/<time>` with a counter where two runs share a second."""
    stem = root / name / datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    folder, counter = stem, 1
    while folder.exists():
        counter += 1
        folder = stem.with_name(f"{stem.name}-{counter}")
    return folder


def claimed_run_folder(root: Path, name: str) -> Path:
    """A `new_run_folder`, made empty at once, so that no run that ends in the same second takes it; for `writing`."""
    while True:
        folder = new_run_folder(root, name)
        with suppress(FileExistsError):  # another run was faster
            folder.mkdir(parents=True)
            return folder


def check_free(folder: Path) -> None:
    """Refuse a run folder that already holds something, or cannot be made."""
    if os.path.lexists(folder) and (folder.is_symlink() or not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: expected a new or empty run folder; name another with out=DIR, or remove it")
    parent = next(parent for parent in (folder.absolute(), *folder.absolute().parents) if parent.exists())
    try:
        with tempfile.TemporaryDirectory(dir=parent):
            pass
    except OSError as error:
        raise InputError(
            f"{folder}: {parent} cannot be written to ({error.strerror}); name another run folder with out=DIR"
        ) from None


@contextmanager
def writing(folder: Path) -> Iterator[Path]:
    """A temporary folder beside `folder` that takes its name when the block ends without an error; else both go."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    try:
        yield temporary
        temporary.chmod(0o755)
        os.replace(temporary, folder)  # an empty folder of that name is replaced
    except BaseException:
        with suppress(OSError):  # not there, or not empty
            folder.rmdir()
        raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


@cache
def versions() -> dict[str, str]:
    """Versions of what computed the results."""
    return {
        "mfvpr": version("mfvpr"),
        "python": platform.python_version(),
        **{package: version(package) for package in PACKAGES},
    }


def write_results(folder: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """`results.json`: one row per system and tolerance."""
    write_text(folder / "results.json", json.dumps(rows, indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def write_table(folder: Path, table: Table) -> None:
    """The same table as Markdown, CSV and LaTeX."""
    write_text(folder / "table.md", table.markdown())
    write_text(folder / "table.csv", table.csv())
    write_text(folder / "table.tex", table.latex())


def write_predictions(
    path: Path, query_names: Sequence[str], database_names: Sequence[str], rows: np.ndarray, scores: np.ndarray
) -> None:
    """One line per query: its name, then database names with their scores, best first.

    Args:
        path: CSV file.
        query_names: of Q images.
        database_names: of N images.
        rows: `[Q, C]` database rows in rank order, -1 = none (left out).
        scores: `[Q, C]` in the same order.
    """
    header = ["query", *(f"{what}_{place + 1}" for place in range(rows.shape[1]) for what in ("database", "score"))]
    lines = []
    for name, ranked, values in zip(query_names, rows, scores, strict=True):
        cells = [name]
        for row, value in zip(ranked, values, strict=True):
            cells += [database_names[row], f"{value:.7g}"] if row >= 0 else ["", ""]
        lines.append(cells)
    write_text(path, Table(header, lines).csv())
