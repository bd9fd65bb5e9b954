"""Reports of sweeps and of learning: tables, summaries, JSON values, learned weights, and figures."""

import itertools
import json
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure as Canvas
from matplotlib.patches import Rectangle

from mfvpr import evaluation
from mfvpr.baselines.learned_weight import write_weight
from mfvpr.datasets.ground_truth import threshold_words
from mfvpr.evaluation.statistics import Estimate, mcnemar, path_test, recall_interval
from mfvpr.report import runs
from mfvpr.report.figures import panels, save_figure
from mfvpr.report.runs import Figure, Table, format_estimate, format_interval, format_value, format_values
from mfvpr.tuning.sweeps import Outcome
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import write_text
from mfvpr.utils.fingerprints import versions

if TYPE_CHECKING:
    from pandas import DataFrame

    from mfvpr.tuning.learning.models import Comparison  # with Optax, which sweeps do not wait for
    from mfvpr.tuning.learning.training import Fit

_PALE, _MARK = "#2fa8ff", "#e8482c"
_TOP = 10  # settings of the summary
_MAX_HEAT_MAPS = 6


@dataclass(frozen=True, repr=False)
class Sweep:
    """The result of `mfvpr.sweep`: recall by every setting, and the best one."""

    dataset: str  # its name
    scorer: str  # its name
    outcome: Outcome  # rankings by every setting

    def __repr__(self) -> str:
        recall = f"{_label(self.outcome)} in % {format_estimate(self.interval)}"
        about = f"{self.dataset}, {self.scorer}: {self.outcome.axes.size} settings"
        return f"Sweep({about}; best {format_values(self.best)}; {recall})"

    @property
    def best(self) -> dict[str, Any]:
        """The setting with the highest recall@1 on the queries to choose on, plain values by axis.

        With `split="both"`, all queries choose it: it is the setting to use from now on.
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
        return _sweep_table(self.outcome)

    def to_pandas(self) -> "DataFrame":
        """A row per setting: its values, and recall as fractions; needs pandas."""
        header, recalls = _recalls(self.outcome)
        rows = zip(self.outcome.settings, recalls.tolist(), strict=True)
        return runs.data_frame([{**setting, **dict(zip(header, recall, strict=True))} for setting, recall in rows])

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
        write_sweep(folder, self.outcome, heading, about)


def write_sweep(folder: Path, outcome: Outcome, heading: str, about: Mapping[str, Any]) -> None:
    """Write table, summary.txt and results.json of a sweep; the latter begins with the values `about` it."""
    protocol, settings, report = outcome.protocol, [], []
    recall = np.stack([protocol.recall(outcome.rows[0], k) for k in outcome.ks], axis=-1)  # [S, thresholds, ks]
    for setting, by_threshold in zip(outcome.settings, recall.round(6).tolist(), strict=True):
        by_k = [dict(zip(map(str, outcome.ks), values, strict=True)) for values in by_threshold]
        recall_at = dict(zip([f"{threshold:g}" for threshold in protocol.thresholds], by_k, strict=True))
        settings.append({"parameters": setting, "recall_at": recall_at})
    for verdict in outcome.report:
        parts = {name: getattr(verdict, name)._asdict() for name in ("chosen", "own", "mcnemar", "path_test")}
        report.append(verdict._asdict() | parts)
    results = {
        **about,
        "axes": dict(outcome.axes.values),
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
    runs.write_table(folder, _sweep_table(outcome), heading)
    write_text(folder / "summary.txt", f"{sweep_summary(outcome, heading)}\n")
    runs.write_json(folder / runs.LAST, as_json(results))


def as_json(values: Mapping[str, Any]) -> dict[str, Any]:
    """Values, such as those of axes, as they are read from JSON; match weights that are no words are texts."""
    return json.loads(json.dumps(dict(values), default=str))


def sweep_summary(outcome: Outcome, heading: str) -> str:
    """The best settings below a heading, the chosen ones, and their recall on the queries to report on."""
    protocol = outcome.protocol
    best = np.argsort(-outcome.recall[:, protocol.main], kind="stable")[:_TOP].tolist()
    shown = list(dict.fromkeys([*best, outcome.own]))
    note = "; last: the scorer's own values" if len(shown) > len(best) else ""
    parts = [f"{heading}\n", f"Best settings by {_label(outcome)}, all queries{note}."]
    parts.append(_sweep_table(outcome, shown).text())
    for name, half, number in zip(protocol.names, protocol.halves, outcome.chosen, strict=False):
        sizes = f"chosen on {len(half.tune)} queries of {name}, reported on the {len(half.report)} of the other half"
        parts.append(f"{sizes}: {format_values(outcome.settings[number])}")
    if not protocol.halves:
        parts.append(f"chosen: {format_values(outcome.settings[outcome.chosen[0]])}")
        parts.append("chosen and reported on the same queries, so this flatters; split=both does not")
    parts.append("Recall at 1 in %, with 95 % intervals in brackets:")
    for threshold, _, chosen, unswept, test, path in outcome.report:
        recalls = f"chosen {format_estimate(chosen)}, own values {format_estimate(unswept)}"
        counts = f"only one of them correct: {test.only_first} and {test.only_second} queries"
        probabilities = f"McNemar p = {test.p_value:.2g}, along the path p = {path.p_value:.2g}"
        parts.append(f"{protocol.label(1, threshold)}: {recalls}; {counts}, {probabilities}")
    return "\n".join(parts)


def _sweep_table(outcome: Outcome, numbers: Sequence[int] | None = None) -> Table:
    """A line for each of these settings, or of all."""
    header, recalls = _recalls(outcome)
    lines = []
    for number in range(len(recalls)) if numbers is None else numbers:
        values = map(format_value, (outcome.settings[number][name] for name in outcome.axes.values))
        lines.append([*values, *(f"{100 * value:.1f}" for value in recalls[number])])
    return Table([*outcome.axes.values, *header], lines, text_columns=0)


def _recalls(outcome: Outcome) -> tuple[list[str], np.ndarray]:
    """Labels and values `[settings, labels]` of the recalls of a table."""
    protocol, (first, *deeper), rows = outcome.protocol, outcome.ks, outcome.rows[0]
    header = [protocol.label(first, threshold) for threshold in protocol.thresholds]
    header += [protocol.label(k, protocol.thresholds[protocol.main]) for k in deeper]
    deeper_recalls = (protocol.recall(rows, k)[:, protocol.main] for k in deeper)
    return header, np.column_stack([protocol.recall(rows, first), *deeper_recalls])


def _label(outcome: Outcome) -> str:
    return outcome.protocol.label(1, outcome.protocol.thresholds[outcome.protocol.main])


def sweep_figures(outcome: Outcome) -> list[Figure]:
    """Heat maps of every pair of axes with several values; none of a search that tried no complete grid."""
    names = [name for name, axis in outcome.axes.values.items() if len(axis) > 1 and outcome.is_grid]
    pairs = list(itertools.combinations(names, 2)) or [("", name) for name in names]
    files = runs.file_names([" + ".join(filter(None, pair)) for pair in pairs[:_MAX_HEAT_MAPS]]).values()
    draw = lambda path, pair: save_figure(_heat_map(outcome, *pair), path)  # noqa: E731
    return [(f"{file}.png", partial(draw, pair=pair)) for pair, file in zip(pairs, files, strict=False)]


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
    panel.add_patch(Rectangle(corner, 1, 1, linewidth=2.5, fill=False, edgecolor=_MARK))
    unswept = {"": ""} | {name: format_value(value) for name, value in axes.own_values.items()}
    if unswept[first] in words[first] and unswept[second] in words[second]:
        place = words[second].index(unswept[second]), words[first].index(unswept[first])
        panel.plot(*place, marker="o", markersize=30, markerfacecolor="none", markeredgecolor=_MARK)
    fixed = [f"{name} = {words[name][place]}" for name, place in best.items() if name not in ("", first, second)]
    panel.set_title("; ".join([f"{_label(outcome)} in %", *fixed]), fontsize=9, parse_math=False)
    figure.colorbar(image, ax=panel, label="%")
    return figure


# --- learning ----------------------------------------------------------------------------------------------------


def comparison_json(comparison: "Comparison") -> dict[str, Any]:
    """The comparison as JSON values; differences are those from the first row."""
    protocol, rows = comparison.protocol, []
    names, first = [f"{threshold:g}" for threshold in protocol.thresholds], next(comparison.rows())[1]
    ends = np.cumsum([*protocol.reported_sets.values()])[:-1]
    for name, hits, halves in comparison.rows():
        row: dict[str, Any] = {"score": name, "recall_at_1": {}, "interval": {}, "against_first": {}, "halves": {}}
        row["by_set"] = {set_name: {} for set_name in protocol.reported_sets}
        for threshold, ours, theirs in zip(names, hits, first, strict=True):
            row["recall_at_1"][threshold] = float(ours.mean())
            row["interval"][threshold] = recall_interval(ours)
            tests = {"mcnemar": mcnemar(ours, theirs)._asdict(), "path_test": path_test(ours, theirs)._asdict()}
            row["against_first"][threshold] = tests
            for recalls, each in zip(row["by_set"].values(), np.split(ours, ends), strict=False):
                recalls[threshold] = float(each.mean())
        for half in halves:
            row["halves"][half.half] = {"values": dict(half.values), "recall_at_1": half.hits.mean(axis=1).tolist()}
            if half.fitted:
                row["halves"][half.half] |= {"steps": half.fitted.step, "history": half.fitted.history}
        rows.append(row)
    queries = {
        "reported": [half.report.tolist() for half in protocol.halves],
        "chosen_on": [half.tune.tolist() for half in protocol.halves],
    }
    return {"unit": protocol.unit, "thresholds": list(protocol.thresholds), "queries": queries, "rows": rows}


def comparison_table(comparison: "Comparison") -> Table:
    """Recall at 1 of every row, its interval at the threshold that decides, and how it differs from the first row."""
    protocol, rows = comparison.protocol, comparison_json(comparison)["rows"]
    threshold = protocol.thresholds[protocol.main]
    main, words, lines = f"{threshold:g}", threshold_words(protocol.unit, threshold), []
    for row in rows:
        recalls = [*row["recall_at_1"].values(), *(recalls[main] for recalls in row["by_set"].values())]
        test, path = row["against_first"][main].values()
        differences = [f"+{test['only_first']} -{test['only_second']}", f"{test['p_value']:.2g}"]
        differences = [*differences, f"{path['p_value']:.2g}"] if lines else [""] * 3
        texts = [f"{100 * recall:.1f}" for recall in recalls] + [format_interval(row["interval"][main])]
        lines.append([row["score"], *texts, *differences])
    header = [protocol.label(1, threshold) for threshold in protocol.thresholds]
    header += [f"{name}{words}" for name in protocol.reported_sets]
    header += [f"95 % at{words}" if words else "95 %", f"against {lines[0][0]}", "p", "p along the path"]
    return Table(["score", *header], lines)


def comparison_text(comparison: "Comparison") -> str:
    """The table, and the values that were chosen or learned."""
    lines = [comparison_table(comparison).text()]
    for name, _, halves in comparison.rows():
        for row in halves:
            steps = f"; best after {row.fitted.step} steps, {row.fitted.ended}" if row.fitted else ""
            lines += [f"{name}, {row.half}: {format_values(row.values)}{steps}"] if row.values else []
    return "\n".join(lines)


def write_weights(folder: Path, comparison: "Comparison", provenance: Mapping[str, Any]) -> None:
    """Write every learned match weight by name, with how it was learned; see `mfvpr.baselines.learned_weight`."""
    for name, fit in _fits(comparison).items():
        if (weight := fit.parameters.get("weight")) is not None:
            write_weight(folder / f"{re.sub(r'[^a-z]+', '_', name)}.json", weight, {**provenance, "training": name})


def comparison_figures(comparison: "Comparison") -> list[Figure]:
    """Loss and validation over the steps of the trainings."""
    return [("curves.png", partial(_draw_curves, fits=_fits(comparison)))]


def _fits(comparison: "Comparison") -> "dict[str, Fit]":
    return {f"{row.half}: {row.name}": row.fitted for half in comparison.halves for row in half if row.fitted}


def _draw_curves(path: Path, fits: "Mapping[str, Fit]") -> None:
    """Draw a panel for each training, whose history has None where loss or validation are unknown."""
    figure, axes = panels(len(fits), 3.4, 2.6)
    for panel, (name, fit) in zip(axes, fits.items(), strict=True):
        steps, *columns = np.array(fit.history, float).T  # None becomes NaN
        for values, label, color in zip(columns, ("loss", "validation"), (_PALE, _MARK), strict=True):
            known = np.isfinite(values)
            panel.plot(steps[known], values[known], label=label, color=color, marker=".", markersize=4)
        panel.set_title(name, fontsize=9)
        panel.set_xlabel("step", fontsize=8)
        panel.grid(alpha=0.3)
    axes[0].legend(fontsize=8)
    save_figure(figure, path)
