"""What learning came to, for people: the table side by side, rows of results, learned weights, and figures."""

import re
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from mfvpr.datasets.truth import threshold_words
from mfvpr.evaluation.protocol import Judge
from mfvpr.evaluation.statistics import SignFlips, block_sign_flips, estimate, mcnemar, recall_interval
from mfvpr.report.learning_figures import curves_figure, weights_figure
from mfvpr.report.runs import Figure
from mfvpr.report.tables import Table, written
from mfvpr.scoring.learned_weight import LearnedWeight
from mfvpr.scoring.weight_files import write_weight
from mfvpr.tuning.learning.comparison import Comparison, Row
from mfvpr.tuning.learning.training import Fit
from mfvpr.utils.numerics import compiled

SHOWN_QUERIES = 20  # whose matches the figure of the weights counts


def table(comparison: Comparison) -> Table:
    """Recall at 1 of every row, its interval at the threshold that decides, and how it differs from the first row.

    p is McNemar's, which takes queries for independent, and that of blocks of the path.
    """
    judge, sets = comparison.judge, comparison.judge.reported_sets
    lines, first = [], None
    for name, hits, _ in comparison.rows():
        first = hits if first is None else first
        low, high = estimate(hits[judge.main]).interval
        pair = hits[judge.main], first[judge.main]
        test, flips = mcnemar(*pair), _flips(judge, *pair)
        compared = [f"+{test.only_first} -{test.only_second}", f"{test.p_value:.2g}", f"{flips.p_value:.2g}"]
        compared = [""] * 3 if hits is first else compared
        recall = [*hits, *_by_set(judge, hits[judge.main]).values()]
        lines.append(
            [name, *(f"{100 * one.mean():.1f}" for one in recall), f"[{100 * low:.1f}, {100 * high:.1f}]", *compared]
        )
    words = threshold_words(judge.unit, judge.thresholds[judge.main])
    header, name_of_first = [judge.label(1, threshold) for threshold in judge.thresholds], lines[0][0]
    header += [f"{name}{words}" for name in sets]
    return Table(
        ["score", *header, f"95 % at{words}" if words else "95 %", f"against {name_of_first}", "p", "p by blocks"],
        lines,
    )


def _by_set(judge: Judge, hits: np.ndarray) -> dict[str, np.ndarray]:
    """Hits `[R]` of each data set, where several are reported on."""
    ends = np.cumsum([*judge.reported_sets.values()])
    return dict(zip(judge.reported_sets, np.split(hits, ends[:-1]), strict=False)) if len(ends) else {}


def _set_recalls(judge: Judge, hits: np.ndarray) -> list[np.ndarray]:
    """`[thresholds]` recall of each data set, of hits `[thresholds, R]`."""
    return [np.mean(one, axis=0) for one in _by_set(judge, hits.T).values()]


def _flips(judge: Judge, hits: np.ndarray, first: np.ndarray) -> SignFlips:
    return block_sign_flips(hits, first, sequences=[*judge.reported_sets.values()] or None)


def text(comparison: Comparison) -> str:
    """The table, and what was chosen or learned."""
    return "\n".join([table(comparison).text(), *_remarks(comparison)])


def results(comparison: Comparison) -> dict[str, Any]:
    """All of it as JSON values."""
    judge = comparison.judge
    labels = [f"{threshold:g}" for threshold in judge.thresholds]
    first = next(comparison.rows())[1]
    rows = [
        {
            "score": name,
            "recall_at_1": dict(zip(labels, hits.mean(axis=1).tolist(), strict=True)),
            "interval": dict(zip(labels, map(recall_interval, hits), strict=True)),
            "against_first": dict(zip(labels, map(partial(_difference, judge), hits, first), strict=True)),
            "by_set": {
                name: dict(zip(labels, map(float, recall), strict=True))
                for name, recall in zip(judge.reported_sets, _set_recalls(judge, hits), strict=True)
            },
            "halves": {row.half: _half(row) for row in halves},
        }
        for name, hits, halves in comparison.rows()
    ]
    return {
        "unit": judge.unit, "thresholds": list(judge.thresholds),
        "queries": {"reported": [half.report.tolist() for half in judge.halves],
                    "chosen_on": [half.tune.tolist() for half in judge.halves]},
        "rows": rows,
    }  # fmt: skip


def write_weights(folder: Path, comparison: Comparison, made: Mapping[str, Any]) -> None:
    """Every learned match weight by name, with how all of them were made; see `mfvpr.scoring.weight_files`."""
    for name, weight in _weights(comparison).items():
        write_weight(folder / f"{re.sub(r'[^a-z]+', '_', name)}.json", weight, {**made, "training": name})


def figures(comparison: Comparison) -> list[Figure]:
    """How the trainings went, and what the learned weights look at."""
    histories = {name: fitted.history for name, fitted in _fitted(comparison).items()}
    return [
        ("curves.png", partial(curves_figure, histories=histories)),
        ("weights.png", partial(_weights_figure, comparison=comparison, weights=_weights(comparison))),
    ]


def _fitted(comparison: Comparison) -> dict[str, Fit]:
    return {f"{row.half}: {row.name}": row.fitted for half in comparison.halves for row in half if row.fitted}


def _weights(comparison: Comparison) -> dict[str, LearnedWeight]:
    parameters = {name: fitted.parameters for name, fitted in _fitted(comparison).items()}
    return {name: one["weight"] for name, one in parameters.items() if "weight" in one}


def _remarks(comparison: Comparison) -> Iterator[str]:
    """By half."""
    for name, _, halves in comparison.rows():
        for row in halves:
            if row.values:
                values = ", ".join(f"{key} = {written(value)}" for key, value in row.values.items())
                steps = f"; best after {row.fitted.step} steps, {row.fitted.ended}" if row.fitted else ""
                yield f"{name}, {row.half}: {values}{steps}"


def _difference(judge: Judge, hits: np.ndarray, first: np.ndarray) -> dict[str, Any]:
    return {
        "mcnemar": mcnemar(hits, first)._asdict(),
        "sign_flips": _flips(judge, hits, first)._asdict(),
    }


def _half(row: Row) -> dict[str, Any]:
    found = {"values": dict(row.values), "recall_at_1": row.hits.mean(axis=1).tolist()}
    return found if row.fitted is None else found | {"steps": row.fitted.step, "history": row.fitted.history}


def _weights_figure(path: Path, comparison: Comparison, weights: Mapping[str, LearnedWeight]) -> None:
    """On queries that are reported on."""
    judge, queries = comparison.judge, np.concatenate([half.report for half in comparison.judge.halves])
    shown = queries[np.linspace(0, len(queries) - 1, min(SHOWN_QUERIES, len(queries))).astype(int)]
    answers = judge.positives[judge.main].take(shown).contains(comparison.candidates.indices[shown])
    inputs, right = [], []
    found: dict[str, list[np.ndarray]] = {name: [] for name in weights}
    for query, answer in zip(shown, answers, strict=True):
        matches = comparison.match_set[query]
        real = matches.mask
        inputs.append(np.asarray(_raw(next(iter(weights.values())), matches))[real])
        right.append(np.broadcast_to(answer[:, None], real.shape)[real])
        for name, weight in weights.items():
            found[name].append(np.asarray(_weigh(weight, matches))[real])
    joined = {name: np.concatenate(values) for name, values in found.items()}
    weights_figure(path, next(iter(weights.values())).names, np.concatenate(inputs), joined, np.concatenate(right))


_weigh = compiled(jax.vmap(lambda weight, matches: weight(matches), in_axes=(None, 0)))
_raw = compiled(
    jax.vmap(
        lambda weight, matches: weight.center[None] + weight.scale[None] * weight.inputs(matches), in_axes=(None, 0)
    )
)
