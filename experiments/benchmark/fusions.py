"""Scores fused with the filter's in every way on the same matches: recall, and how much each may lose."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.benchmark.real import answered, extractors, matched_sets
from mfvpr import AnchorPoints, HistogramOfShifts
from mfvpr.evaluation import stages
from mfvpr.report import Table
from mfvpr.reranking import Fusion, Matched
from mfvpr.reranking.ranking import rank_shortlist
from mfvpr.reranking.results import FILTER
from mfvpr.scoring.weights import WEIGHTS
from mfvpr.types import Shortlist
from mfvpr.utils.files import write_text
from mfvpr.utils.versions import versions

CANDIDATES = 50
TOLERANCE = 2  # frames
SHARES = (0.25, 0.5, 1.0, 2.0)  # of the filter, in a sum of standardized scores; 1 ranks as c=auto does
RANKS = 60  # Cormack et al., SIGIR 2009
ALONE = "alone"
SCORERS = {
    f"{name} {weight}": replace(scorer, weight=WEIGHTS[weight])
    for name, scorer in (("histogram", HistogramOfShifts()), ("anchor", AnchorPoints()))
    for weight in ("fs", "ratio")
}
FUSED = [*((name,) for name in SCORERS), ("histogram fs", "anchor fs"), ("histogram ratio", "anchor ratio")]
System = tuple[str, str]  # the scores that take part, and how they are fused


def run(rounds: int | None, out: Path, data: Path | None = None) -> None:
    """Streets and both data sets below `data`, SIFT's and ALIKED n16's matches; nothing is timed."""
    places = {name: recall_by_system(matched) for name, matched in
              matched_sets(data, CANDIDATES, extractors(), streets=True)}  # fmt: skip
    rows = [*judged(places)]
    print(f"\n{_table(rows).text()}\n")
    write_text(out, json.dumps({"versions": versions(), "rows": rows}, indent=1) + "\n")
    print(f"results: {out}")


def recall_by_system(matched: Matched) -> dict[System, float]:
    """R@1 of the filter, of every score alone, and of the fusions."""
    scores = stages.score(SCORERS, matched.by_scale, matched.candidates)
    return {
        system: float(np.mean(answered(matched, values, TOLERANCE)))
        for system, values in fused(matched.candidates, scores)
    }


def fused(candidates: Shortlist, scores: Mapping[str, np.ndarray]) -> Iterator[tuple[System, np.ndarray]]:
    """Every system's scores `[Q, C]`, from those of every scorer by name."""
    yield (FILTER, ALONE), candidates.scores
    yield from (((name, ALONE), values) for name, values in scores.items())
    for main, *others in FUSED:
        members = " + ".join([main, *others])
        for share in SHARES:
            how = Fusion("zscore", weights={FILTER: share, **dict.fromkeys(others, 1.0)})
            yield (members, f"z, filter {share:g}"), how(main, candidates, scores)
        if not others:
            c = np.std(scores[main][candidates.mask]) / np.std(candidates.scores[candidates.mask])
            yield (members, "constant c"), Fusion(float(c))(main, candidates, scores)
        parts = [candidates.scores, *(scores[name] for name in (main, *others))]
        yield (members, "reciprocal ranks"), reciprocal_ranks(candidates, parts)


def reciprocal_ranks(candidates: Shortlist, parts: Sequence[np.ndarray]) -> np.ndarray:
    """Sum `[Q, C]` of 1 / (60 + rank), ranks from 1 by each of several scores `[Q, C]`."""
    ranks = [1 + np.argsort(rank_shortlist(candidates, part), axis=1) for part in parts]
    return np.sum([1 / (RANKS + rank) for rank in ranks], axis=0)


def judged(places: Mapping[str, Mapping[System, float]]) -> Iterator[dict[str, Any]]:
    """By system: recall in every place, its mean, and how far it is from the better of filter and scores at worst."""
    for system in next(iter(places.values())):
        members, how = system
        alone = [(name, ALONE) for name in (FILTER, *members.split(" + "))]
        recall = {place: recalls[system] for place, recalls in places.items()}
        gains = [recalls[system] - max(recalls[one] for one in alone) for recalls in places.values()]
        mean = float(np.mean([*recall.values()]))
        yield {"scores": members, "fusion": how, "recall": recall, "mean": mean, "worst": min(gains)}


def _table(rows: Sequence[dict[str, Any]]) -> Table:
    lines = [
        [row["scores"], row["fusion"], *(f"{100 * one:.1f}" for one in (*row["recall"].values(), row["mean"])),
         "" if row["scores"] == FILTER else f"{100 * row['worst']:+.1f}"]
        for row in rows
    ]  # fmt: skip
    return Table(["scores", "with the filter", *rows[0]["recall"], "mean", "worst"], lines, text_columns=2)
