"""Reports of a learning comparison: table, text, JSON values, learned weights, and figures."""

import re
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mfvpr.baselines.learned_weight import write_weight
from mfvpr.datasets.ground_truth import threshold_words
from mfvpr.evaluation.protocol import EvaluationProtocol
from mfvpr.evaluation.statistics import mcnemar, path_test, recall_interval
from mfvpr.report.plots import MARK, PALE, panels, save_figure
from mfvpr.report.runs import Figure
from mfvpr.report.tables import Table, format_interval, format_values
from mfvpr.tuning.learning.models import Comparison
from mfvpr.tuning.learning.training import Fit


def comparison_table(comparison: Comparison) -> Table:
    """Recall at 1 of every row, its interval at the threshold that decides, and how it differs from the first row.

    p is McNemar's, which takes queries for independent, and that of `path_test`.
    """
    protocol = comparison.protocol
    lines, first = [], next(comparison.rows())[1]
    for number, (name, hits, _) in enumerate(comparison.rows()):
        deciding, differences = hits[protocol.main], [""] * 3
        if number > 0:
            pair = deciding, first[protocol.main]
            test, path = mcnemar(*pair), path_test(*pair)
            differences = [f"+{test.only_first} -{test.only_second}", f"{test.p_value:.2g}", f"{path.p_value:.2g}"]
        recalls = [f"{100 * values.mean():.1f}" for values in (*hits, *_by_set(protocol, deciding).values())]
        lines.append([name, *recalls, format_interval(recall_interval(deciding)), *differences])
    words = threshold_words(protocol.unit, protocol.thresholds[protocol.main])
    header = [protocol.label(1, threshold) for threshold in protocol.thresholds]
    header += [f"{name}{words}" for name in protocol.reported_sets]
    header += [f"95 % at{words}" if words else "95 %", f"against {lines[0][0]}", "p", "p along the path"]
    return Table(["score", *header], lines)


def _by_set(protocol: EvaluationProtocol, hits: np.ndarray) -> dict[str, np.ndarray]:
    """Hits `[R]` of each data set, where several are reported on."""
    if not protocol.reported_sets:
        return {}
    ends = np.cumsum([*protocol.reported_sets.values()])[:-1]
    return dict(zip(protocol.reported_sets, np.split(hits, ends), strict=True))


def comparison_text(comparison: Comparison) -> str:
    """The table, and the values that were chosen or learned."""
    lines = [comparison_table(comparison).text()]
    for name, _, halves in comparison.rows():
        for row in halves:
            steps = f"; best after {row.fitted.step} steps, {row.fitted.ended}" if row.fitted else ""
            lines += [f"{name}, {row.half}: {format_values(row.values)}{steps}"] if row.values else []
    return "\n".join(lines)


def comparison_json(comparison: Comparison) -> dict[str, Any]:
    """The comparison as JSON values."""
    protocol, rows = comparison.protocol, []
    names, first = [f"{threshold:g}" for threshold in protocol.thresholds], next(comparison.rows())[1]
    for name, hits, halves in comparison.rows():
        row: dict[str, Any] = {"score": name, "recall_at_1": {}, "interval": {}, "against_first": {}, "halves": {}}
        row["by_set"] = {set_name: {} for set_name in protocol.reported_sets}
        for threshold, ours, theirs in zip(names, hits, first, strict=True):
            row["recall_at_1"][threshold] = float(ours.mean())
            row["interval"][threshold] = recall_interval(ours)
            tests = {"mcnemar": mcnemar(ours, theirs)._asdict(), "path_test": path_test(ours, theirs)._asdict()}
            row["against_first"][threshold] = tests
            for set_name, each in _by_set(protocol, ours).items():
                row["by_set"][set_name][threshold] = float(each.mean())
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


def write_weights(folder: Path, comparison: Comparison, provenance: Mapping[str, Any]) -> None:
    """Write every learned match weight by name, with how it was learned; see `mfvpr.baselines.learned_weight`."""
    for name, fit in _fits(comparison).items():
        if (weight := fit.parameters.get("weight")) is not None:
            write_weight(folder / f"{re.sub(r'[^a-z]+', '_', name)}.json", weight, {**provenance, "training": name})


def comparison_figures(comparison: Comparison) -> list[Figure]:
    """Curves of the trainings."""
    return [("curves.png", partial(_draw_curves, fits=_fits(comparison)))]


def _fits(comparison: Comparison) -> dict[str, Fit]:
    return {f"{row.half}: {row.name}": row.fitted for half in comparison.halves for row in half if row.fitted}


def _draw_curves(path: Path, fits: Mapping[str, Fit]) -> None:
    """Draw loss and validation over the steps, one panel for each training, whose history has None where unknown."""
    figure, axes = panels(len(fits), 3.4, 2.6)
    for panel, (name, fit) in zip(axes, fits.items(), strict=True):
        steps, *columns = np.array(fit.history, float).T  # None becomes NaN
        for values, label, color in zip(columns, ("loss", "validation"), (PALE, MARK), strict=True):
            known = np.isfinite(values)
            panel.plot(steps[known], values[known], label=label, color=color, marker=".", markersize=4)
        panel.set_title(name, fontsize=9)
        panel.set_xlabel("step", fontsize=8)
        panel.grid(alpha=0.3)
    axes[0].legend(fontsize=8)
    save_figure(figure, path)
