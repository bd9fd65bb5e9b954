"""Canvas and colors of all figures."""

import warnings
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from mfvpr.utils.files import replacing, require_replaceable

PALE, MARK = "#2fa8ff", "#e8482c"
_SOFTWARE = b"mfvpr.report"  # at the start of every PNG file


def panels(number: int, width: float, height: float, columns: int = 4, **options: Any) -> tuple[Figure, list[Axes]]:
    """Make a figure of panels, each of `width` x `height` inches, in rows of at most `columns`.

    `options` go to `Figure.subplots`.
    """
    columns = min(columns, number)
    rows = -(-number // columns)
    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    FigureCanvasAgg(figure)
    axes = [*figure.subplots(rows, columns, squeeze=False, **options).flat]
    for unused in axes[number:]:
        unused.set_axis_off()
    return figure, axes[:number]


def save_figure(figure: Figure, path: Path, *, dpi: int = 110, **options: Any) -> None:
    """Write an image file; `options` go to `Figure.savefig`. Of existing files, only a PNG from here is replaced."""
    is_png = path.suffix == ".png"
    require_replaceable(path, _SOFTWARE if is_png else None)
    if is_png:
        options["metadata"] = {"Software": _SOFTWARE.decode(), **options.get("metadata", {})}
    with replacing(path) as temporary, warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing")  # names in scripts that the font lacks
        figure.savefig(temporary, dpi=dpi, **options)
