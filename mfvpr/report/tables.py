"""One table in the four shapes people paste: terminal, Markdown, CSV, LaTeX."""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Table:
    """A header and rows of text; the first `text_columns` are left-aligned, the numbers after them right."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    text_columns: int = 1

    def text(self) -> str:
        """For the terminal."""
        widths = [max(map(len, column)) for column in zip(self.header, *self.rows, strict=True)]
        lines = [self._aligned(row, widths) for row in (self.header, *self.rows)]
        return "\n".join([lines[0], "-" * len(lines[0]), *lines[1:]]) + "\n"

    def markdown(self) -> str:
        """GitHub's."""
        rule = [":--"] * self.text_columns + ["--:"] * (len(self.header) - self.text_columns)
        escaped = ([cell.replace("|", "\\|") for cell in row] for row in (self.header, rule, *self.rows))
        return "".join(f"| {' | '.join(row)} |\n" for row in escaped)

    def csv(self) -> str:
        """Comma-separated, quoted where needed."""
        out = io.StringIO()
        csv.writer(out, lineterminator="\n").writerows([self.header, *self.rows])
        return out.getvalue()

    def latex(self) -> str:
        """A `tabular` for the booktabs package."""
        lines = [" & ".join(map(_latex_escaped, row)) + r" \\" for row in (self.header, *self.rows)]
        columns = "l" * self.text_columns + "r" * (len(self.header) - self.text_columns)
        body = [rf"\begin{{tabular}}{{{columns}}}", r"\toprule", lines[0], r"\midrule", *lines[1:], r"\bottomrule"]
        return "\n".join([*body, r"\end{tabular}", ""])

    def _aligned(self, row: Sequence[str], widths: Sequence[int]) -> str:
        cells = (
            cell.ljust(width) if place < self.text_columns else cell.rjust(width)
            for place, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        return "  ".join(cells).rstrip()


def written(value: Any) -> str:
    """A parameter's value in a cell."""
    if value is None:
        return "none"
    return f"{value:g}" if isinstance(value, float | np.floating) else str(value)


def _latex_escaped(cell: str) -> str:
    for plain, escaped in (("\\", r"\textbackslash "), ("&", r"\&"), ("%", r"\%"), ("_", r"\_"), ("±", r"$\pm$")):
        cell = cell.replace(plain, escaped)
    return cell
