"""How a training went, and what learned match weights look at."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from mfvpr.utils.files import replacing

BINS = 12


def curves_figure(path: Path, histories: Mapping[str, Sequence[tuple[int, float | None, float | None]]]) -> None:
    """Loss and validation over the steps of several trainings, one panel each.

    Args:
        path: image file to write.
        histories: by training, (step, mean loss since the last one, validation); None where there is none.
    """
    columns = min(4, len(histories))
    lines = -(-len(histories) // columns)
    figure = Figure(figsize=(3.4 * columns, 2.6 * lines), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(lines, columns, squeeze=False).reshape(-1)
    for panel, (name, history) in zip(panels, histories.items(), strict=False):
        for place, label, color in ((1, "loss", "#2fa8ff"), (2, "validation", "#e8482c")):
            points = [(row[0], row[place]) for row in history if row[place] is not None]
            panel.plot(*zip(*points, strict=True), label=label, color=color, marker=".", markersize=4)
        panel.set_title(name, fontsize=9)
        panel.set_xlabel("step", fontsize=8)
        panel.grid(alpha=0.3)
    panels[0].legend(fontsize=8)
    for panel in panels[len(histories) :]:
        panel.set_axis_off()
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=110)


def weights_figure(
    path: Path, names: Sequence[str], inputs: np.ndarray, weights: Mapping[str, np.ndarray], right: np.ndarray
) -> None:
    """Mean match weight over each input, in bins of as many matches each, beside how many of them are right.

    Args:
        path: image file to write.
        names: of F inputs.
        inputs: `[n, F]` of real matches, in their own units.
        weights: `[n]` by training.
        right: `[n]` bool, whether a match belongs to a right candidate.
    """
    columns = min(4, len(names))
    lines = -(-len(names) // columns)
    figure = Figure(figsize=(3.2 * columns, 2.6 * lines), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(lines, columns, squeeze=False).reshape(-1)
    for panel, name, values in zip(panels, names, inputs.T, strict=False):
        edges = np.unique(np.quantile(values, np.linspace(0, 1, BINS + 1)))
        member = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, max(len(edges) - 2, 0))
        used = np.unique(member)
        centers = [values[member == one].mean() for one in used]
        for label, weight in weights.items():
            panel.plot(centers, [weight[member == one].mean() / weight.mean() for one in used], label=label, marker=".")
        panel.set_title(name, fontsize=9)
        panel.grid(alpha=0.3)
        share = panel.twinx()
        share.plot(centers, [100 * right[member == one].mean() for one in used], color="#888888", linestyle=":")
        share.tick_params(labelsize=7, labelcolor="#888888")
    panels[0].legend(fontsize=7)
    panels[0].set_ylabel("weight / mean weight", fontsize=8)
    figure.suptitle("dotted: % of these matches that belong to a right candidate", fontsize=9)
    for panel in panels[len(names) :]:
        panel.set_axis_off()
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=110)
