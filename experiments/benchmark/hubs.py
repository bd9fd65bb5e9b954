"""Hubs: scores divided by what a database image scores with other places, on real images; choices on drawn ones."""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from experiments.benchmark.real import answered, datasets, extractors, kept, street
from mfvpr import AggregatedScore, AnchorPoints, HistogramOfShifts
from mfvpr.datasets import Dataset
from mfvpr.evaluation import match_sequence, mcnemar, stages
from mfvpr.evaluation.sequence_matching import match_cohort
from mfvpr.evaluation.statistics import block_sign_flips
from mfvpr.features import Aggregated, Extractor, VladFitting
from mfvpr.report import Table
from mfvpr.reranking import Matched
from mfvpr.reranking.cohort_normalization import by_hubness, hubness
from mfvpr.retrieval import Retrieval
from mfvpr.scoring.weights import FeatureScoreWeight, RatioWeight
from mfvpr.types import Shortlist
from mfvpr.utils.files import write_text
from mfvpr.utils.versions import versions

STREETS = (0, 1, 2)  # seeds
TOLERANCE = 2  # frames
CANDIDATES = {"all": None, "50": 50}
NEIGHBORS = 5  # frames on both sides
SCORERS = {
    "histogram fs": HistogramOfShifts(weight=FeatureScoreWeight()),
    "histogram ratio": HistogramOfShifts(weight=RatioWeight()),
    "anchor ratio": AnchorPoints(weight=RatioWeight()),
    "sum ratio": AggregatedScore(weight=RatioWeight()),
}


@dataclass(frozen=True)
class Scored:
    """Scores by name of a scorer, with all images as candidates: those of the queries, and of the map with itself."""

    queries: Matched
    database: Shortlist
    of_queries: Mapping[str, np.ndarray]
    of_database: Mapping[str, np.ndarray]


Way = Callable[[Scored, str], np.ndarray]  # what is made of a scorer's scores [Q, C] of the queries


def run(rounds: int | None, out: Path, data: Path | None = None) -> None:
    """Three streets, and both data sets below `data`; SIFT's and ALIKED n16's matches; nothing is timed."""
    real, streets = datasets(data), [replace(street(seed), name=f"streets {seed}") for seed in STREETS]
    chosen, tables = [], []
    for features, extractor in extractors().items():
        drawn = [scored(dataset, extractor) for dataset in streets]
        chosen += [{"features": features, **row} for row in choices(drawn)]
        places = {"streets": drawn} | {dataset.name: [scored(dataset, extractor)] for dataset in real}
        tables.append({"features": features, "rows": [*rows(places)]})
    print(f"\nstreets, the mean over scores\n\n{_choice_table(chosen).text()}")
    for table in tables:
        print(f"\n{table['features']}, R@1 ±{TOLERANCE}\n\n{_table(table['rows']).text()}")
    write_text(out, json.dumps({"versions": versions(), "streets": chosen, "tables": tables}, indent=1) + "\n")
    print(f"results: {out}")


def scored(dataset: Dataset, extractor: Extractor) -> Scored:
    """Queries with all database images, and these with each other; all that is asked for later is among them."""
    filter, archive = Retrieval(Aggregated(extractor, VladFitting())), kept()
    queries = match_sequence(dataset, dataset.only, extractor, filter, "all", archive=archive)
    database = match_cohort(dataset, 0, extractor, filter, "all", archive=archive)
    scores = (stages.score(SCORERS, matched.by_scale, matched.candidates) for matched in (queries, database))
    return Scored(queries, database.candidates, *scores)


def choices(streets: Sequence[Scored]) -> Iterator[dict[str, Any]]:
    """By what is made of scores: R@1 by candidates and tolerance, the mean over scorers and streets."""
    ways: dict[str, Way] = {"nothing": as_they_are}
    ways |= {
        f"hubs by the mean, {neighbors} frames, {listed}": partial(hubs_divided, most=most, neighbors=neighbors)
        for neighbors, (listed, most) in product((2, NEIGHBORS, 10, 20), CANDIDATES.items())
    }
    ways |= {f"all by the mean, {listed}": partial(all_divided, most=most) for listed, most in CANDIDATES.items()}
    ways |= {name: partial(by_statistic, statistic=statistic) for name, statistic in STATISTICS.items()}
    for way, of in ways.items():
        recall = {
            f"{listed}, ±{tolerance}": float(np.mean([
                answered(one.queries, of(one, name), tolerance, listed_first(one.queries.candidates, most))
                for one in streets for name in SCORERS
            ]))
            for (listed, most), tolerance in product(CANDIDATES.items(), (1, TOLERANCE))
        }  # fmt: skip
        yield {"divided": way, "recall": recall}


def rows(places: Mapping[str, Sequence[Scored]]) -> Iterator[dict[str, Any]]:
    """By score, candidates and way: recall of every place, and gains over undivided scores on the real ones."""
    for name, (listed, most) in product(SCORERS, CANDIDATES.items()):
        ways: dict[str, Way] = {
            "nothing": as_they_are,
            "hubs by database": partial(hubs_divided, most=most, neighbors=NEIGHBORS),
            "all by database": partial(all_divided, most=most),
            "all by queries": partial(divided_by_queries, most=most),  # what is promised, of all queries at once
        }
        right = {
            way: {
                place: [
                    answered(one.queries, of(one, name), TOLERANCE, listed_first(one.queries.candidates, most))
                    for one in some
                ]
                for place, some in places.items()
            }
            for way, of in ways.items()
        }
        for way, of_way in right.items():
            before, now = (
                [one[place][0] for place in places if place != "streets"] for one in (right["nothing"], of_way)
            )
            joined = np.concatenate(before), np.concatenate(now)
            lost, gained, p_value = mcnemar(*joined)
            flips = block_sign_flips(*joined, sequences=[len(one) for one in now])
            yield {
                "score": name, "candidates": listed, "divided": way,
                "recall": {place: float(np.mean(some)) for place, some in of_way.items()},
                "gained": gained, "lost": lost, "mcnemar": p_value, "sign_flips": flips._asdict(),
            }  # fmt: skip


def as_they_are(one: Scored, name: str) -> np.ndarray:
    """`[Q, C]`, as all that follow."""
    return one.of_queries[name]


def hubs_divided(one: Scored, name: str, most: int | None, neighbors: int) -> np.ndarray:
    """As the library does."""
    return by_hubness(one.queries.candidates, one.of_queries[name], _of_database(one, name, most, neighbors))


def all_divided(one: Scored, name: str, most: int | None) -> np.ndarray:
    """Those of images that score low as well, which grow."""
    return one.of_queries[name] / _of_database(one, name, most, NEIGHBORS)[one.queries.candidates.indices]


def divided_by_queries(one: Scored, name: str, most: int | None) -> np.ndarray:
    """By what each database image scores with the queries, right ones too: it knows all of them, but no label."""
    candidates, scores = one.queries.candidates, one.of_queries[name]
    known = replace(candidates, mask=listed_first(candidates, most))
    return scores / hubness(known, scores, len(one.database.mask))[candidates.indices]


# What else a cohort may tell of database images, of scores [M, N] that are NaN where there are none: what is taken away
# from scores, and what then divides them.
STATISTICS: dict[str, Callable[[np.ndarray], tuple[Any, Any]]] = {
    "all by the median": lambda scores: (0, np.nanmedian(scores, axis=0)),
    "all by the mean of the lower nine tenths": lambda scores: (0, _mean_between(scores, 0, 0.9)),
    "all by the mean of the highest fifth": lambda scores: (0, _mean_between(scores, 0.8, 1)),
    "the mean taken away": lambda scores: (np.nanmean(scores, axis=0), 1),
    "standardized": lambda scores: (np.nanmean(scores, axis=0), np.nanstd(scores, axis=0)),
}


def by_statistic(one: Scored, name: str, statistic: Callable[[np.ndarray], tuple[Any, Any]]) -> np.ndarray:
    """Of all images beyond the neighbors."""
    listed, candidates = listed_first(one.database, None, NEIGHBORS), one.queries.candidates
    matrix = np.full(listed.shape, np.nan)
    rows, places = np.nonzero(listed)
    matrix[rows, one.database.indices[listed]] = one.of_database[name][rows, places]
    less, by = (np.broadcast_to(part, len(matrix)) for part in statistic(matrix))
    return (one.of_queries[name] - less[candidates.indices]) / by[candidates.indices]


def _mean_between(scores: np.ndarray, low: float, high: float) -> np.ndarray:
    """`[N]` of the scores `[M, N]` between two quantiles of each column."""
    bounds = np.nanquantile(scores, [low, high], axis=0)
    return np.nanmean(np.where((scores >= bounds[0]) & (scores <= bounds[1]), scores, np.nan), axis=0)


def _of_database(one: Scored, name: str, most: int | None, neighbors: int) -> np.ndarray:
    """`hubness` `[N]` by so many candidates of each database image."""
    known = replace(one.database, mask=listed_first(one.database, most, neighbors))
    return hubness(known, one.of_database[name], len(known.mask))


def listed_first(candidates: Shortlist, most: int | None, neighbors: int = -1) -> np.ndarray:
    """`[Q, C]` bool, the best `most` candidates; of database images, of those beyond their neighbors."""
    far = np.abs(candidates.indices - np.arange(len(candidates.mask))[:, None]) > neighbors
    there = candidates.mask & far
    return there if most is None else there & (np.cumsum(there, axis=1) <= most)


def _choice_table(chosen: Sequence[Mapping[str, Any]]) -> Table:
    cells = [
        [row["features"], row["divided"], *(f"{100 * one:.1f}" for one in row["recall"].values())] for row in chosen
    ]
    return Table(["features", "divided", *chosen[0]["recall"]], cells, text_columns=2)


def _table(rows: Sequence[Mapping[str, Any]]) -> Table:
    cells = [
        [row["score"], row["candidates"], row["divided"], *(f"{100 * one:.1f}" for one in row["recall"].values()),
         f"+{row['gained']} -{row['lost']}", f"{row['sign_flips']['p_value']:.2g}"]
        for row in rows
    ]  # fmt: skip
    header = ["score", "candidates", "divided", *rows[0]["recall"], "real, against undivided", "p"]
    return Table(header, cells, text_columns=3)
