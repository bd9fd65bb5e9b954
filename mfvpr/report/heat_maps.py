"""Recall over two parameters of a sweep, the best and the scorer's own values marked."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from mfvpr.utils.files import replacing

_MARK = "#e8482c"
_FLAT = 9  # letters of a column's value that fit beside the next one's


def heat_map_figure(
    path: Path,
    recall: np.ndarray,
    rows: tuple[str, Sequence[str]],
    columns: tuple[str, Sequence[str]],
    *,
    best: tuple[int, int],
    own: tuple[int, int] | None,
    title: str,
) -> None:
    """Write the figure of one pair of axes.

    Args:
        path: image file to write.
        recall: `[R, C]` fractions.
        rows: name and values of the first parameter.
        columns: name and values of the second.
        best: row and column of the best setting, framed.
        own: of the scorer's own values, where the grid has them, marked with a circle.
        title: above everything.
    """
    figure = Figure(figsize=(1.8 + 0.75 * len(columns[1]), 1.9 + 0.5 * len(rows[1])), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    percent = 100 * recall
    spread = max(float(percent.max() - percent.min()), 1.0)
    image = axes.imshow(percent, cmap="viridis", aspect="auto", vmin=percent.max() - spread, vmax=percent.max())
    for (row, column), value in np.ndenumerate(percent):
        dark = value < percent.max() - 0.45 * spread
        axes.text(column, row, f"{value:.1f}", ha="center", va="center", fontsize=9, color="white" if dark else "black")
    for (name, values), set_ticks, set_label in (
        (rows, axes.set_yticks, axes.set_ylabel),
        (columns, axes.set_xticks, axes.set_xlabel),
    ):
        set_ticks(range(len(values)), values)
        set_label(name)
    if any(len(value) > _FLAT for value in columns[1]):
        axes.tick_params("x", rotation=30)
    axes.add_patch(Rectangle((best[1] - 0.5, best[0] - 0.5), 1, 1, linewidth=2.5, fill=False, edgecolor=_MARK))
    if own is not None:
        axes.plot(own[1], own[0], marker="o", markersize=30, markerfacecolor="none", markeredgecolor=_MARK)
    axes.set_title(title, fontsize=9, parse_math=False)
    figure.colorbar(image, ax=axes, label="%")
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=110)
