"""Reports of a learning comparison: table, text, JSON values, learned weights, and figures."""

import re
from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from mfvpr.baselines.learned_weight import LearnedWeight, write_weight
from mfvpr.datasets.ground_truth import threshold_words
from mfvpr.evaluation.protocol import EvaluationProtocol
from mfvpr.evaluation.statistics import mcnemar, path_test, recall_interval
from mfvpr.report.plots import curves_figure, weights_figure
from mfvpr.report.runs import Figure
from mfvpr.report.tables import Table, format_interval, format_values
from mfvpr.tuning.learning.comparison import Comparison
from mfvpr.tuning.learning.training import Fit
from mfvpr.utils.numerics import compiled

SHOWN_QUERIES = 20  # whose matches the figure of the weights counts


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
        ("curves.png", partial(curves_figure, histories=histories)),
        ("weights.png", partial(_weights_figure, comparison=comparison, weights=_weights(comparison))),
    ]


def _fits(comparison: Comparison) -> dict[str, Fit]:
    return {f"{row.half}: {row.name}": row.fitted for half in comparison.halves for row in half if row.fitted}


def _weights(comparison: Comparison) -> dict[str, LearnedWeight]:
    fits = _fits(comparison)
    return {name: fit.parameters["weight"] for name, fit in fits.items() if "weight" in fit.parameters}


def _weights_figure(path: Path, comparison: Comparison, weights: Mapping[str, LearnedWeight]) -> None:
    """Draw the weights of the matches of some queries that are reported on."""
    protocol, queries = comparison.protocol, np.concatenate([half.report for half in comparison.protocol.halves])
    shown = queries[np.linspace(0, len(queries) - 1, min(SHOWN_QUERIES, len(queries))).astype(int)]
    positives = protocol.positives[protocol.main].take(shown).contains(comparison.candidates.indices[shown])
    first = next(iter(weights.values()))
    pairs = [(comparison.match_set[query], correct) for query, correct in zip(shown, positives, strict=True)]
    inputs = np.concatenate([np.asarray(_raw(first, matches))[matches.mask] for matches, _ in pairs])
    correct = np.concatenate([np.repeat(correct, matches.mask.sum(axis=1)) for matches, correct in pairs])
    by_training = {}
    for name, weight in weights.items():
        weighed = [np.asarray(_weigh(weight, matches))[matches.mask] for matches, _ in pairs]
        by_training[name] = np.concatenate(weighed)
    weights_figure(path, first.names, inputs, by_training, correct)


_weigh = compiled(jax.vmap(lambda weight, matches: weight(matches), in_axes=(None, 0)))
_raw = compiled(
    jax.vmap(lambda weight, matches: weight.center[None] + weight.scale[None] * weight.inputs(matches), (None, 0))
)
