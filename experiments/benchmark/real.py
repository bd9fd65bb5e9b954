"""Recall of every score on the same matches of real images, with intervals, and time per query."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import OmegaConf

from experiments.benchmark.harness import duration, write_report
from experiments.paper.systems import REAL
from mfvpr import datasets
from mfvpr.checkpoints import load_model
from mfvpr.cli import build
from mfvpr.cli.console import tell, track
from mfvpr.cli.overrides import compose_program
from mfvpr.evaluation import Pipeline, estimate, hits, match_sequence, stages
from mfvpr.features import Aggregated, AlikedFeatures, Extractor, Sift, VladFitting
from mfvpr.report import Table
from mfvpr.reranking import Matched
from mfvpr.reranking.ranking import rank_shortlist
from mfvpr.reranking.results import RETRIEVAL
from mfvpr.retrieval import Retrieval
from mfvpr.scoring import Scorer
from mfvpr.storage import FeatureCache
from mfvpr.utils import InputError, Runtime

SIZE = (336, 336)
TOLERANCES = (1, 2, 5)  # frames


def run(rounds: int | None, out: Path, data: Path | None = None) -> None:
    """Score SIFT's and ALIKED n16's matches with all images of both data sets below `data`."""
    if data is None:
        raise InputError(f"--data: expected a folder that has {' and '.join(REAL)}, got none")
    folder = build.expand_user(os.environ.get("MFVPR_CACHE") or "~/.cache/mfvpr")  # as in conf/common.yaml
    cache, scorers = FeatureCache(folder / "features", runtime=Runtime(progress=track, log=tell)), compared_scorers()
    parts, tables = [], []
    for name, folders in REAL.items():
        dataset = datasets.folder(*(data / name / folder for folder in folders), name=name, ground_truth="order")
        for features, extractor in extractors().items():
            retrieval = Retrieval(Aggregated(extractor, VladFitting()))
            pipeline = Pipeline(extractor, retrieval, candidates="all")
            matched = match_sequence(dataset, dataset.only, pipeline, cache=cache)
            rows = [measure(matched, score, scorers, rounds or 1) for score in (RETRIEVAL, *scorers)]
            tables.append({"matches": f"{name}, {features}", "rows": rows})
            parts += [f"{name}, {features}, {np.mean(matched.matches[0].counts):.0f} matches a pair", _table(rows)]
    write_report(out, "all images are candidates", parts, {"tables": tables})


def compared_scorers() -> dict[str, Scorer]:
    """The scorers of `scorer=compared`, by name."""
    settings: Any = OmegaConf.to_container(compose_program("config", ["scorer=compared"]).scorer)
    return build.scorers(settings)


def extractors() -> dict[str, Extractor]:
    """SIFT and ALIKED n16."""
    network: Any = load_model("aliked-n16")
    return {"SIFT": Sift(image_size=SIZE), "ALIKED n16": AlikedFeatures(network, image_size=SIZE)}


def measure(matched: Matched, score: str, scorers: Mapping[str, Scorer], rounds: int) -> dict[str, Any]:
    """Recall of a score with its interval at every tolerance, and milliseconds per query; None for retrieval's."""
    candidates, truth = matched.candidates, matched.sequence.truth
    assert truth is not None  # the ground truth is the order
    scores, milliseconds = candidates.scores, None
    if score != RETRIEVAL:
        scorer = {score: scorers[score]}
        [scores] = stages.score(scorer, matched.by_scale, candidates).values()
        seconds = [duration(lambda: stages.score(scorer, matched.by_scale, candidates)) for _ in range(rounds)]
        milliseconds = 1e3 * float(np.median(seconds)) / len(scores)
    rows = np.take_along_axis(candidates.indices, rank_shortlist(candidates, scores), axis=1)
    recall = {tolerance: estimate(hits(rows, truth.positives(tolerance)))._asdict() for tolerance in TOLERANCES}
    return {"score": score, "ms_per_query": milliseconds, "recall": recall}


def _table(rows: list[dict[str, Any]]) -> Table:
    lines = []
    for row in rows:
        recalls = [(100 * recall["recall"], *(100 * bound for bound in recall["interval"]))
                   for recall in row["recall"].values()]  # fmt: skip
        milliseconds = row["ms_per_query"]
        lines.append([row["score"], *("{:.1f} [{:.0f}, {:.0f}]".format(*recall) for recall in recalls),
                      "" if milliseconds is None else f"{milliseconds:.1f}"])  # fmt: skip
    return Table(["score", *(f"R@1 ±{tolerance}" for tolerance in TOLERANCES), "ms/query"], lines)
