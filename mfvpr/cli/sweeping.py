"""Sweep: matches -> scores of all settings -> the best setting, and its recall on other queries."""

import shutil
from pathlib import Path
from typing import Any

from mfvpr.cli import console, run_folder, stages, truth
from mfvpr.cli.axes import require_memory, search_axes, with_final_axis
from mfvpr.report import runs, sweeps
from mfvpr.tuning import sweeps as sweeping
from mfvpr.tuning.sweeps import Outcome
from mfvpr.utils import Stopwatch
from mfvpr.utils.files import expand_user, write_text
from mfvpr.utils.fingerprints import fingerprint
from mfvpr.utils.versions import versions


def sweep(settings: dict[str, Any]) -> None:
    """Search the settings, print the table, fill the run folder."""
    settings = with_final_axis(settings)
    with run_folder.claim(settings) as folder:
        axes, watch = search_axes(settings), Stopwatch()
        tools, images = stages.prepare(settings, watch)
        protocol = truth.evaluation_protocol(settings, images.dataset)
        matches, candidates = stages.match_data_set(tools, images, watch)
        blocks = _block_folder(settings, tools, images)
        options = {
            "ks": settings["recall"]["ks"], "ties": settings["ties"],
            "retrieval_score": settings["fusion"]["retrieval_score"], "folder": blocks, "track": console.track,
            "devices": tools.cache.runtime.devices,
            "settings_per_block": settings["chunk"]["settings"], "queries_per_block": settings["chunk"]["queries"],
        }  # fmt: skip
        number = axes.size if settings["search"] == "grid" else settings["trials"]
        pairs = int(candidates.mask.sum())
        console.tell(f"sweep: {number:,} settings on {pairs:,} pairs of {len(candidates.mask):,} queries with their "
                     f"candidates, {number * pairs:,} scores; the time left stands beside the progress")  # fmt: skip
        with watch("sweep"):
            if settings["search"] == "grid":
                axes.check(matches.image_sizes)
                require_memory(settings, axes, 1 + len(protocol.halves), matches)
                outcome = sweeping.search_grid(axes, protocol, matches, candidates, **options)
            else:
                trials = {"trials": settings["trials"], "seed": settings["seed"]}
                outcome = sweeping.search_optuna(axes, protocol, matches, candidates, **trials, **options)
        heading = _heading(settings, images, outcome)
        text = f"{heading}\n\n{sweeps.sweep_summary(outcome)}"

        def write(new: Path) -> None:
            runs.write_table(new, sweeps.settings_table(outcome), heading)
            runs.write_json(new / "results.json", _results(settings, images, outcome, watch.seconds))
            write_text(new / "summary.txt", f"{text}\n")

        ground_truth, figures = truth.describe(settings, images.dataset), sweeps.heat_maps(outcome)
        run_folder.write_results(folder, settings, ground_truth, text=text, write=write, figures=figures)
    if blocks is not None:
        shutil.rmtree(blocks, ignore_errors=True)


def _block_folder(settings: dict[str, Any], tools: stages.Tools, images: stages.Images) -> Path | None:
    """The folder of finished blocks, from which an interrupted sweep goes on; None without a store."""
    if settings["cache"] is None:
        return None
    recipe = stages.recipe(tools, images)
    names = ("scorer", "grid", "search", "trials", "seed", "split", "recall", "ties", "fusion")
    sweep_settings = {name: settings[name] for name in names}  # or another sweep would remove the blocks when it ends
    software = {name: versions()[name] for name in ("mfvpr", "jax", "numpy")}
    name = fingerprint({"matches": recipe, "sweep": sweep_settings, "versions": software})
    return expand_user(settings["cache"]) / f"{settings['dataset']['name']}_sweep-{name}"


def _heading(settings: dict[str, Any], images: stages.Images, outcome: Outcome) -> str:
    dataset, features = images.dataset, settings["features"]
    ground_truth = truth.in_words(truth.describe(settings, dataset))
    size = " at {} x {} px".format(*features["image_size"]) if features["image_size"] else ""
    return (
        f"{dataset.name}: {len(dataset.queries)} queries, {outcome.protocol.views[0].shape[1]} candidates of "
        f"{len(dataset.database)} database images, {len(outcome.settings)} settings of the "
        f"{settings['scorer']['method']} score, {features['name']} features{size}; {ground_truth}"
    )


def _results(
    settings: dict[str, Any], images: stages.Images, outcome: Outcome, seconds: dict[str, float]
) -> dict[str, Any]:
    return {
        "dataset": images.dataset.name, "data_fingerprint": images.fingerprints, "reading": images.reading,
        "scorer": settings["scorer"], "features": settings["features"], "retrieval": settings["retrieval"],
        "matching": settings["matching"], "candidates": settings["candidates"], "fusion": settings["fusion"],
        "final": settings["final"], "ground_truth": truth.describe(settings, images.dataset),
        **sweeps.sweep_json(outcome), "seconds": seconds, "versions": versions(),
    }  # fmt: skip
