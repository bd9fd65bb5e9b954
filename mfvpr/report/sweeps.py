"""Reports of a sweep: table of all settings, summary, JSON values, and figures."""

import itertools
import json
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure as Canvas
from matplotlib.patches import Rectangle

from mfvpr import evaluation
from mfvpr.evaluation.statistics import Estimate
from mfvpr.report import runs
from mfvpr.report.plots import MARK, PALE, panels, save_figure
from mfvpr.report.runs import Figure, file_names
from mfvpr.report.tables import Table, data_frame, format_estimate, format_value, format_values
from mfvpr.tuning.sweeps.setting_search import Axes, Outcome
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import write_text
from mfvpr.utils.fingerprints import versions

if TYPE_CHECKING:
    from pandas import DataFrame

TOP = 10  # settings of the summary
MAX_HEAT_MAPS = 6
_FLAT_LENGTH = 9  # letters of a column's value that fit beside the next one's


@dataclass(frozen=True, repr=False)
class Sweep:
    """The result of `mfvpr.sweep`: recall by every setting, and the best one.

    Attributes:
        dataset: name of the data set.
        scorer: name of the scorer.
        outcome: rankings by every setting.
    """

    dataset: str
    scorer: str
    outcome: Outcome

    def __repr__(self) -> str:
        axes, recall = self.outcome.axes, f"{_label(self.outcome)} {format_estimate(self.interval)}"
        about = f"{self.dataset}, {self.scorer}: {axes.size} settings of {', '.join(axes.values)}"
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
        """Recall in % by every setting."""
        return settings_table(self.outcome)

    def to_pandas(self) -> "DataFrame":
        """A row per setting: its values, and recall as fractions; InputError if pandas is not installed."""
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

        Raises:
            InputError: the folder is neither new nor empty, nor one of a sweep.
        """
        folder = Path(folder)
        last = folder / runs.LAST
        has_sweep = (last.exists() and b'"axes"' in last.read_bytes()) or (folder / "blocks").exists()
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
    runs.write_table(folder, settings_table(outcome), heading)
    write_text(folder / "summary.txt", f"{sweep_summary(outcome, heading)}\n")
    runs.write_json(folder / "results.json", results)


def settings_table(outcome: Outcome, numbers: Iterable[int] | None = None) -> Table:
    """Recall at the first k by all thresholds, and at the other ks by the one that decides; a line for each setting.

    `numbers` choose settings; None = all.
    """
    numbers = range(len(outcome.settings)) if numbers is None else numbers
    header, recalls = _recalls(outcome, numbers)
    lines = []
    for number, recall in zip(numbers, recalls, strict=True):
        values = [format_value(outcome.settings[number][name]) for name in outcome.axes.values]
        lines.append([*values, *(f"{100 * value:.1f}" for value in recall)])
    return Table([*outcome.axes.values, *header], lines, text_columns=0)


def _recalls(outcome: Outcome, numbers: Iterable[int]) -> tuple[list[str], np.ndarray]:
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
    protocol, ks = outcome.protocol, outcome.ks
    recall = np.stack([protocol.recall(outcome.rows[0], k) for k in ks], axis=-1)  # [S, thresholds, ks]
    settings = []
    for setting, by_threshold in zip(outcome.settings, recall.round(6).tolist(), strict=True):
        recall_at = {}
        for threshold, values in zip(protocol.thresholds, by_threshold, strict=True):
            recall_at[f"{threshold:g}"] = dict(zip(map(str, ks), values, strict=True))
        settings.append({"parameters": setting, "recall_at": recall_at})
    report = [verdict._asdict() for verdict in outcome.report]
    for verdict in report:
        verdict |= {name: verdict[name]._asdict() for name in ("chosen", "own", "mcnemar", "path_test")}
    values = {
        "axes": axes_json(outcome.axes),
        "own": dict(outcome.axes.own_values),
        "search": "grid" if outcome.is_grid else "optuna",
        "unit": protocol.unit,
        "thresholds": list(protocol.thresholds),
        "ks": list(ks),
        "split": protocol.split,
        "chosen": [outcome.settings[number] for number in outcome.chosen],
        "report": report,
        "settings": settings,
    }
    return json.loads(json.dumps(values, default=str))  # weights that are no words


def sweep_summary(outcome: Outcome, heading: str) -> str:
    """The best settings below a heading, the chosen ones, and their recall on the queries to report on."""
    protocol, defaults = outcome.protocol, outcome.own
    best = np.argsort(-outcome.recall[:, protocol.main], kind="stable")[:TOP].tolist()
    note = "" if defaults in best else "; last: the scorer's own values"
    shown = list(dict.fromkeys([*best, defaults]))
    parts = [
        f"{heading}\n",
        f"Best settings by {protocol.label(1, protocol.thresholds[protocol.main])}, all queries{note}.",
        settings_table(outcome, shown).text(),
    ]
    if outcome.is_grid and not protocol.halves and len(shown) < len(outcome.settings):
        around = evaluation.neighboring_settings(outcome.axes.values, outcome.chosen[0])
        table = settings_table(outcome, [outcome.chosen[0], *around])
        parts += ["The best, and its neighbors in the grid:", table.text()] if around else []
    for name, half, number in zip(protocol.names, protocol.halves, outcome.chosen, strict=False):
        sizes = f"chosen on {len(half.tune)} queries of {name}, reported on the {len(half.report)} of the other half"
        parts.append(f"{sizes}: {format_values(outcome.settings[number])}")
    if not protocol.halves:
        parts.append(f"chosen: {format_values(outcome.settings[outcome.chosen[0]])}")
    parts.append("Recall at 1 in %, with 95 % intervals in brackets:")
    for threshold, _, chosen, own, test, path in outcome.report:
        recalls = f"chosen {format_estimate(chosen)}, own values {format_estimate(own)}"
        counts = f"only one of them correct: {test.only_first} and {test.only_second} queries"
        probabilities = f"McNemar p = {test.p_value:.2g}, along the path p = {path.p_value:.2g}"
        parts.append(f"{protocol.label(1, threshold)}: {recalls}; {counts}, {probabilities}")
    if not protocol.halves:
        parts.append(
            "Chosen and reported on the same queries, so this flatters; split=both chooses on one half of the path "
            "and reports on the other."
        )
    return "\n".join(parts)


def sweep_figures(outcome: Outcome) -> list[Figure]:
    """Heat maps of every pair of axes with several values; of a search that tried no complete grid, all trials."""
    names = [name for name, axis in outcome.axes.values.items() if len(axis) > 1]
    if not outcome.is_grid:
        return [("trials.png", partial(_draw_trials, outcome=outcome, names=names))]
    pairs = list(itertools.combinations(names, 2)) or [("", name) for name in names]
    files = file_names([" + ".join(filter(None, pair)) for pair in pairs])
    figures = []
    for (first, second), file in zip(pairs[:MAX_HEAT_MAPS], files.values(), strict=False):
        figures.append((f"{file}.png", lambda path, pair=(first, second): save_figure(_heat_map(outcome, *pair), path)))
    return figures


def _draw_trials(path: Path, outcome: Outcome, names: Sequence[str]) -> None:
    """Draw recall over the trials, with the best so far, and over the values of each parameter."""
    figure, [first, *axes] = panels(1 + len(names), 3.4, 2.6, sharey=True)
    percent = 100 * outcome.recall[:, outcome.protocol.main]
    first.plot(np.maximum.accumulate(percent), color=MARK, label="best so far")
    first.plot(percent, ".", color=PALE)
    first.set_xlabel("trial; 0 = the scorer's own values", fontsize=8)
    first.set_ylabel(_label(outcome), fontsize=8)
    first.legend(fontsize=7)
    for panel, name in zip(axes, names, strict=True):
        values = [setting[name] for setting in outcome.settings]
        is_number = all(isinstance(value, int | float) and not isinstance(value, bool) for value in values)
        places = values if is_number else list(map(str, values))
        panel.scatter(places, percent, s=12, c=np.arange(len(percent)), cmap="viridis")  # later trials are brighter
        panel.plot(places[int(np.argmax(percent))], percent.max(), "s", fillstyle="none", color=MARK, markersize=9)
        panel.set_xlabel(name, fontsize=8)
    save_figure(figure, path)


def _heat_map(outcome: Outcome, first: str, second: str) -> Canvas:
    """Heat map of recall over two axes (the first may be ""), the others at the best setting (of all queries).

    The best setting is framed; a circle marks the scorer's own values, if the grid has them.
    """
    axes, protocol = outcome.axes, outcome.protocol
    values = {"": [""]} | {name: list(map(format_value, axis)) for name, axis in axes.values.items()}
    recall = 100 * outcome.recall[: axes.size, protocol.main].reshape(*map(len, values.values()))
    flat_best = evaluation.best_setting(recall.reshape(-1), axes.values)
    best = dict(zip(values, map(int, np.unravel_index(flat_best, recall.shape)), strict=True))
    plane = recall[tuple(slice(None) if name in (first, second) else best[name] for name in values)]
    plane = plane.T if list(values).index(first) > list(values).index(second) else plane
    words = []
    for name in (first, second):
        stems = [Path(value).stem if value.endswith(".json") else value for value in values[name]]
        words.append(stems if len({*stems}) == len(stems) else values[name])  # of files, if these differ
    figure, [panel] = panels(1, 1.8 + 0.75 * len(words[1]), 1.9 + 0.5 * len(words[0]))
    top, spread = plane.max(), max(float(plane.max() - plane.min()), 1.0)
    image = panel.imshow(plane, cmap="viridis", aspect="auto", vmin=top - spread, vmax=top)
    for (row, column), value in np.ndenumerate(plane):
        color = "white" if value < top - 0.45 * spread else "black"
        panel.text(column, row, f"{value:.1f}", ha="center", va="center", fontsize=9, color=color)
    panel.set_yticks(range(len(words[0])), words[0])
    panel.set_xticks(range(len(words[1])), words[1])
    panel.set(xlabel=second, ylabel=first)
    if any(len(word) > _FLAT_LENGTH for word in words[1]):
        panel.tick_params("x", rotation=30)
    corner = best[second] - 0.5, best[first] - 0.5
    panel.add_patch(Rectangle(corner, 1, 1, linewidth=2.5, fill=False, edgecolor=MARK))
    defaults = {"": ""} | {name: format_value(value) for name, value in axes.own_values.items()}
    if defaults[first] in values[first] and defaults[second] in values[second]:
        place = values[second].index(defaults[second]), values[first].index(defaults[first])
        panel.plot(*place, marker="o", markersize=30, markerfacecolor="none", markeredgecolor=MARK)
    fixed = [f"{name} = {values[name][place]}" for name, place in best.items() if name not in ("", first, second)]
    panel.set_title("; ".join([_label(outcome), *fixed]), fontsize=9, parse_math=False)
    figure.colorbar(image, ax=panel, label="%")
    return figure


def _label(outcome: Outcome) -> str:
    return f"{outcome.protocol.label(1, outcome.protocol.thresholds[outcome.protocol.main])} in %"
