"""Tables as text for the terminal, Markdown, CSV, and LaTeX; numbers and names in them."""

import csv
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from mfvpr.utils.errors import InputError
from mfvpr.utils.files import replacing

if TYPE_CHECKING:
    from pandas import DataFrame

_LATEX = str.maketrans(
    {character: rf"\{character}" for character in "&%_#${}"}
    | {"\\": r"\textbackslash{}", "^": r"\textasciicircum{}", "~": r"\textasciitilde{}", "±": r"$\pm$"}
)


@dataclass(frozen=True)
class Table:
    """A header and rows of text; the first `text_columns` are left-aligned, the numbers after them right."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    text_columns: int = 1

    def __str__(self) -> str:
        return self.text()

    def text(self) -> str:
        """Text for the terminal."""
        columns = []
        for number, column in enumerate(zip(self.header, *self.rows, strict=True)):
            width, is_text = max(map(len, column)), number < self.text_columns
            columns.append([cell.ljust(width) if is_text else cell.rjust(width) for cell in column])
        first, *lines = ("  ".join(cells).rstrip() for cells in zip(*columns, strict=True))
        return "\n".join([first, "-" * len(first), *lines]) + "\n"

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
    """Write names as the very bytes that the file system has, so that they can be looked up again.

    Floating-point numbers get 7 digits, NaN an empty cell. A spreadsheet may take a name that begins with `=`, `+`, `-`
    or `@` for a formula: import such columns as text.
    """

    def text(cell: Any) -> Any:
        return cell if not isinstance(cell, float | np.floating) else "" if np.isnan(cell) else f"{cell:.7g}"

    with replacing(path) as temporary:
        temporary.write_bytes(_csv([header, *(map(text, line) for line in lines)]).encode("utf-8", "surrogateescape"))


def _csv(rows: Iterable[Iterable[Any]]) -> str:
    """Lines that end in \\n, where every cell with an end of a line is quoted."""
    lines = list[str]()
    csv.writer(SimpleNamespace(write=lines.append)).writerows(rows)  # which quotes both characters of its line ends
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
