"""Figures of numbers: calibration, sweeps, trainings; canvas and colors of all figures."""

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from mfvpr.evaluation.confidence import Reliability
from mfvpr.utils.files import clip_middle, printable, replacing, require_replaceable

BINS = 12  # of the matches, by the value of an input
COLORS = ("#0b84c6", "#e1701a", "#1a9e6f", "#c9559d", "#9a7bd0", "#b58900", "#d1495b", "#5f9ea0")  # on dark and light
_FIRST = "#8a8f98"  # of what all others are compared with
_DASHES = ("solid", "dash", "dot", "dashdot")  # told apart without colors, too
_TITLE_LENGTH = 34  # characters that fit above a panel
_LOSS, _MARK, _SHARE = "#2fa8ff", "#e8482c", "#888888"
_SOFTWARE = b"mfvpr.report"  # at the start of every PNG file
_FLAT_LENGTH = 9  # letters of a column's value that fit beside the next one's


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


def color_and_dash(place: int) -> tuple[str, str]:
    """Color and plotly's name of the dash of the system at a place of the table."""
    if place == 0:
        return _FIRST, "solid"
    return COLORS[(place - 1) % len(COLORS)], _DASHES[(place - 1) // len(COLORS) % len(_DASHES)]


def reliability_figure(path: Path, reliabilities: Mapping[str, Reliability]) -> None:
    """Draw a panel for each system: how often predictions of a probability are correct, areas by their number."""
    figure, axes = panels(len(reliabilities), 2.6, 2.6)
    for place, (panel, (name, bins)) in enumerate(zip(axes, reliabilities.items(), strict=True)):
        panel.plot([0, 1], [0, 1], color="gray", linewidth=0.8)
        sizes = 200 * bins.count / max(bins.count.sum(), 1) + 4
        panel.scatter(bins.probability, bins.correct, s=sizes, alpha=0.8, color=color_and_dash(place)[0])
        title = f"{clip_middle(printable(name), _TITLE_LENGTH)}\nECE {100 * bins.calibration_error:.1f} %"
        panel.set_title(title, fontsize=8, parse_math=False)
        panel.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))
        panel.set_xlabel("confidence", fontsize=8)
        panel.set_ylabel("correct", fontsize=8)
        panel.grid(alpha=0.3)
    save_figure(figure, path, bbox_inches="tight")  # titles may be wider than their panel


def heat_map_figure(
    recall: Float[np.ndarray, "rows columns"],
    rows: tuple[str, Sequence[str]],
    columns: tuple[str, Sequence[str]],
    *,
    best: tuple[int, int],
    defaults: tuple[int, int] | None,
    title: str,
) -> Figure:
    """Recall (fractions) over two parameters of a sweep; `rows` and `columns` are name and values.

    `best` is the row and column of the best setting, framed; `defaults` those of the scorer's own values, marked with a
    circle (None = the grid lacks them).
    """
    figure, [axes] = panels(1, 1.8 + 0.75 * len(columns[1]), 1.9 + 0.5 * len(rows[1]))
    percent = 100 * recall
    spread = max(float(percent.max() - percent.min()), 1.0)
    image = axes.imshow(percent, cmap="viridis", aspect="auto", vmin=percent.max() - spread, vmax=percent.max())
    for (row, column), value in np.ndenumerate(percent):
        dark = value < percent.max() - 0.45 * spread
        axes.text(column, row, f"{value:.1f}", ha="center", va="center", fontsize=9, color="white" if dark else "black")
    axes.set_yticks(range(len(rows[1])), rows[1])
    axes.set_xticks(range(len(columns[1])), columns[1])
    axes.set(xlabel=columns[0], ylabel=rows[0])
    if any(len(value) > _FLAT_LENGTH for value in columns[1]):
        axes.tick_params("x", rotation=30)
    axes.add_patch(Rectangle((best[1] - 0.5, best[0] - 0.5), 1, 1, linewidth=2.5, fill=False, edgecolor=_MARK))
    if defaults is not None:
        axes.plot(defaults[1], defaults[0], marker="o", markersize=30, markerfacecolor="none", markeredgecolor=_MARK)
    axes.set_title(title, fontsize=9, parse_math=False)
    figure.colorbar(image, ax=axes, label="%")
    return figure


def trials_figure(
    path: Path, recall: Float[np.ndarray, " trials"], values: Mapping[str, Sequence[Any]], label: str
) -> None:
    """Draw recall (fractions) over the trials, with the best so far, and over the values of each parameter."""
    figure, [first, *axes] = panels(1 + len(values), 3.4, 2.6, sharey=True)
    percent = 100 * recall
    first.plot(np.maximum.accumulate(percent), color=_MARK, label="best so far")
    first.plot(percent, ".", color=_LOSS)
    first.set_xlabel("trial; 0 = the scorer's own values", fontsize=8)
    first.set_ylabel(label, fontsize=8)
    first.legend(fontsize=7)
    for panel, (name, of_trials) in zip(axes, values.items(), strict=True):
        is_number = all(isinstance(value, int | float) and not isinstance(value, bool) for value in of_trials)
        places = of_trials if is_number else list(map(str, of_trials))
        panel.scatter(places, percent, s=12, c=np.arange(len(percent)), cmap="viridis")  # later trials are brighter
        panel.plot(places[int(np.argmax(percent))], percent.max(), "s", fillstyle="none", color=_MARK, markersize=9)
        panel.set_xlabel(name, fontsize=8)
    save_figure(figure, path)


def curves_figure(path: Path, histories: Mapping[str, Sequence[tuple[int, float | None, float | None]]]) -> None:
    """Draw loss and validation over the steps, one panel for each training.

    `histories` are rows (step, mean loss since the row before, validation) by training, None where there is no value.
    """
    figure, axes = panels(len(histories), 3.4, 2.6)
    for panel, (name, history) in zip(axes, histories.items(), strict=True):
        for place, label, color in ((1, "loss", _LOSS), (2, "validation", _MARK)):
            points = [(row[0], row[place]) for row in history if row[place] is not None]
            panel.plot(*zip(*points, strict=True), label=label, color=color, marker=".", markersize=4)
        panel.set_title(name, fontsize=9)
        panel.set_xlabel("step", fontsize=8)
        panel.grid(alpha=0.3)
    axes[0].legend(fontsize=8)
    save_figure(figure, path)


def weights_figure(
    path: Path,
    names: Sequence[str],
    inputs: Float[np.ndarray, "matches inputs"],
    weights: Mapping[str, Float[np.ndarray, " matches"]],
    correct: Bool[np.ndarray, " matches"],
) -> None:
    """Draw the mean match weight over each input, and the share of matches that belong to a correct candidate.

    `inputs` are of real matches, in their own units; each bin holds as many matches. `weights` are by training.
    `correct` says whether a match belongs to a correct candidate.
    """
    figure, axes = panels(len(names), 3.2, 2.6)
    for panel, name, values in zip(axes, names, inputs.T, strict=True):
        edges = np.unique(np.quantile(values, np.linspace(0, 1, BINS + 1)))
        bin_of = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, max(len(edges) - 2, 0))
        members = [bin_of == used for used in np.unique(bin_of)]
        centers = [values[member].mean() for member in members]
        for label, weight in weights.items():
            panel.plot(centers, [weight[member].mean() / weight.mean() for member in members], label=label, marker=".")
        panel.set_title(name, fontsize=9)
        panel.grid(alpha=0.3)
        share = panel.twinx()
        share.plot(centers, [100 * correct[member].mean() for member in members], color=_SHARE, linestyle=":")
        share.tick_params(labelsize=7, labelcolor=_SHARE)
    axes[0].legend(fontsize=7)
    axes[0].set_ylabel("weight / mean weight", fontsize=8)
    figure.suptitle("dotted: % of these matches that belong to a correct candidate", fontsize=9)
    save_figure(figure, path)
