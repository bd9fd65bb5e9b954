"""Sweep: matches -> scores of all settings -> the best setting, and its recall on other queries."""

from typing import Any

from mfvpr.cli import run_folder, truth
from mfvpr.cli.axes import require_memory, search_axes, with_final_axis
from mfvpr.cli.inputs import Inputs, prepare, with_image_size
from mfvpr.datasets.contents import fingerprints, readings
from mfvpr.evaluation.sequences import DriveFilter
from mfvpr.report import sweeps
from mfvpr.report.run_files import matched_content
from mfvpr.tuning import sweeps as sweeping
from mfvpr.tuning.sweeps import DriveRanking, Outcome, SweepOptions
from mfvpr.utils import Stopwatch
from mfvpr.utils.files import expand_user
from mfvpr.utils.versions import versions


def sweep(settings: dict[str, Any]) -> None:
    """Search the settings, print the table, fill the run folder."""
    settings = with_image_size(with_final_axis(settings))
    with run_folder.claim(settings["out"], settings["dataset"]["name"]) as folder:
        axes, watch = search_axes(settings), Stopwatch()
        inputs = prepare(settings, watch)
        protocol = inputs.protocol(settings["split"])
        matches, candidates = inputs.match(watch)
        folder_of_rows = settings["cache"] and expand_user(settings["cache"])
        options = SweepOptions(
            settings["recall"]["ks"], settings["ties"], settings["fusion"]["retrieval_score"],
            settings["sequence"] and DriveRanking.of(DriveFilter(settings["sequence"]), inputs.dataset, protocol),
            settings["chunk"]["settings"], settings["chunk"]["queries"], folder_of_rows, inputs.cache.runtime,
        )  # fmt: skip
        with watch("sweep"):
            if settings["search"] == "grid":
                axes.check(matches.image_sizes)
                require_memory(settings, axes, 1 + len(protocol.halves), matches)
                outcome = sweeping.search_grid(axes, protocol, matches, candidates, options)
            else:
                trials = {"trials": settings["trials"], "seed": settings["seed"]}
                outcome = sweeping.search_optuna(axes, protocol, matches, candidates, options, **trials)
        heading = _heading(settings, inputs, outcome)
        results = _results(settings, inputs, outcome, watch.seconds)
        run_folder.write_results(
            folder, settings, inputs.ground_truth, text=sweeps.sweep_summary(outcome, heading),
            write=lambda new: sweeps.write_sweep(new, outcome, heading, results), figures=sweeps.sweep_figures(outcome),
        )  # fmt: skip


def _heading(settings: dict[str, Any], inputs: Inputs, outcome: Outcome) -> str:
    dataset, ground_truth = inputs.dataset, truth.in_words(inputs.ground_truth)
    content, size = matched_content(settings), settings["features"]["image_size"]
    content += " at {} x {} px".format(*size) if size and content.endswith("features") else ""
    sequence = f" + {settings['sequence']} sequence" if settings["sequence"] else ""
    return (
        f"{dataset.name}: {len(dataset.queries)} queries, {outcome.protocol.views[0].shape[1]} candidates of "
        f"{len(dataset.database)} database images, {len(outcome.settings)} settings of the "
        f"{settings['scorer']['method']} score{sequence}, {content}; {ground_truth}"
    )


def _results(settings: dict[str, Any], inputs: Inputs, outcome: Outcome, seconds: dict[str, float]) -> dict[str, Any]:
    return {
        "dataset": inputs.dataset.name, "data_fingerprint": fingerprints(inputs.contents),
        "reading": readings(inputs.contents), "scorer": settings["scorer"], "features": settings["features"],
        "retrieval": settings["retrieval"], "matching": settings["matching"], "candidates": settings["candidates"],
        "fusion": settings["fusion"], "final": settings["final"], "sequence": settings["sequence"],
        "ground_truth": inputs.ground_truth,
        **sweeps.sweep_json(outcome), "seconds": seconds, "versions": versions(),
    }  # fmt: skip
