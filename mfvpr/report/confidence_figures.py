"""Precision against recall, whether p means what it says, and recall against the share of queries re-ranked."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from mfvpr.evaluation.precision import PrecisionRecall, Reliability
from mfvpr.report.colors import color_and_dash
from mfvpr.utils.files import clipped, printable, replacing

_LINE_STYLES = {
    "solid": "solid",
    "dash": "dashed",
    "dot": "dotted",
    "dashdot": "dashdot",
}  # by plotly's words
_MOST_OF_A_NAME = 34  # characters that fit above a panel


def precision_recall_figure(path: Path, curves: Mapping[str, Mapping[str, PrecisionRecall]]) -> None:
    """A panel for what answers are held by (the score, p), in it a curve for each system.

    Args:
        path: image file to write.
        curves: by system, and what its answers are held by.
    """
    kinds = list(dict.fromkeys(kind for by in curves.values() for kind in by))
    figure, panels = _panels(len(kinds), width=5.0)
    for panel, kind in zip(panels, kinds, strict=False):
        for place, (name, by) in enumerate(curves.items()):
            if kind in by:
                curve = by[kind]
                label = f"{_short(name)}: AP {100 * curve.average_precision:.1f}"
                panel.plot(curve.recall, curve.precision, label=label, **_line(place))
        panel.set_title(f"by {kind}", fontsize=9)
        _label(panel, "recall of the queries that have an answer", "precision of the answers")
        panel.legend(fontsize=7, loc="lower left")
    save_figure(figure, path)


def reliability_figure(path: Path, reliabilities: Mapping[str, Reliability]) -> None:
    """A panel for each system: how often answers of a probability are right, the areas by how many there are.

    Args:
        path: image file to write.
        reliabilities: by system.
    """
    figure, panels = _panels(len(reliabilities), width=2.6)
    for place, (panel, (name, found)) in enumerate(zip(panels, reliabilities.items(), strict=False)):
        panel.plot([0, 1], [0, 1], color="gray", linewidth=0.8)
        sizes = 200 * found.count / max(found.count.sum(), 1) + 4
        panel.scatter(found.probability, found.right, s=sizes, alpha=0.8, color=color_and_dash(place)[0])
        panel.set_title(f"{_short(name)}\nECE {100 * found.calibration_error:.1f} %", fontsize=8, parse_math=False)
        _label(panel, "p(right)", "right")
    save_figure(figure, path)


def shares_figure(path: Path, shares: Sequence[float], recall: Mapping[str, np.ndarray]) -> None:
    """Recall at 1 against the share of queries that are re-ranked, those first that the filter is the least sure of.

    Args:
        path: image file to write.
        shares: of all queries.
        recall: `[shares]` by system, all but the filter.
    """
    figure, [panel] = _panels(1, width=5.0)
    for place, (name, values) in enumerate(recall.items(), start=1):
        panel.plot(shares, values, label=_short(name), **_line(place))
    _label(panel, "share of queries re-ranked", "recall at 1")
    panel.legend(fontsize=7)
    save_figure(figure, path)


def _line(place: int) -> dict[str, Any]:
    color, dash = color_and_dash(place)
    return {"color": color, "linestyle": _LINE_STYLES[dash], "linewidth": 1.2}


def _short(name: str) -> str:
    return clipped(printable(name), _MOST_OF_A_NAME)


def _panels(number: int, *, width: float) -> tuple[Figure, list[Axes]]:
    columns = min(4, number)
    rows = -(-number // columns)
    figure = Figure(figsize=(width * columns, width * rows), layout="constrained")
    FigureCanvasAgg(figure)
    panels = [*figure.subplots(rows, columns, squeeze=False).reshape(-1)]
    for panel in panels[number:]:
        panel.set_axis_off()
    return figure, panels[:number]


def _label(panel: Axes, x: str, y: str) -> None:
    panel.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))
    panel.set_xlabel(x, fontsize=8)
    panel.set_ylabel(y, fontsize=8)
    panel.grid(alpha=0.3)


def save_figure(figure: Figure, path: Path) -> None:
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=110, bbox_inches="tight")  # titles may be wider than their panel
