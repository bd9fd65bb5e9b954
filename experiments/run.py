"""The main job, stage by stage."""

from pathlib import Path
from typing import Any

import numpy as np

from experiments import build, outputs, prepare
from experiments.outputs import Outcome, System
from mfvpr import pipeline
from mfvpr.pipeline import MatchSet
from mfvpr.report import runs
from mfvpr.types import Shortlist


def evaluate(settings: dict[str, Any]) -> None:
    """Images -> features -> shortlist and matches -> scores -> rankings -> recall, in a run folder."""
    folder = build.expanded(settings["out"]) if settings["out"] else None
    runs.check_free(folder or runs.new_run_folder(Path("runs"), settings["dataset"]["name"]))
    scorers = build.scorers(settings["scorer"])
    tools = prepare.extractors(settings)
    watch = prepare.Stopwatch()
    with watch("data"):
        images = prepare.images(settings)
    made = prepare.extracted(settings, tools, images, watch)
    with watch("matching"):
        matches = prepare.match(settings, made)
    with watch("scores"):
        systems = _systems(settings, scorers, matches, made.candidates)

    outcome = Outcome(
        settings, images.dataset, made.extractor, made.database, made.queries, made.candidates, matches, scorers,
        systems, watch.seconds, images.fingerprints, images.reading,
    )  # fmt: skip
    folder = folder or runs.claimed_run_folder(Path("runs"), images.dataset.name)
    with runs.writing(folder) as new:
        table = outputs.write(new, outcome)
    shown = f"{table.text()}\n" if outcome.thresholds else ""
    print(f"\n{outputs.heading(outcome)}\n\n{shown}results: {folder}")


def _systems(settings: dict[str, Any], scorers: dict, matches: MatchSet, candidates: Shortlist) -> dict[str, System]:
    """The filter alone, each scorer, and the best of them (the paper: histogram) combined with the filter."""
    scores = pipeline.score(scorers, matches, candidates, track=build.track("scores"))
    group = settings["scorer"]
    parameters = {name: group if "method" in group else group[name] for name in scorers}
    combined = "histogram" if "histogram" in scorers else next(iter(scorers))
    c, filter_score = settings["fusion"]["c"], settings["fusion"]["filter_score"]
    found = {"filter": ("none", {}, candidates.scores)}
    found |= {name: (name, parameters[name], scores[name]) for name in scorers}
    fused = pipeline.fuse(candidates, scores[combined], None if c == "auto" else c, filter_score=filter_score)
    found[f"{combined} + filter"] = (combined, parameters[combined] | settings["fusion"], fused)
    return {name: _system(candidates, settings["ties"], *values) for name, values in found.items()}


def _system(candidates: Shortlist, ties: Any, scorer: str, parameters: dict[str, Any], scores: np.ndarray) -> System:
    order = pipeline.rank(candidates, scores, ties=ties)
    return System(
        scorer=scorer,
        parameters=parameters,
        rows=np.take_along_axis(candidates.indices, order, axis=1),
        scores=np.take_along_axis(scores, order, axis=1),
    )
