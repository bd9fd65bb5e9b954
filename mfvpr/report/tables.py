"""One table in the four shapes people paste: terminal, Markdown, CSV, LaTeX."""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Table:
    """A header and rows of text; the first column is left-aligned, the others right."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]

    def text(self) -> str:
        """For the terminal."""
        widths = [max(map(len, column)) for column in zip(self.header, *self.rows, strict=True)]
        lines = [self._aligned(row, widths) for row in (self.header, *self.rows)]
        return "\n".join([lines[0], "-" * len(lines[0]), *lines[1:]]) + "\n"

    def markdown(self) -> str:
        """GitHub's."""
        rule = [":--", *["--:"] * (len(self.header) - 1)]
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
        columns = "l" + "r" * (len(self.header) - 1)
        body = [rf"\begin{{tabular}}{{{columns}}}", r"\toprule", lines[0], r"\midrule", *lines[1:], r"\bottomrule"]
        return "\n".join([*body, r"\end{tabular}", ""])

    def _aligned(self, row: Sequence[str], widths: Sequence[int]) -> str:
        first, *others = (
            cell.rjust(width) if place else cell.ljust(width)
            for place, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        return "  ".join([first, *others]).rstrip()


def _latex_escaped(cell: str) -> str:
    for plain, escaped in (("\\", r"\textbackslash "), ("&", r"\&"), ("%", r"\%"), ("_", r"\_"), ("±", r"$\pm$")):
        cell = cell.replace(plain, escaped)
    return cell
