"""Sweep: matches -> scores of all settings -> the best setting, and its recall on other queries."""

from dataclasses import replace
from typing import Any

from mfvpr.cli import run_folder
from mfvpr.cli.inputs import Inputs, prepare, truth_in_words, with_image_size
from mfvpr.cli.schema import Learn, Sweep
from mfvpr.core.scorer import parameters_of
from mfvpr.datasets.contents import fingerprints, readings
from mfvpr.evaluation.drives import DriveFilter
from mfvpr.report import sweeps
from mfvpr.report.run_files import matched_content
from mfvpr.systems import assembly
from mfvpr.tuning import sweeps as sweeping
from mfvpr.tuning.sweeps import Axes, DriveRanking, Outcome, SweepOptions
from mfvpr.tuning.sweeps.setting_rankings import forget_rankings
from mfvpr.tuning.sweeps.setting_search import require_optuna
from mfvpr.utils import Stopwatch
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import to_values
from mfvpr.utils.files import expand_user
from mfvpr.utils.versions import versions

_MOST_SETTINGS = 1_000_000


def sweep(settings: Sweep) -> None:
    """Search the settings, print the table, fill the run folder."""
    settings = with_image_size(settings)
    if settings.final == "combined" and settings.grid["c"] is None and any(settings.grid.values()):
        settings = replace(settings, grid={**settings.grid, "c": [_c(settings)]})  # the combined score is swept
    with run_folder.claim(settings.out, settings.dataset["name"]) as folder:
        axes, watch = axes_of(settings), Stopwatch()
        if settings.search == "optuna":
            require_optuna()
        elif axes.size > _MOST_SETTINGS:
            raise InputError(f"grid: expected at most {_MOST_SETTINGS:,} settings, got {axes.size:,}")
        inputs = prepare(settings, watch)
        protocol = inputs.protocol(settings.split)
        matches, candidates = inputs.match(watch)
        folder_of_rows = expand_user(settings.cache) if settings.cache else None
        method = settings.sequence
        options = SweepOptions(
            settings.recall.ks,
            settings.ties,
            settings.fusion.retrieval_score,
            method and DriveRanking.of(DriveFilter(method), inputs.dataset, protocol),
            settings.chunk.settings,
            settings.chunk.queries,
            folder_of_rows,
            inputs.cache.runtime,
        )
        with watch("sweep"):
            if settings.search == "grid":
                axes.check(matches.image_sizes)
                outcome = sweeping.search_grid(axes, protocol, matches, candidates, options)
            else:
                trials = {"trials": settings.trials, "seed": settings.seed}
                outcome = sweeping.search_optuna(axes, protocol, matches, candidates, options, **trials)
        heading = _heading(settings, inputs, outcome)
        results = _results(settings, inputs, outcome, watch.seconds)
        run_folder.write_results(
            folder,
            settings,
            inputs.ground_truth,
            text=sweeps.sweep_summary(outcome, heading),
            write=lambda new: sweeps.write_sweep(new, outcome, heading, results),
            figures=sweeps.sweep_figures(outcome),
        )
        forget_rankings(axes.scorer, options)


def axes_of(settings: Sweep | Learn) -> Axes:
    """The axes of the chosen scorer from the settings `grid.`, checked."""
    chosen, values = settings.scorer, {name: axis for name, axis in settings.grid.items() if axis is not None}
    if "method" not in chosen:
        raise InputError("scorer: a sweep takes one scorer at a time; choose with scorer=histogram, or several with "
                         "-m scorer=sum,anchor,histogram")  # fmt: skip
    if isinstance(chosen.get("weight"), list):
        raise InputError("scorer.weight: expected one weight, got a list; to compare weights, set grid.weight")
    if not values:
        raise InputError("grid: expected at least one axis, such as 'grid.sigma=[10,22.5]', or an experiment=; see "
                         "--help")  # fmt: skip
    [scorer] = assembly.scorers(chosen).values()
    known = [name for name in settings.grid if name in {*parameters_of(scorer), "max_distance", "c"}]
    if unknown := [name for name in values if name not in known]:
        raise InputError(f"grid.{unknown[0]}: scorer={chosen['method']} has no such parameter; it has "
                         f"{', '.join(known)}")  # fmt: skip
    limit = settings.matching.get("max_distance")
    if limit is not None and any(value is None or value > limit for value in values.get("max_distance", [])):
        raise InputError(
            f"grid.max_distance={values['max_distance']}: expected values up to {limit}, as "
            f"matching.max_distance={limit} leaves no other matches; set matching.max_distance=null"
        )
    defaults = {**chosen, "max_distance": limit}
    if "c" in values:
        defaults |= {"c": _c(settings) if settings.final == "combined" else 0}
    with assembly.in_group("grid", values):
        return Axes(scorer, values, defaults)


def _c(settings: Sweep | Learn) -> Any:
    """The setting fusion.c, which must not fuse several scores here."""
    if settings.fusion.c == "zscore":
        raise InputError("fusion.c=zscore: expected a number or auto, as sweeps and learning add retrieval to one "
                         "score; fusion.c=auto ranks alike for weights of 1")  # fmt: skip
    return settings.fusion.c


def retrieval_weight(settings: Learn) -> float | None:
    """The weight of the retrieval score, None = balanced."""
    return None if _c(settings) == "auto" else float(_c(settings))


def _heading(settings: Sweep, inputs: Inputs, outcome: Outcome) -> str:
    dataset, size = inputs.dataset, settings.features["image_size"]
    content = matched_content({"matching": settings.matching, "features": settings.features})
    content += " at {} x {} px".format(*size) if size and content.endswith("features") else ""
    sequence = f" + {settings.sequence} sequence" if settings.sequence else ""
    return (
        f"{dataset.name}: {len(dataset.queries)} queries, {outcome.protocol.views[0].shape[1]} candidates of "
        f"{len(dataset.database)} database images, {len(outcome.settings)} settings of the "
        f"{settings.scorer['method']} score{sequence}, {content}; {truth_in_words(inputs.ground_truth)}"
    )


def _results(settings: Sweep, inputs: Inputs, outcome: Outcome, seconds: dict[str, float]) -> dict[str, Any]:
    names = ("scorer", "features", "retrieval", "matching", "candidates", "fusion", "final", "sequence")
    values = to_values(settings)
    return {
        "dataset": inputs.dataset.name,
        "data_fingerprint": fingerprints(inputs.contents),
        "reading": readings(inputs.contents),
        **{name: values[name] for name in names},
        "ground_truth": inputs.ground_truth,
        **sweeps.sweep_json(outcome),
        "seconds": seconds,
        "versions": versions(),
    }
