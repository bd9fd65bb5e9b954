"""Reports of a sweep: table of all settings, summary, JSON values, and heat maps."""

import itertools
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mfvpr import evaluation
from mfvpr.evaluation.statistics import Estimate
from mfvpr.report.file_names import file_names
from mfvpr.report.plots import heat_map_figure
from mfvpr.report.runs import Figure
from mfvpr.report.tables import Table, format_value
from mfvpr.tuning.sweeps.outcome import Outcome

TOP = 10
MAX_HEAT_MAPS = 6


def settings_table(outcome: Outcome, numbers: Iterable[int] | None = None) -> Table:
    """Recall at the first k by all thresholds, and at the other ks by the one that decides; a line for each setting.

    `numbers` choose settings; None = all.
    """
    protocol, (first, *deeper) = outcome.protocol, outcome.ks
    numbers = range(len(outcome.settings)) if numbers is None else numbers
    header = [protocol.label(first, threshold) for threshold in protocol.thresholds]
    header += [protocol.label(k, protocol.thresholds[protocol.main]) for k in deeper]
    rows = outcome.rows[0][list(numbers)]
    recalls = np.column_stack(
        [protocol.recall(rows, first), *(protocol.recall(rows, k)[:, protocol.main] for k in deeper)]
    )
    lines = [
        [*(format_value(outcome.settings[number][name]) for name in outcome.axes.values),
         *(f"{100 * value:.1f}" for value in recall)]
        for number, recall in zip(numbers, recalls, strict=True)
    ]  # fmt: skip
    return Table([*outcome.axes.values, *header], lines, text_columns=0)


def sweep_json(outcome: Outcome) -> dict[str, Any]:
    """The sweep as JSON values."""
    protocol, ks = outcome.protocol, outcome.ks
    recall = np.stack([protocol.recall(outcome.rows[0], k) for k in ks], axis=-1)  # [S, thresholds, ks]
    return {
        "axes": dict(outcome.axes.values), "own": dict(outcome.axes.own),
        "search": "grid" if outcome.is_grid else "optuna",
        "unit": protocol.unit, "thresholds": list(protocol.thresholds), "ks": list(ks), "split": protocol.split,
        "chosen": [outcome.settings[number] for number in outcome.chosen],
        "report": [
            {"threshold": verdict.threshold, "queries": verdict.queries, "chosen": verdict.chosen._asdict(),
             "own": verdict.own._asdict(), "mcnemar": verdict.mcnemar._asdict(),
             "sign_flips": verdict.sign_flips._asdict()}
            for verdict in outcome.report
        ],
        "settings": [
            {"parameters": setting, "recall_at": {
                f"{threshold:g}": {str(k): round(float(recall[number, place, depth]), 6) for depth, k in enumerate(ks)}
                for place, threshold in enumerate(protocol.thresholds)}}
            for number, setting in enumerate(outcome.settings)
        ],
    }  # fmt: skip


def sweep_summary(outcome: Outcome) -> str:
    """The best settings, the chosen ones, and their recall on the queries to report on."""
    protocol, defaults = outcome.protocol, outcome.own
    best = np.argsort(-outcome.recall[:, protocol.main], kind="stable")[:TOP].tolist()
    note = "" if defaults in best else "; last: the scorer's own values"
    shown = list(dict.fromkeys([*best, defaults]))
    parts = [
        f"Best settings by {protocol.label(1, protocol.thresholds[protocol.main])}, all queries{note}.",
        settings_table(outcome, shown).text(),
    ]
    if outcome.is_grid and not protocol.halves and len(shown) < len(outcome.settings):
        around = evaluation.neighboring_settings(outcome.axes.values, outcome.chosen[0])
        table = settings_table(outcome, [outcome.chosen[0], *around])
        parts += ["The best, and its neighbors in the grid:", table.text()] if around else []
    return "\n".join([*parts, *_verdicts(outcome)])


def _verdicts(outcome: Outcome) -> Iterator[str]:
    protocol = outcome.protocol
    words = [", ".join(f"{name} = {format_value(value)}" for name, value in outcome.settings[number].items())
             for number in outcome.chosen]  # fmt: skip
    for name, half, setting in zip(protocol.names, protocol.halves, words, strict=False):
        yield (f"chosen on {len(half.tune)} queries of {name}, reported on the {len(half.report)} of the other half: "
               f"{setting}")  # fmt: skip
    if not protocol.halves:
        yield f"chosen: {words[0]}"
    yield "Recall at 1 in %, with 95 % intervals in brackets:"
    for verdict in outcome.report:
        yield (
            f"{protocol.label(1, verdict.threshold)}: chosen {_with_interval(verdict.chosen)}, own values "
            f"{_with_interval(verdict.own)}; only one of them correct: {verdict.mcnemar.only_first} and "
            f"{verdict.mcnemar.only_second} queries, McNemar p = {verdict.mcnemar.p_value:.2g}, by "
            f"{verdict.sign_flips.blocks} blocks of {verdict.sign_flips.block} queries "
            f"p = {verdict.sign_flips.p_value:.2g}"
        )
    if not protocol.halves:
        yield (
            "Chosen and reported on the same queries, so this flatters; split=both chooses on one half of the path "
            "and reports on the other."
        )


def _with_interval(estimate: Estimate) -> str:
    low, high = estimate.interval
    return f"{100 * estimate.recall:.1f} [{100 * low:.1f}, {100 * high:.1f}]"


def heat_maps(outcome: Outcome) -> list[Figure]:
    """Heat maps of every pair of axes with several values, the others at the best setting (of all queries).

    A space that was not searched completely has none.
    """
    axes, protocol = outcome.axes, outcome.protocol
    values = {"": [""]} | {name: list(map(format_value, axis)) for name, axis in axes.values.items()}
    names = [name for name, axis in values.items() if len(axis) > 1] if outcome.is_grid else []
    pairs = list(itertools.combinations(names, 2)) or [("", name) for name in names]
    if not pairs:
        return []
    recall = outcome.recall[: axes.size, protocol.main].reshape(*map(len, values.values()))
    flat_best = evaluation.best_setting(recall.reshape(-1), axes.values)
    best = dict(zip(values, map(int, np.unravel_index(flat_best, recall.shape)), strict=True))
    own = {"": ""} | {name: format_value(value) for name, value in axes.own.items()}
    files = file_names([" + ".join(filter(None, pair)) for pair in pairs])
    figures: list[Figure] = []
    for (first, second), file in zip(pairs[:MAX_HEAT_MAPS], files.values(), strict=False):
        plane = recall[tuple(slice(None) if name in (first, second) else best[name] for name in values)]
        fixed = [f"{name} = {values[name][place]}" for name, place in best.items() if name not in ("", first, second)]
        in_grid = own[first] in values[first] and own[second] in values[second]
        draw = partial(
            heat_map_figure,
            recall=plane,
            rows=(first, _short(values[first])),
            columns=(second, _short(values[second])),
            best=(best[first], best[second]),
            defaults=(values[first].index(own[first]), values[second].index(own[second])) if in_grid else None,
            title="; ".join([f"{protocol.label(1, protocol.thresholds[protocol.main])} in %", *fixed]),
        )
        figures.append((f"{file}.png", draw))
    return figures


def _short(values: list[str]) -> list[str]:
    """Shorten JSON files to their stems, if these differ."""
    names = [Path(value).stem if value.endswith(".json") else value for value in values]
    return names if len({*names}) == len(names) else values
