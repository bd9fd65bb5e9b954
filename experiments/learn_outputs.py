"""What learning leaves: the table side by side, the learned values, and how the trainings went."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments import truth
from experiments.axes import shown
from experiments.prepare import Images
from experiments.run_folder import Figure
from mfvpr.data.files import replacing, write_text
from mfvpr.evaluation import Judge, threshold_words
from mfvpr.evaluation.statistics import mcnemar, recall_interval
from mfvpr.learning.match_weight import FEATURE_NAMES, LearnedWeight
from mfvpr.learning.training import Fit
from mfvpr.pipeline import MatchSet
from mfvpr.report import runs
from mfvpr.report.learning_figures import curves_figure, weights_figure
from mfvpr.report.tables import Table
from mfvpr.types import Shortlist

SHOWN_QUERIES = 20  # whose matches the figure of the weights counts


@dataclass(frozen=True)
class Result:
    """One row of the table, of one half.

    Attributes:
        half: where it was chosen or learned.
        name: of the row.
        hits: `[thresholds, R]` bool, of the queries of the other half.
        values: what was chosen or learned, as written.
        fitted: the training, where there was one.
    """

    half: str
    name: str
    hits: np.ndarray
    values: dict[str, Any]
    fitted: Fit | None


@dataclass(frozen=True)
class Outcome:
    """Everything that one run of learning made."""

    settings: dict[str, Any]
    images: Images
    judge: Judge
    matches: MatchSet
    candidates: Shortlist
    results: Sequence[Sequence[Result]]  # per half, the rows in the same order
    seconds: dict[str, float]

    def rows(self) -> Iterator[tuple[str, np.ndarray, Sequence[Result]]]:
        """Name, hits `[thresholds, R]` of all reported queries, and the halves' results."""
        for found in zip(*self.results, strict=True):
            yield found[0].name, np.concatenate([one.hits for one in found], axis=1), found


def text(outcome: Outcome) -> str:
    """For the terminal."""
    return "\n".join([_heading(outcome), "", _table(outcome).text(), *_remarks(outcome)])


def write(folder: Path, outcome: Outcome) -> None:
    """All files of the run folder but the figures."""
    runs.write_table(folder, _table(outcome), _heading(outcome))
    runs.write_json(folder / "results.json", _results(outcome))
    for name, weight in _weights(outcome).items():
        _write_weight(folder / "weights" / f"{re.sub(r'[^a-z]+', '_', name)}.npz", weight)
    write_text(folder / "summary.txt", text(outcome) + "\n")


def figures(outcome: Outcome) -> list[Figure]:
    """How the trainings went, and what the learned weights look at."""
    histories = {name: one.history for name, one in _fitted(outcome).items()}
    return [
        ("curves.png", partial(curves_figure, histories=histories)),
        ("weights.png", partial(_weights_figure, outcome=outcome, weights=_weights(outcome))),
    ]


def _fitted(outcome: Outcome) -> dict[str, Fit]:
    return {f"{one.half}: {one.name}": one.fitted for half in outcome.results for one in half if one.fitted}


def _weights(outcome: Outcome) -> dict[str, LearnedWeight]:
    fitted = _fitted(outcome)
    return {name: one.parameters["weight"] for name, one in fitted.items() if "weight" in one.parameters}


def _heading(outcome: Outcome) -> str:
    dataset, halves = outcome.images.dataset, outcome.judge.halves
    reported = sum(len(half.report) for half in halves)
    return (
        f"{dataset.name}: {outcome.settings['scorer']['method']} score, {outcome.settings['features']['name']} "
        f"features; each of {reported} queries is reported on by what was learned on the other half of the path; "
        f"{truth.in_words(outcome.settings, dataset)}"
    )


def _table(outcome: Outcome) -> Table:
    judge = outcome.judge
    lines, first = [], None
    for name, hits, _ in outcome.rows():
        first = hits if first is None else first
        low, high = recall_interval(hits[judge.main])
        test = mcnemar(hits[judge.main], first[judge.main])
        compared = "" if hits is first else f"+{test.only_first} -{test.only_second}"
        lines.append([
            name, *(f"{100 * one.mean():.1f}" for one in hits), f"[{100 * low:.1f}, {100 * high:.1f}]", compared,
            "" if hits is first else f"{test.p_value:.2g}",
        ])  # fmt: skip
    words = threshold_words(judge.unit, judge.thresholds[judge.main])
    header = [judge.label(1, threshold) for threshold in judge.thresholds]
    return Table(["score", *header, f"95 % at{words}" if words else "95 %", "against paper", "p"], lines)


def _remarks(outcome: Outcome) -> Iterator[str]:
    """What was chosen or learned, by half."""
    for name, _, found in outcome.rows():
        for one in found:
            if one.values:
                values = ", ".join(f"{key} = {shown(value)}" for key, value in one.values.items())
                steps = f"; best after {one.fitted.step} steps, {one.fitted.ended}" if one.fitted else ""
                yield f"{name}, {one.half}: {values}{steps}"


def _results(outcome: Outcome) -> dict[str, Any]:
    judge, settings = outcome.judge, outcome.settings
    left_out = ("dataset", "store", "out", "checkpoints", "multirun", "command")
    labels = [f"{threshold:g}" for threshold in judge.thresholds]
    rows = [
        {
            "score": name,
            "recall_at_1": dict(zip(labels, hits.mean(axis=1).tolist(), strict=True)),
            "interval": dict(zip(labels, map(recall_interval, hits), strict=True)),
            "halves": {one.half: _half(one) for one in found},
        }
        for name, hits, found in outcome.rows()
    ]
    return {
        "dataset": outcome.images.dataset.name, "ground_truth": truth.described(settings, outcome.images.dataset),
        "data_fingerprint": outcome.images.fingerprints, "reading": outcome.images.reading,
        "unit": judge.unit, "thresholds": list(judge.thresholds),
        "queries": {"reported": [half.report.tolist() for half in judge.halves],
                    "chosen_on": [half.tune.tolist() for half in judge.halves]},
        "rows": rows, "settings": {name: value for name, value in settings.items() if name not in left_out},
        "seconds": outcome.seconds, "versions": runs.versions(),
    }  # fmt: skip


def _half(result: Result) -> dict[str, Any]:
    found = {"values": result.values, "recall_at_1": result.hits.mean(axis=1).tolist()}
    return found if result.fitted is None else found | {"steps": result.fitted.step, "history": result.fitted.history}


def _weights_figure(path: Path, outcome: Outcome, weights: Mapping[str, LearnedWeight]) -> None:
    """What the weights look at, on queries that are reported on."""
    judge, queries = outcome.judge, np.concatenate([half.report for half in outcome.judge.halves])
    shown_queries = queries[np.linspace(0, len(queries) - 1, min(SHOWN_QUERIES, len(queries))).astype(int)]
    answers = judge.positives[judge.main].take(shown_queries).contains(outcome.candidates.indices[shown_queries])
    inputs, right = [], []
    found: dict[str, list[np.ndarray]] = {name: [] for name in weights}
    for query, answer in zip(shown_queries, answers, strict=True):
        matches = outcome.matches[query]
        real = matches.mask
        first = next(iter(weights.values()))
        inputs.append(np.asarray(_raw(first, matches))[real])
        right.append(np.broadcast_to(answer[:, None], real.shape)[real])
        for name, weight in weights.items():
            found[name].append(np.asarray(_weigh(weight, matches))[real])
    joined = {name: np.concatenate(values) for name, values in found.items()}
    weights_figure(path, FEATURE_NAMES, np.concatenate(inputs), joined, np.concatenate(right))


_weigh = jax.jit(jax.vmap(lambda weight, matches: weight(matches), in_axes=(None, 0)))
_raw = jax.jit(
    jax.vmap(
        lambda weight, matches: weight.center[None] + weight.scale[None] * weight.inputs(matches), in_axes=(None, 0)
    )
)


def _write_weight(path: Path, weight: LearnedWeight) -> None:
    """The learned weight's arrays, by name."""
    with replacing(path) as temporary:
        np.savez(temporary, allow_pickle=False, **{f.name: np.asarray(getattr(weight, f.name)) for f in fields(weight)})
