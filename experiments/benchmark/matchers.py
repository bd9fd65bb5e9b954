"""Matchers on real images, with the same features and shortlists: recall by every score, time per query."""

import json
import platform
import time
from dataclasses import replace
from operator import itemgetter
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.benchmark.real import SIZE, TOLERANCES, cell, datasets, judged, kept
from mfvpr import (
    HistogramOfShifts,
    Homography,
    LightGlueMatching,
    MatchCount,
    Matches,
    Matching,
    RatioWeight,
    Scorer,
    UnitWeight,
    value,
)
from mfvpr.checkpoints import load_model
from mfvpr.datasets import Dataset
from mfvpr.evaluation import match_sequence, stages
from mfvpr.features import Aggregated, AlikedFeatures, Extractor, FeatureSet, VladFitting
from mfvpr.matching import Matcher
from mfvpr.report import Table
from mfvpr.retrieval import Retrieval
from mfvpr.scoring.weight_registry import NAMED_WEIGHTS
from mfvpr.storage import Archive
from mfvpr.types import Shortlist
from mfvpr.utils.files import write_text
from mfvpr.utils.numerics import available_cpus
from mfvpr.utils.versions import versions

CANDIDATES, KEYPOINTS = 50, 512
NETWORK, LIGHTGLUE = "aliked-n16", "aliked_lightglue"


@value
class Unweighted:
    """A score of matches that all count the same, however sure."""

    scorer: Scorer

    def __call__(self, matches: Matches) -> Any:
        return self.scorer(replace(matches, confidence=None))


SCORERS: dict[str, dict[str, Scorer]] = {  # by matcher
    "mutual neighbors": {
        "count": MatchCount(),
        "homography": Homography(),
        "histogram, FS": HistogramOfShifts(),
        "histogram, 1 - ratio": HistogramOfShifts(weight=RatioWeight()),
        "histogram, learned": HistogramOfShifts(weight=NAMED_WEIGHTS["learned_aliked"]),  # on drawn streets
    },
    "LightGlue": {
        "count": Unweighted(MatchCount()),
        "sum of confidence": MatchCount(),
        "homography": Unweighted(Homography()),
        "histogram, confidence": HistogramOfShifts(weight=UnitWeight()),
    },
}


def run(rounds: int | None, out: Path, data: Path | None = None) -> None:
    """Both data sets below `data`; LightGlue takes an hour the first time, and its matches are kept."""
    extractor = AlikedFeatures(load_model(NETWORK), image_size=SIZE, max_keypoints=KEYPOINTS)  # pyright: ignore[reportArgumentType]
    lightglue = LightGlueMatching.of(load_model(LIGHTGLUE))  # pyright: ignore[reportArgumentType]
    matchers: dict[str, Matcher] = {"mutual neighbors": Matching(), "LightGlue": lightglue}
    filter, tables = Retrieval(Aggregated(extractor, VladFitting())), {}
    for dataset in datasets(data):
        archive, rows = kept(), []
        for name, matching in matchers.items():
            options = {"matching": matching, "archive": archive}
            matched = match_sequence(dataset, dataset.only, extractor, filter, CANDIDATES, **options)
            taken = _matching_time(dataset, extractor, matched.candidates, matching, archive, rounds or 3)
            scored = [*judged(matched, SCORERS[name], 1)]
            rows += [{"matcher": "", **scored[0]}] if not rows else []
            rows += [{"matcher": name, "matching_ms": taken, **row} for row in scored[1:]]
        tables[dataset.name] = rows
        print(f"\n{dataset.name}\n\n{_table(rows).text()}")
    setting = {"features": NETWORK, "keypoints": KEYPOINTS, "image_size": SIZE, "candidates": CANDIDATES}
    machine = {"cores": available_cpus(), "processor": platform.machine()}
    content = {"machine": machine, "versions": versions(), "setting": setting, "tables": tables}
    write_text(out, json.dumps(content, indent=1) + "\n")
    print(f"results: {out}")


def _matching_time(
    dataset: Dataset, extractor: Extractor, candidates: Shortlist, matching: Matcher, archive: Archive, rounds: int
) -> float:
    """Milliseconds that the matches of a query take, features being there: the median of `rounds` queries."""
    [queries], [database] = (archive.local(images, extractor) for images in (dataset.only.images, dataset.database))
    taken = []
    for row in np.linspace(0, len(queries) - 1, rounds).astype(int):
        one, listed = FeatureSet.of([queries[row]]), jax.tree.map(itemgetter(slice(row, row + 1)), candidates)
        for _ in range(2):  # the first compiles for this query's number of keypoints
            start = time.perf_counter()
            stages.match(one, database, listed, matching)
            seconds = time.perf_counter() - start
        taken.append(seconds)
    return 1e3 * float(np.median(taken))


def _table(rows: list[dict[str, Any]]) -> Table:
    lines = [
        [row["matcher"], row["score"], *map(cell, row["recall"].values()),
         f"{row['matching_ms']:.0f} + {row['ms_per_query']:.1f}" if row["matcher"] else ""] for row in rows
    ]  # fmt: skip
    return Table(["matcher", "score", *(f"R@1 ±{tolerance}" for tolerance in TOLERANCES), "ms/query"], lines,
                 text_columns=2)  # fmt: skip
