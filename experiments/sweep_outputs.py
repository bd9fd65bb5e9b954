"""What a sweep leaves: all settings as table, CSV and JSON, heat maps, and a summary for the terminal."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from experiments import truth
from experiments.axes import Axes, shown
from experiments.prepare import Images
from experiments.run_folder import Figure
from mfvpr import evaluation
from mfvpr.data.files import write_text
from mfvpr.evaluation import Judge
from mfvpr.evaluation.statistics import mcnemar, recall_interval
from mfvpr.report import runs
from mfvpr.report.heat_maps import heat_map_figure
from mfvpr.report.tables import Table

TOP = 10
MAX_HEAT_MAPS = 6


@dataclass(frozen=True)
class Found:
    """Everything that one sweep made."""

    settings: dict[str, Any]
    images: Images
    axes: Axes
    judge: Judge
    written: list[dict[str, Any]]  # S settings
    rows: np.ndarray  # [V, S, Q, depth] database rows
    seconds: dict[str, float]

    @cached_property
    def recall(self) -> np.ndarray:
        """`[S, thresholds]` at 1, of all queries."""
        return self.judge.recall(self.rows[0])

    @property
    def is_grid(self) -> bool:
        """Whether the first settings are those of the grid, in order."""
        return self.settings["search"] == "grid"

    @property
    def own(self) -> int:
        """The number of the scorer's own values."""
        return self.written.index(dict(self.axes.own))

    @cached_property
    def chosen(self) -> list[int]:
        """The number of the best setting, for each half."""
        size = self.axes.size if self.is_grid else len(self.written)
        axes = self.axes.values if self.is_grid else None
        return [evaluation.best_setting(one[:size, self.judge.main], axes) for one in self.judge.tuning(self.rows)]


def text(found: Found) -> str:
    """The summary, for the terminal."""
    return "\n".join(_summary(found))


def write(folder: Path, found: Found) -> None:
    """All files of the run folder but the figures."""
    runs.write_table(folder, _table(found, range(len(found.written))), _heading(found))
    runs.write_json(folder / "results.json", _results(found))
    write_text(folder / "summary.txt", text(found) + "\n")


def _table(found: Found, numbers: Sequence[int]) -> Table:
    """Recall at 1 of some settings by all queries, and at the other ks by the main threshold."""
    judge, names = found.judge, list(found.axes.values)
    ks = sorted(set(found.settings["recall"]["ks"]))
    header = [judge.label(ks[0], threshold) for threshold in judge.thresholds]
    header += [judge.label(k, judge.thresholds[judge.main]) for k in ks[1:]]
    columns = [*judge.recall(found.rows[0][list(numbers)], ks[0]).T]
    columns += [judge.recall(found.rows[0][list(numbers)], k)[:, judge.main] for k in ks[1:]]
    lines = [
        [*(shown(found.written[number][name]) for name in names), *(f"{100 * column[place]:.1f}" for column in columns)]
        for place, number in enumerate(numbers)
    ]
    return Table([*names, *header], lines, text_columns=0)


def _heading(found: Found) -> str:
    dataset, features = found.images.dataset, found.settings["features"]
    return (
        f"{dataset.name}: {len(dataset.queries)} queries, {found.judge.views[0].shape[1]} candidates of "
        f"{len(dataset.database)} database images, {found.rows.shape[1]} settings of the {found.axes.method} score, "
        f"{features['name']} features at {features['image_size'][0]} x {features['image_size'][1]} px; "
        f"{truth.in_words(found.settings, dataset)}"
    )


def _summary(found: Found) -> Iterator[str]:
    judge = found.judge
    main = judge.thresholds[judge.main]
    yield _heading(found) + "\n"
    best = np.argsort(-found.recall[:, judge.main], kind="stable")[:TOP].tolist()
    beside = "" if found.own in best else "; last: the scorer's own values"
    yield f"Best settings by {judge.label(1, main)}, all queries{beside}."
    yield _table(found, list(dict.fromkeys([*best, found.own]))).text()
    if found.is_grid and not judge.halves:
        best = found.chosen[0]
        around = evaluation.neighbors(found.axes.values, best)
        if around:
            yield "The best, and its neighbors in the grid:"
            yield _table(found, [best, *around]).text()
    yield from _verdict(found)


def _verdict(found: Found) -> Iterator[str]:
    judge = found.judge
    if judge.halves:
        for half, number in zip(judge.halves, found.chosen, strict=True):
            yield (f"chosen on {len(half.tune)} queries of one half, reported on the {len(half.report)} of the other: "
                   f"{_in_words(found, number)}")  # fmt: skip
    else:
        yield f"chosen: {_in_words(found, found.chosen[0])}"
    for line in _report(found):
        chosen, own = (_with_interval(line[name]) for name in ("chosen", "own"))
        test = line["mcnemar"]
        yield (
            f"{judge.label(1, line['threshold'])}: chosen {chosen}, own values {own}; only one of them right: "
            f"{test['only_first']} and {test['only_second']} queries, McNemar p = {test['p_value']:.2g}"
        )
    if not judge.halves:
        yield (
            "Chosen and reported on the same queries, so this flatters; split=both chooses on one half of the path "
            "and reports on the other."
        )


def _with_interval(value: dict[str, Any]) -> str:
    low, high = value["interval"]
    return f"{100 * value['recall']:.1f} [{100 * low:.1f}, {100 * high:.1f}]"


def _report(found: Found) -> Iterator[dict[str, Any]]:
    """Per threshold: recall of the chosen and of the scorer's own values, with intervals, and their comparison."""
    judge = found.judge
    chosen = judge.reported(found.rows, found.chosen)
    own = judge.reported(found.rows, [found.own] * max(1, len(judge.halves)))
    for place, threshold in enumerate(judge.thresholds):
        values = {
            name: {"recall": float(hits.mean()), "interval": list(recall_interval(hits))}
            for name, hits in (("chosen", chosen[place]), ("own", own[place]))
        }
        test = mcnemar(chosen[place], own[place])
        yield {"threshold": threshold, "queries": chosen.shape[1], **values, "mcnemar": test._asdict()}


def _in_words(found: Found, number: int) -> str:
    return ", ".join(f"{name} = {shown(value)}" for name, value in found.written[number].items())


def _results(found: Found) -> dict[str, Any]:
    judge, settings = found.judge, found.settings
    ks = sorted(set(settings["recall"]["ks"]))
    recall = np.stack([judge.recall(found.rows[0], k) for k in ks], axis=-1)  # [S, thresholds, ks]
    return {
        "dataset": found.images.dataset.name,
        "data_fingerprint": found.images.fingerprints, "reading": found.images.reading,
        "scorer": settings["scorer"], "features": settings["features"], "filter": settings["retrieval"],
        "matching": settings["matching"], "candidates": settings["candidates"], "fusion": settings["fusion"],
        "final": settings["final"], "ground_truth": truth.described(settings, found.images.dataset),
        "axes": dict(found.axes.values), "own": dict(found.axes.own), "search": settings["search"],
        "unit": judge.unit, "thresholds": list(judge.thresholds), "ks": ks, "split": settings["split"],
        "chosen": [found.written[number] for number in found.chosen],
        "report": list(_report(found)),
        "settings": [
            {"parameters": written, "recall_at": {
                f"{threshold:g}": {str(k): round(float(recall[number, place, depth]), 6) for depth, k in enumerate(ks)}
                for place, threshold in enumerate(judge.thresholds)}}
            for number, written in enumerate(found.written)
        ],
        "seconds": found.seconds, "versions": runs.versions(),
    }  # fmt: skip


def figures(found: Found) -> list[Figure]:
    """Heat maps of every pair of axes with several values, the others at the best setting (of all queries)."""
    return list(_heat_maps(found)) if found.is_grid else []


def _heat_maps(found: Found) -> Iterator[Figure]:
    values = {name: list(map(shown, axis)) for name, axis in found.axes.values.items()}
    recall = found.recall[: found.axes.size, found.judge.main].reshape(*map(len, values.values()))
    names = [name for name, axis in values.items() if len(axis) > 1]
    pairs = list(itertools.combinations(names, 2)) or [(name, name) for name in names]
    flat_best = evaluation.best_setting(recall.reshape(-1), found.axes.values)
    best = dict(zip(values, map(int, np.unravel_index(flat_best, recall.shape)), strict=True))
    own = {name: values[name].index(shown(value)) if shown(value) in values[name] else None
           for name, value in found.axes.own.items()}  # fmt: skip
    label = found.judge.label(1, found.judge.thresholds[found.judge.main])
    for first, second in pairs[:MAX_HEAT_MAPS]:
        single = first == second
        plane = recall[tuple(slice(None) if name in (first, second) else best[name] for name in values)]
        fixed = [f"{name} = {values[name][place]}" for name, place in best.items() if name not in (first, second)]
        row, column = 0 if single else own[first], own[second]
        draw = partial(
            heat_map_figure,
            recall=plane[None] if single else plane,
            rows=("", [""]) if single else (first, values[first]),
            columns=(second, values[second]),
            best=(0 if single else best[first], best[second]),
            own=None if row is None or column is None else (row, column),
            title="; ".join([f"{label} in %", *fixed]),
        )
        yield f"{second}.png" if single else f"{first}_{second}.png", draw
