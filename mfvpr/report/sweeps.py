"""Reports of a sweep: table of all settings, summary, JSON values, and figures."""

import itertools
import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure as Canvas
from matplotlib.patches import Rectangle

from mfvpr import evaluation
from mfvpr.evaluation.statistics import Estimate
from mfvpr.report import runs
from mfvpr.report.plots import MARK, panels, save_figure
from mfvpr.report.runs import Figure, file_names
from mfvpr.report.tables import Table, data_frame, format_estimate, format_value, format_values
from mfvpr.tuning.sweeps import Axes, Outcome
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import write_text
from mfvpr.utils.fingerprints import versions

if TYPE_CHECKING:
    from pandas import DataFrame

_TOP = 10  # settings of the summary
_MAX_HEAT_MAPS = 6


@dataclass(frozen=True, repr=False)
class Sweep:
    """The result of `mfvpr.sweep`: recall by every setting, and the best one.

    It has the names of the data set and of the scorer; `outcome` are the rankings by every setting.
    """

    dataset: str
    scorer: str
    outcome: Outcome

    def __repr__(self) -> str:
        recall = f"{_label(self.outcome)} in % {format_estimate(self.interval)}"
        about = f"{self.dataset}, {self.scorer}: {self.outcome.axes.size} settings"
        return f"Sweep({about}; best {format_values(self.best)}; {recall})"

    @property
    def best(self) -> dict[str, Any]:
        """The setting with the highest recall@1 on the queries to choose on, plain values by axis.

        With `split="both"`, all queries choose it: it is the setting to use from now on. `chosen` has the settings that
        each half chose.
        """
        return dict(self.outcome.settings[self.outcome.best])

    @property
    def chosen(self) -> dict[str, dict[str, Any]]:
        """The best setting by name of the half that chose it; "all" without a split."""
        names = self.outcome.protocol.names or ["all"]
        return {name: dict(self.outcome.settings[row]) for name, row in zip(names, self.outcome.chosen, strict=True)}

    @property
    def interval(self) -> Estimate:
        """Recall@1 of `chosen` at the middle threshold, with its 95 % interval.

        With a split, each setting counts on the half that did not choose it. Without one, the queries that chose the
        setting count, which flatters it.
        """
        return self.outcome.report[self.outcome.protocol.main].chosen

    def table(self) -> Table:
        """Recall in % by every setting: at the first k by all thresholds, at other ks by the one that decides."""
        return _table(self.outcome, range(len(self.outcome.settings)))

    def to_pandas(self) -> "DataFrame":
        """A row per setting: its values, and recall as fractions; needs pandas."""
        header, recalls = _recalls(self.outcome, range(len(self.outcome.settings)))
        rows = zip(self.outcome.settings, recalls.tolist(), strict=True)
        return data_frame([{**setting, **dict(zip(header, recall, strict=True))} for setting, recall in rows])

    def plot(self, *names: str) -> Canvas:
        """A heat map of recall@1 over one or two axes, the other axes at the best setting: `plot("sigma", "weight")`.

        The square is the best setting, the circle the scorer's own values; `figure.savefig(path)` writes it.
        """
        axes = self.outcome.axes.values
        if not 1 <= len(names) <= 2 or not {*names} <= {*axes}:
            raise InputError(f"plot: expected one or two axes of {', '.join(axes)}, got {', '.join(names) or 'none'}")
        return _heat_map(self.outcome, *("", *names)[-2:])

    def save(self, folder: Path | str) -> None:
        """Write table, summary, figures and results.json, each file whole; those of an earlier sweep are replaced.

        InputError if the folder is neither new nor empty, nor one of a sweep.
        """
        folder, last = Path(folder), Path(folder) / runs.LAST
        has_sweep = (last.exists() and b'"axes"' in last.read_bytes()) or (folder / "rankings").exists()
        if folder.exists() and not has_sweep and (folder.is_file() or any(folder.iterdir())):
            raise InputError(f"{folder}: expected a new or empty folder, or one of a sweep; name another")
        shutil.rmtree(folder / "figures", ignore_errors=True)
        for name, draw in sweep_figures(self.outcome):
            draw(folder / "figures" / name)
        sizes = f"{len(self.outcome.protocol.places)} queries, {len(self.outcome.settings)} settings"
        heading = f"{self.dataset}: {sizes} of {self.scorer}"
        about = {"dataset": self.dataset, "scorer": {"method": self.scorer}, "versions": versions()}
        write_sweep(folder, self.outcome, heading, about | sweep_json(self.outcome))


def write_sweep(folder: Path, outcome: Outcome, heading: str, results: Mapping[str, Any]) -> None:
    """Write table, summary.txt and results.json of a sweep."""
    runs.write_table(folder, _table(outcome, range(len(outcome.settings))), heading)
    write_text(folder / "summary.txt", f"{sweep_summary(outcome, heading)}\n")
    runs.write_json(folder / runs.LAST, results)


def _table(outcome: Outcome, numbers: Sequence[int]) -> Table:
    """A line for each of these settings."""
    header, recalls = _recalls(outcome, numbers)
    lines = []
    for number, recall in zip(numbers, recalls, strict=True):
        values = [format_value(outcome.settings[number][name]) for name in outcome.axes.values]
        lines.append([*values, *(f"{100 * value:.1f}" for value in recall)])
    return Table([*outcome.axes.values, *header], lines, text_columns=0)


def _recalls(outcome: Outcome, numbers: Sequence[int]) -> tuple[list[str], np.ndarray]:
    """Labels and values `[settings, labels]` of the recalls of a table."""
    protocol, (first, *deeper) = outcome.protocol, outcome.ks
    header = [protocol.label(first, threshold) for threshold in protocol.thresholds]
    header += [protocol.label(k, protocol.thresholds[protocol.main]) for k in deeper]
    rows = outcome.rows[0][list(numbers)]
    deeper_recalls = (protocol.recall(rows, k)[:, protocol.main] for k in deeper)
    return header, np.column_stack([protocol.recall(rows, first), *deeper_recalls])


def axes_json(axes: Axes) -> dict[str, Any]:
    """The values of the axes as JSON values; weights that are no words as texts."""
    return json.loads(json.dumps(dict(axes.values), default=str))


def sweep_json(outcome: Outcome) -> dict[str, Any]:
    """The sweep as JSON values."""
    protocol, settings, report = outcome.protocol, [], []
    recall = np.stack([protocol.recall(outcome.rows[0], k) for k in outcome.ks], axis=-1)  # [S, thresholds, ks]
    for setting, by_threshold in zip(outcome.settings, recall.round(6).tolist(), strict=True):
        by_k = [dict(zip(map(str, outcome.ks), values, strict=True)) for values in by_threshold]
        recall_at = dict(zip([f"{threshold:g}" for threshold in protocol.thresholds], by_k, strict=True))
        settings.append({"parameters": setting, "recall_at": recall_at})
    for verdict in outcome.report:
        parts = {name: getattr(verdict, name)._asdict() for name in ("chosen", "own", "mcnemar", "path_test")}
        report.append(verdict._asdict() | parts)
    values = {
        "axes": axes_json(outcome.axes),
        "own": dict(outcome.axes.own_values),
        "search": "grid" if outcome.is_grid else "optuna",
        "unit": protocol.unit,
        "thresholds": list(protocol.thresholds),
        "ks": list(outcome.ks),
        "split": protocol.split,
        "chosen": [outcome.settings[number] for number in outcome.chosen],
        "report": report,
        "settings": settings,
    }
    return json.loads(json.dumps(values, default=str))  # weights that are no words


def sweep_summary(outcome: Outcome, heading: str) -> str:
    """The best settings below a heading, the chosen ones, and their recall on the queries to report on."""
    protocol = outcome.protocol
    best = np.argsort(-outcome.recall[:, protocol.main], kind="stable")[:_TOP].tolist()
    shown = list(dict.fromkeys([*best, outcome.own]))
    note = "; last: the scorer's own values" if len(shown) > len(best) else ""
    parts = [f"{heading}\n", f"Best settings by {_label(outcome)}, all queries{note}.", _table(outcome, shown).text()]
    for name, half, number in zip(protocol.names, protocol.halves, outcome.chosen, strict=False):
        sizes = f"chosen on {len(half.tune)} queries of {name}, reported on the {len(half.report)} of the other half"
        parts.append(f"{sizes}: {format_values(outcome.settings[number])}")
    if not protocol.halves:
        parts.append(f"chosen: {format_values(outcome.settings[outcome.chosen[0]])}")
        parts.append("chosen and reported on the same queries, so this flatters; split=both does not")
    parts.append("Recall at 1 in %, with 95 % intervals in brackets:")
    for threshold, _, chosen, own, test, path in outcome.report:
        recalls = f"chosen {format_estimate(chosen)}, own values {format_estimate(own)}"
        counts = f"only one of them correct: {test.only_first} and {test.only_second} queries"
        probabilities = f"McNemar p = {test.p_value:.2g}, along the path p = {path.p_value:.2g}"
        parts.append(f"{protocol.label(1, threshold)}: {recalls}; {counts}, {probabilities}")
    return "\n".join(parts)


def sweep_figures(outcome: Outcome) -> list[Figure]:
    """Heat maps of every pair of axes with several values; none of a search that tried no complete grid."""
    if not outcome.is_grid:
        return []
    names = [name for name, axis in outcome.axes.values.items() if len(axis) > 1]
    pairs = list(itertools.combinations(names, 2)) or [("", name) for name in names]
    files = file_names([" + ".join(filter(None, pair)) for pair in pairs]).values()
    figures = []
    for pair, file in zip(pairs[:_MAX_HEAT_MAPS], files, strict=False):
        figures.append((f"{file}.png", lambda path, pair=pair: save_figure(_heat_map(outcome, *pair), path)))
    return figures


def _heat_map(outcome: Outcome, first: str, second: str) -> Canvas:
    """Heat map of recall over two axes (the first may be ""), the others at the best setting (of all queries).

    The best setting is framed; a circle marks the scorer's own values, if the grid has them.
    """
    axes, protocol = outcome.axes, outcome.protocol
    words = {"": [""]} | {name: list(map(format_value, axis)) for name, axis in axes.values.items()}
    recall = 100 * outcome.recall[: axes.size, protocol.main].reshape(*map(len, words.values()))
    flat_best = evaluation.best_setting(recall.reshape(-1), axes.values)
    best = dict(zip(words, map(int, np.unravel_index(flat_best, recall.shape)), strict=True))
    plane = recall[tuple(slice(None) if name in (first, second) else best[name] for name in words)]
    plane = plane.T if list(words).index(first) > list(words).index(second) else plane
    figure, [panel] = panels(1, 1.8 + 0.75 * len(words[second]), 1.9 + 0.5 * len(words[first]))
    top, spread = plane.max(), max(float(plane.max() - plane.min()), 1.0)
    image = panel.imshow(plane, cmap="viridis", aspect="auto", vmin=top - spread, vmax=top)
    for (row, column), value in np.ndenumerate(plane):
        color = "white" if value < top - 0.45 * spread else "black"
        panel.text(column, row, f"{value:.1f}", ha="center", va="center", fontsize=9, color=color)
    panel.set_yticks(range(len(words[first])), [Path(word).name for word in words[first]])  # weights may be files
    panel.set_xticks(range(len(words[second])), [Path(word).name for word in words[second]], rotation=30)
    panel.set(xlabel=second, ylabel=first)
    corner = best[second] - 0.5, best[first] - 0.5
    panel.add_patch(Rectangle(corner, 1, 1, linewidth=2.5, fill=False, edgecolor=MARK))
    own = {"": ""} | {name: format_value(value) for name, value in axes.own_values.items()}
    if own[first] in words[first] and own[second] in words[second]:
        place = words[second].index(own[second]), words[first].index(own[first])
        panel.plot(*place, marker="o", markersize=30, markerfacecolor="none", markeredgecolor=MARK)
    fixed = [f"{name} = {words[name][place]}" for name, place in best.items() if name not in ("", first, second)]
    panel.set_title("; ".join([f"{_label(outcome)} in %", *fixed]), fontsize=9, parse_math=False)
    figure.colorbar(image, ax=panel, label="%")
    return figure


def _label(outcome: Outcome) -> str:
    return outcome.protocol.label(1, outcome.protocol.thresholds[outcome.protocol.main])
