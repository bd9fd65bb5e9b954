"""Match weights on the same matches of real images: recall of every score with every weight, alone and fused."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.benchmark.real import answered, extractors, matched_sets
from mfvpr import AggregatedScore, AnchorPoints, HistogramOfShifts
from mfvpr.evaluation import mcnemar, stages
from mfvpr.evaluation.statistics import block_sign_flips
from mfvpr.report import Table
from mfvpr.reranking import Matched
from mfvpr.reranking.ranking import fuse_shortlist
from mfvpr.scoring.weights import WEIGHTS
from mfvpr.utils.files import write_text
from mfvpr.utils.versions import versions

SIZE = (320, 320)
VARIANTS = ("n16", "n32")
TOLERANCE = 2  # frames
SCORERS = {"histogram": HistogramOfShifts(), "anchor": AnchorPoints(), "sum": AggregatedScore()}
Hits = dict[str, dict[str, np.ndarray]]  # of every query, by system and weight


def run(rounds: int | None, out: Path, data: Path | None = None) -> None:
    """Both data sets below `data`, SIFT's and two variants of ALIKED's matches with all images; nothing is timed."""
    by_features: dict[str, dict[str, Hits]] = {}
    for name, matched in matched_sets(data, "all", extractors(SIZE, VARIANTS)):
        place, _, features = name.partition(", ")
        by_features.setdefault(features, {})[place] = all_answered(matched)
    tables = [{"features": features, "rows": [*rows(places)]} for features, places in by_features.items()]
    for table in tables:
        print(f"\n{table['features']}\n\n{_table(table['rows']).text()}")
    write_text(out, json.dumps({"versions": versions(), "tables": tables}, indent=1) + "\n")
    print(f"results: {out}")


def all_answered(matched: Matched) -> Hits:
    """Whether the first answer is right, of each score alone and with the filter, balanced."""
    candidates = matched.candidates
    scorers = {
        f"{name} {weight}": replace(SCORERS[name], weight=WEIGHTS[weight]) for name in SCORERS for weight in WEIGHTS
    }
    scores = stages.score(scorers, matched.by_scale, candidates)
    found: Hits = {}
    for (name, _, weight), alone in ((key.partition(" "), values) for key, values in scores.items()):
        for system, values in {name: alone, f"{name} + filter": fuse_shortlist(candidates, alone, None)}.items():
            found.setdefault(system, {})[weight] = answered(matched, values, TOLERANCE)
    return found


def rows(places: Mapping[str, Hits]) -> Iterator[dict[str, Any]]:
    """By system and weight: recall of every data set and of all queries, and gains over the paper's weight."""
    for system in next(iter(places.values())):
        paper = "dmf" if system.startswith("sum") else "fs"
        for weight in WEIGHTS:
            found = [answers[system][weight] for answers in places.values()]
            before = [answers[system][paper] for answers in places.values()]
            joined = np.concatenate(before), np.concatenate(found)
            lost, gained, p_value = mcnemar(*joined)
            flips = block_sign_flips(*joined, sequences=[len(one) for one in found])
            recall = {place: float(np.mean(one)) for place, one in zip(places, found, strict=True)}
            yield {
                "system": system, "weight": weight, "recall": recall | {"all": float(np.mean(np.concatenate(found)))},
                "gained": gained, "lost": lost, "mcnemar": p_value, "sign_flips": flips._asdict(),
            }  # fmt: skip


def _table(rows: list[dict[str, Any]]) -> Table:
    lines = [
        [row["system"], row["weight"], *(f"{100 * one:.1f}" for one in row["recall"].values()),
         f"+{row['gained']} -{row['lost']}", f"{row['sign_flips']['p_value']:.2g}"]
        for row in rows
    ]  # fmt: skip
    header = [
        "system",
        "weight",
        *(f"{place}, R@1 ±{TOLERANCE}" for place in rows[0]["recall"]),
        "against the paper's",
        "p",
    ]
    return Table(header, lines, text_columns=2)
