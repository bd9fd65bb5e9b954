"""Sweep: matches -> scores of all settings -> the best setting, and its recall on other queries."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from mfvpr.cli import jobs
from mfvpr.cli.jobs import prepare, score_in_words, truth_in_words
from mfvpr.cli.schema import Searched
from mfvpr.cli.schema import Sweep as Settings
from mfvpr.core import Scorer
from mfvpr.datasets import Dataset
from mfvpr.evaluation import Pipeline, System, evaluation_protocol, match_sequence
from mfvpr.evaluation.drives import DriveFilter
from mfvpr.evaluation.protocol import Split
from mfvpr.evaluation.rankings import RETRIEVAL
from mfvpr.features import Aggregated, Sift, VladFitting
from mfvpr.report import searches
from mfvpr.report.runs import LAST
from mfvpr.report.searches import Sweep, as_json
from mfvpr.retrieval import Retrieval
from mfvpr.storage import FeatureCache
from mfvpr.systems import assembly
from mfvpr.systems.assembly import choices_of
from mfvpr.tuning.sweeps import Axes, DriveRanking, SweepOptions, require_optuna, search_grid, search_optuna
from mfvpr.utils import InputError, Runtime, Stopwatch
from mfvpr.utils.fields import NOT_NEGATIVE, check_values, list_of, to_values
from mfvpr.utils.fields import Setting as Declared
from mfvpr.utils.files import expand_user
from mfvpr.utils.fingerprints import versions


def sweep_program(settings: Settings) -> None:
    """Search the settings, print the table, fill the run folder."""
    if settings.final == "combined" and settings.grid.get("c") is None and any(settings.grid.values()):
        settings = replace(settings, grid={**settings.grid, "c": [settings.fusion.c]})  # the combined score is swept
    with jobs.claim(settings.out, settings.dataset["name"]) as folder:
        axes, watch = axes_of(settings), Stopwatch()
        if settings.search == "optuna":
            require_optuna()
        elif axes.size > 1_000_000:
            raise InputError(f"grid: expected at most 1,000,000 settings, got {axes.size:,}")
        inputs = prepare(settings, watch)
        settings, protocol = inputs.settings, inputs.protocol(settings.split)
        matches, candidates = inputs.match()
        options = SweepOptions(
            ks=settings.recall.ks,
            ties=settings.ties,
            retrieval_score=settings.fusion.retrieval_score,
            sequence=settings.sequence and DriveRanking.of(DriveFilter(settings.sequence), inputs.dataset, protocol),
            settings_per_block=settings.chunk.settings,
            queries_per_block=settings.chunk.queries,
            folder=expand_user(settings.cache) if settings.cache else None,
            runtime=inputs.cache.runtime,
        )
        with watch("sweep"):
            if settings.search == "grid":
                outcome = search_grid(axes, protocol, matches, candidates, options)
            else:
                trials = {"trials": settings.trials, "seed": settings.seed}
                outcome = search_optuna(axes, protocol, matches, candidates, options, **trials)
        sequence = f", {settings.sequence} sequence" if settings.sequence else ""
        heading = (
            f"{inputs.dataset.name}: {len(inputs.dataset.queries)} queries, {outcome.protocol.views[0].shape[1]} "
            f"candidates of {len(inputs.dataset.database)} database images, {len(outcome.settings)} settings of the "
            f"{score_in_words(settings)}{sequence}; {truth_in_words(inputs.ground_truth)}"
        )
        values = to_values(settings)
        names = ("scorer", "features", "retrieval", "matching", "candidates", "fusion", "final", "sequence")
        about = {**inputs.about, **{name: values[name] for name in names}}
        about |= {"seconds": watch.seconds, "versions": versions()}
        jobs.write_results(
            folder,
            settings,
            inputs.ground_truth,
            text=searches.sweep_summary(outcome, heading),
            write=lambda new: searches.write_sweep(new, outcome, heading, about),
            figures=searches.sweep_figures(outcome),
        )
        outcome.forget_rankings(matches, candidates, options)


def axes_of(settings: Searched) -> Axes:
    """The axes of the chosen scorer from the settings `grid.`, checked."""
    chosen, values = settings.scorer, {name: axis for name, axis in settings.grid.items() if axis is not None}
    if "method" not in chosen:
        raise InputError("scorer: a sweep takes one scorer at a time; choose one, or several with -m scorer=sum,anchor")
    if isinstance(chosen.get("weight"), list):
        raise InputError("scorer.weight: expected one weight, got a list; to compare weights, set grid.weight")
    if settings.fusion.c == "zscore":
        raise InputError("fusion.c=zscore: expected a number, or auto, which ranks alike for weights of 1")
    if not values:
        raise InputError("grid: expected at least one axis, such as 'grid.sigma=[10,22.5]', or an experiment=")
    [scorer] = assembly.scorers(chosen).values()
    matching, limit = choices_of("matching")["neighbors"], settings.matching.get("max_distance")
    known = {name: each for name, each in choices_of("scorer")[chosen["method"]].items() if each.swept}
    known |= {"max_distance": matching["max_distance"], "c": Declared(None, NOT_NEGATIVE | "auto")}
    check_values({name: replace(each, rule=list_of(each.rule)) for name, each in known.items()}, values, "grid.")
    if limit is not None and any(value is None or value > limit for value in values.get("max_distance", [])):
        raise InputError(f"grid.max_distance={values['max_distance']}: expected values up to matching.max_distance")
    defaults = {**chosen, "max_distance": limit, "c": settings.fusion.c if settings.final == "combined" else 0}
    with assembly.in_group("grid", values):
        return Axes(scorer, values, defaults)


def sweep(
    dataset: Dataset,
    system: System | Scorer,
    /,
    *,
    split: Split | None = None,
    thresholds: Sequence[float] | None = None,
    out: Path | str | None = None,
    cache: FeatureCache | None = None,
    runtime: Runtime | None = None,
    **axes: Sequence[Any],
) -> Sweep:
    """Rank with every combination of parameter values, and choose the best.

        sweep = mfvpr.sweep(data, MyScorer(), sigma=[5, 10, 22.5], weight=["fs", "ratio"], split="both", out="runs/s")
        sweep.best, sweep.interval, sweep.plot("sigma", "weight")
        print(sweep.table())

    Args:
        dataset: one query sequence with ground truth.
        system: its only scorer is swept, and fused with the retrieval if the system ranks by that. If it has a sequence
            of this ranking, the sequence ranks. Or a scorer, for the features and matches of `mfvpr sweep` (SIFT, VLAD,
            50 candidates).
        split: half of the path to choose on ("first_half", "second_half"), or "both" in turn; the result is reported
            on the other half. None = choose and report on all queries.
        thresholds: largest distances of a correct prediction, in the unit of the ground truth. The middle one decides.
            None = 1, 2 and 5 frames, or 25 m.
        out: folder of the result, also of the rankings by finished settings: the same call continues a sweep.
        cache: where features and matches are kept; None = in memory.
        runtime: devices, memory, progress and messages; None = those of the cache.
        axes: lists of values by parameter: fields of the scorer (words stand for weights, `inner.sigma` is passed as
            `**{"inner.sigma": [...]}`), `max_distance` of matches, and `c` of the fusion with the retrieval.

    Raises:
        InputError: an axis that the scorer does not have, no ground truth, a folder of something else, or images that
            cannot be used.
    """
    if not isinstance(system, System):
        sift, scorer = Sift(), system
        pipeline = Pipeline(sift, Retrieval(Aggregated(sift, VladFitting())))
        system = System(pipeline, {getattr(scorer, "__name__", type(scorer).__name__): scorer})
    name, scorer, c = _only_scorer(system)
    if not axes:
        raise InputError("sweep: expected at least one axis, such as sigma=[5, 10, 22.5]")
    swept = Axes(scorer, axes if c is None else {"c": [c], **axes}, {} if c is None else {"c": c})
    sequence = dataset.only
    if sequence.truth is None:
        raise InputError(f"{dataset.name}: expected a ground truth to choose by, got none")
    if thresholds is None:
        thresholds = sequence.truth.thresholds()
    protocol, cache = evaluation_protocol(sequence.truth, thresholds, split), cache or FeatureCache()
    filters = system.sequences.get(system.headline, ())
    if len(filters) > 1:
        raise InputError(f"sequences: expected at most one of {system.headline}, got {len(filters)}; sweep each")
    options = SweepOptions(
        ties=system.ties,
        retrieval_score=system.fused[name].retrieval_score if name in system.fused else "cosine",
        sequence=DriveRanking.of(filters[0], dataset, protocol) if filters else None,
        folder=None if out is None else _ranking_folder(Path(out), swept),
        runtime=runtime or cache.runtime,
    )
    matched = match_sequence(dataset, sequence, system.pipeline, cache=cache, runtime=options.runtime)
    result = Sweep(dataset.name, name, search_grid(swept, protocol, matched.by_scale, matched.candidates, options))
    if out is not None:
        result.save(out)
    return result


def _only_scorer(system: System) -> tuple[str, Scorer, float | str | None]:
    """Name and value of the scorer, and the c of its fusion with the retrieval; None if the score alone ranks."""
    if len(system.scorers) == 1:
        [(name, scorer)] = system.scorers.items()
        if system.headline == name:
            return name, scorer, None
        fusion = system.fused.get(name)
        if system.headline == f"{name} + {RETRIEVAL}" and fusion and not fusion.weights:
            return name, scorer, fusion.c if isinstance(fusion.c, float | int) else "auto"
    expected = f"one that ranks by its only scorer, alone or + {RETRIEVAL}"
    raise InputError(f"system: expected {expected}, got {', '.join(system.scorers)} ranked by {system.headline}")


def _ranking_folder(out: Path, axes: Axes) -> Path:
    """The folder of the rankings by finished settings, in a new or empty folder or in one of this sweep."""
    rankings, results = out / "rankings", out / LAST
    if not rankings.is_dir() and out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"out={out}: expected a new or empty folder, or one of a sweep; name another")
    if results.exists() and json.loads(results.read_text("utf-8"))["axes"] != as_json(axes.values):
        raise InputError(f"out={out}: has the result of a sweep of other axes; name another folder")
    rankings.mkdir(parents=True, exist_ok=True)
    return rankings
