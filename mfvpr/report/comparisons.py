"""Reports of a learning comparison: table, text, JSON values, learned weights, and figures."""

import re
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from mfvpr.baselines.learned_weight import LearnedWeight, write_weight
from mfvpr.datasets.ground_truth import threshold_words
from mfvpr.evaluation.protocol import EvaluationProtocol
from mfvpr.evaluation.statistics import mcnemar, path_test, recall_interval
from mfvpr.report.plots import GRAY, MARK, PALE, panels, save_figure
from mfvpr.report.runs import Figure
from mfvpr.report.tables import Table, format_interval, format_values
from mfvpr.tuning.learning.comparison import Comparison
from mfvpr.tuning.learning.training import Fit
from mfvpr.utils.numerics import compiled

SHOWN_QUERIES = 20  # whose matches the figure of the weights counts
BINS = 12  # of these matches, by the value of an input


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
    ends = np.cumsum([*protocol.reported_sets.values()])
    return dict(zip(protocol.reported_sets, np.split(hits, ends[:-1]), strict=False)) if len(ends) else {}


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
    protocol = comparison.protocol
    first = next(comparison.rows())[1]

    def by_threshold(values: Iterable[Any]) -> dict[str, Any]:
        return dict(zip([f"{threshold:g}" for threshold in protocol.thresholds], values, strict=True))

    rows = []
    for name, hits, halves in comparison.rows():
        tests = [
            {"mcnemar": mcnemar(*pair)._asdict(), "path_test": path_test(*pair)._asdict()}
            for pair in zip(hits, first, strict=True)
        ]
        parts = {}
        for row in halves:
            parts[row.half] = {"values": dict(row.values), "recall_at_1": row.hits.mean(axis=1).tolist()}
            parts[row.half] |= {"steps": row.fitted.step, "history": row.fitted.history} if row.fitted else {}
        sets = _by_set(protocol, hits.T)
        rows.append(
            {
                "score": name,
                "recall_at_1": by_threshold(hits.mean(axis=1).tolist()),
                "interval": by_threshold(map(recall_interval, hits)),
                "against_first": by_threshold(tests),
                "by_set": {set_name: by_threshold(each.mean(axis=0).tolist()) for set_name, each in sets.items()},
                "halves": parts,
            }
        )
    return {
        "unit": protocol.unit,
        "thresholds": list(protocol.thresholds),
        "queries": {
            "reported": [half.report.tolist() for half in protocol.halves],
            "chosen_on": [half.tune.tolist() for half in protocol.halves],
        },
        "rows": rows,
    }


def write_weights(folder: Path, comparison: Comparison, provenance: Mapping[str, Any]) -> None:
    """Write every learned match weight by name, with how it was learned; see `mfvpr.baselines.learned_weight`."""
    for name, weight in _weights(comparison).items():
        write_weight(folder / f"{re.sub(r'[^a-z]+', '_', name)}.json", weight, {**provenance, "training": name})


def comparison_figures(comparison: Comparison) -> list[Figure]:
    """Curves of the trainings, and the learned weights over their inputs."""
    histories = {name: fit.history for name, fit in _fits(comparison).items()}
    return [
        ("curves.png", partial(_draw_curves, histories=histories)),
        ("weights.png", partial(_draw_weights, comparison=comparison, weights=_weights(comparison))),
    ]


def _fits(comparison: Comparison) -> dict[str, Fit]:
    return {f"{row.half}: {row.name}": row.fitted for half in comparison.halves for row in half if row.fitted}


def _weights(comparison: Comparison) -> dict[str, LearnedWeight]:
    fits = _fits(comparison)
    return {name: fit.parameters["weight"] for name, fit in fits.items() if "weight" in fit.parameters}


def _draw_curves(path: Path, histories: Mapping[str, Sequence[tuple[int, float | None, float | None]]]) -> None:
    """Draw loss and validation over the steps, one panel for each training, whose history has None where unknown."""
    figure, axes = panels(len(histories), 3.4, 2.6)
    for panel, (name, history) in zip(axes, histories.items(), strict=True):
        for place, label, color in ((1, "loss", PALE), (2, "validation", MARK)):
            points = [(row[0], row[place]) for row in history if row[place] is not None]
            panel.plot(*zip(*points, strict=True), label=label, color=color, marker=".", markersize=4)
        panel.set_title(name, fontsize=9)
        panel.set_xlabel("step", fontsize=8)
        panel.grid(alpha=0.3)
    axes[0].legend(fontsize=8)
    save_figure(figure, path)


def _draw_weights(path: Path, comparison: Comparison, weights: Mapping[str, LearnedWeight]) -> None:
    """Draw the mean match weight over each input, in bins of equally many matches of some queries reported on.

    A dotted line is the share of these matches that belong to a correct candidate.
    """
    protocol, queries = comparison.protocol, np.concatenate([half.report for half in comparison.protocol.halves])
    shown = queries[np.linspace(0, len(queries) - 1, min(SHOWN_QUERIES, len(queries))).astype(int)]
    positives = protocol.positives[protocol.main].take(shown).contains(comparison.candidates.indices[shown])
    first, query_matches = next(iter(weights.values())), [comparison.match_set[query] for query in shown]
    inputs = np.concatenate([np.asarray(_raw(first, matches))[matches.mask] for matches in query_matches])
    counts = np.concatenate([matches.mask.sum(axis=1) for matches in query_matches])
    correct, by_training = np.repeat(positives.reshape(-1), counts), {}
    for name, weight in weights.items():
        weighed = [np.asarray(_weigh(weight, matches))[matches.mask] for matches in query_matches]
        by_training[name] = np.concatenate(weighed)
    figure, axes = panels(len(first.names), 3.2, 2.6)
    for panel, name, values in zip(axes, first.names, inputs.T, strict=True):
        edges = np.unique(np.quantile(values, np.linspace(0, 1, BINS + 1)))
        bin_of = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, max(len(edges) - 2, 0))
        members = [bin_of == used for used in np.unique(bin_of)]
        centers = [values[member].mean() for member in members]
        for label, weight in by_training.items():
            panel.plot(centers, [weight[member].mean() / weight.mean() for member in members], label=label, marker=".")
        panel.set_title(name, fontsize=9)
        panel.grid(alpha=0.3)
        share = panel.twinx()
        share.plot(centers, [100 * correct[member].mean() for member in members], color=GRAY, linestyle=":")
        share.tick_params(labelsize=7, labelcolor=GRAY)
    axes[0].legend(fontsize=7)
    axes[0].set_ylabel("weight / mean weight", fontsize=8)
    figure.suptitle("dotted: % of these matches that belong to a correct candidate", fontsize=9)
    save_figure(figure, path)


_weigh = compiled(jax.vmap(lambda weight, matches: weight(matches), in_axes=(None, 0)))
_raw = compiled(
    jax.vmap(lambda weight, matches: weight.center[None] + weight.scale[None] * weight.inputs(matches), (None, 0))
)
