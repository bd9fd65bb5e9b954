"""The main job, stage by stage."""

from typing import Any

import numpy as np

from experiments import build, console, outputs, prepare, run_folder, truth
from experiments.outputs import Outcome, System
from mfvpr import pipeline, reranking
from mfvpr.pipeline import MatchSet
from mfvpr.types import Shortlist


def evaluate(settings: dict[str, Any]) -> None:
    """Images -> features -> shortlist and matches -> scores -> rankings -> recall, in a run folder."""
    with run_folder.claimed(settings) as folder:
        outcome = _outcome(settings)
        run_folder.leave(
            folder, settings, truth.described(settings, outcome.dataset), text=outputs.text(outcome),
            write=lambda new: outputs.write(new, outcome), figures=outputs.figures(outcome),
        )  # fmt: skip


def _outcome(settings: dict[str, Any]) -> Outcome:
    scorers = build.scorers(settings["scorer"])
    tools = prepare.extractors(settings)
    watch = prepare.Stopwatch()
    with watch("data"):
        images = prepare.images(settings)
    shown = outputs.asked_figures(settings["figures"], images.dataset)
    made = prepare.extracted(settings, tools, images, watch)
    with watch("matching"):
        matches = prepare.match(settings, made)
    with watch("scores"):
        systems = _systems(settings, scorers, matches, made.candidates)
    return Outcome(
        settings, images.dataset, made.extractor, made.database, made.queries, made.candidates, matches, scorers,
        systems, watch.seconds, images.fingerprints, images.reading, shown,
    )  # fmt: skip


def _systems(settings: dict[str, Any], scorers: dict, matches: MatchSet, candidates: Shortlist) -> dict[str, System]:
    """The filter alone, each scorer, and the best of them (the paper: histogram) combined with the filter."""
    scores = pipeline.score(scorers, matches, candidates, track=console.track("scores"))
    group = settings["scorer"]
    parameters = {name: group if "method" in group else group[name] for name in scorers}
    combined = "histogram" if "histogram" in scorers else next(iter(scorers))
    c, filter_score = settings["fusion"]["c"], settings["fusion"]["filter_score"]
    found = {"filter": ("none", {}, candidates.scores)}
    found |= {name: (name, parameters[name], scores[name]) for name in scorers}
    fused = reranking.fuse_shortlist(
        candidates, scores[combined], None if c == "auto" else c, filter_score=filter_score
    )
    found[f"{combined} + filter"] = (combined, parameters[combined] | settings["fusion"], fused)
    return {name: _system(candidates, settings["ties"], *values) for name, values in found.items()}


def _system(candidates: Shortlist, ties: Any, scorer: str, parameters: dict[str, Any], scores: np.ndarray) -> System:
    order = reranking.rank_shortlist(candidates, scores, ties=ties)
    return System(
        scorer=scorer,
        parameters=parameters,
        rows=np.take_along_axis(candidates.indices, order, axis=1),
        scores=np.take_along_axis(scores, order, axis=1),
    )
