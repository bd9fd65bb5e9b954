"""Every score on the same matches of real images: recall with its interval, and what it takes per query."""

import json
import os
import platform
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml

from experiments import build
from experiments import stages as program_stages
from experiments.console import tell, track
from experiments.groups import defaults
from experiments.settings import CONF
from mfvpr.checkpoints import load_model
from mfvpr.datasets import Dataset, folder_dataset
from mfvpr.evaluation import estimate, hits, match_sequence, stages
from mfvpr.features import Aggregated, AlikedFeatures, Extractor, Sift, VladFitting
from mfvpr.matching import Matcher
from mfvpr.matching.matcher import NEIGHBORS
from mfvpr.report import Table
from mfvpr.reranking import Matched
from mfvpr.reranking.ranking import rank_shortlist
from mfvpr.reranking.results import FILTER
from mfvpr.retrieval import Retrieval
from mfvpr.scoring import Scorer
from mfvpr.storage import Archive
from mfvpr.utils import InputError
from mfvpr.utils.files import write_text
from mfvpr.utils.numerics import available_cpus
from mfvpr.utils.versions import versions

FOLDERS = {"grief_season": ("database", "queries"), "corridor": ("ref", "query")}
SIZE = (336, 336)
TOLERANCES = (1, 2, 5)  # frames


def run(rounds: int | None, out: Path, data: Path | None = None) -> None:
    """Both data sets below `data`, SIFT's and ALIKED n16's matches with all images; `rounds` calls are timed."""
    scorers, tables = compared(), []
    for name, matched in matched_sets(data, "all", extractors()):
        rows = [*judged(matched, scorers, rounds or 1)]
        tables.append({"matches": name, "rows": rows})
        print(f"\n{name}, {np.mean(matched.matches[0].counts):.0f} matches a pair\n\n{_table(rows).text()}")
    machine = {"cores": available_cpus(), "processor": platform.machine()}
    write_text(out, json.dumps({"machine": machine, "versions": versions(), "tables": tables}, indent=1) + "\n")
    print(f"results: {out}")


def matched_sets(
    data: Path | None, candidates: int | Literal["all"], extractors: Mapping[str, Extractor], *,
    matching: Matcher = NEIGHBORS, streets: bool = False,
) -> Iterator[tuple[str, Matched]]:  # fmt: skip
    """("data set, features", its matches) of both data sets below `data`, and of the drawn street where it is asked
    for; features and matches are kept."""
    archive = kept()
    for dataset in datasets(data, streets=streets):
        for features, extractor in extractors.items():
            filter = Retrieval(Aggregated(extractor, VladFitting()))
            options = {"matching": matching, "archive": archive}
            matched = match_sequence(dataset, dataset.only, extractor, filter, candidates, **options)
            yield f"{dataset.name}, {features}", matched


def datasets(data: Path | None, *, streets: bool = False) -> list[Dataset]:
    """Both below `data`, and the drawn street where it is asked for."""
    if data is None:
        raise InputError(f"expected --data DIR, a folder that has {' and '.join(FOLDERS)}")
    found = [
        folder_dataset(data / name / database, data / name / queries, name=name, ground_truth="order")
        for name, (database, queries) in FOLDERS.items()
    ]
    return [*found, street(0)] if streets else found


def street(seed: int) -> Dataset:
    """A drawn one, which is drawn once."""
    return program_stages.dataset_of({"name": "streets", "cache": str(_cache()), "seed": seed})


def kept() -> Archive:
    """Where programs keep features and matches."""
    return Archive(_cache() / "features", track=track, tell=tell)


def _cache() -> Path:
    return build.expanded(os.environ.get("MFVPR_CACHE") or "~/.cache/mfvpr")  # as in conf/common.yaml


def compared() -> dict[str, Scorer]:
    """The scorers of `scorer=compared`, by name."""
    group = CONF / "scorer"
    names = [entry.partition("@")[2] for entry in defaults(group / "compared.yaml")]
    return build.scorers({name: yaml.safe_load((group / f"{name}.yaml").read_text(encoding="utf-8")) for name in names})


def extractors(size: tuple[int, int] = SIZE, variants: Sequence[str] = ("n16",)) -> dict[str, Extractor]:
    """SIFT, and variants of ALIKED, of images of one size."""
    networks: dict[str, Any] = {f"ALIKED {variant}": load_model(f"aliked-{variant}") for variant in variants}
    aliked = {name: AlikedFeatures(network, image_size=size) for name, network in networks.items()}
    return {"SIFT": Sift(image_size=size), **aliked}


def judged(matched: Matched, scorers: Mapping[str, Scorer], rounds: int) -> Iterator[dict[str, Any]]:
    """By score: recall and its interval at every tolerance, and milliseconds per query."""
    candidates = matched.candidates
    for name in (FILTER, *scorers):
        scores, taken = candidates.scores, []
        for _ in range(1 + rounds if name in scorers else 0):
            start = time.perf_counter()
            [scores] = stages.score({name: scorers[name]}, matched.by_scale, candidates).values()
            taken.append((time.perf_counter() - start) / len(scores))
        found = {tolerance: estimate(answered(matched, scores, tolerance)) for tolerance in TOLERANCES}
        yield {
            "score": name, "ms_per_query": 1e3 * float(np.median(taken[1:])) if taken else None,  # the first compiles
            "recall": {tolerance: one._asdict() for tolerance, one in found.items()},
        }  # fmt: skip


def answered(matched: Matched, scores: np.ndarray, tolerance: float, there: np.ndarray | None = None) -> np.ndarray:
    """`[Q]` bool, whether the first answer by scores `[Q, C]` is right; of the candidates that are `there`, or all."""
    candidates, truth = matched.candidates, matched.sequence.truth
    assert truth is not None  # of data sets whose order it is
    candidates = candidates if there is None else replace(candidates, mask=candidates.mask & there)
    rows = np.take_along_axis(candidates.indices, rank_shortlist(candidates, scores), axis=1)
    return hits(rows, truth.positives(tolerance))


def cell(one: Mapping[str, Any]) -> str:
    """A recall and its interval, %."""
    low, high = one["interval"]
    return f"{100 * one['recall']:.1f} [{100 * low:.0f}, {100 * high:.0f}]"


def _table(rows: list[dict[str, Any]]) -> Table:
    return Table(
        ["score", *(f"R@1 ±{tolerance}" for tolerance in TOLERANCES), "ms/query"],
        [[row["score"], *map(cell, row["recall"].values()),
          "" if row["ms_per_query"] is None else f"{row['ms_per_query']:.1f}"] for row in rows],
    )  # fmt: skip
