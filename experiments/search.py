"""The stages of a sweep: matches, all settings on all queries, the best, and what it is worth on other queries."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from experiments import build, console, prepare, run_folder, stores, sweep_outputs, truth
from experiments.axes import BYTES_PER_SETTING, Axes, axes, require_bins, require_memory, scorer
from mfvpr import sweeping
from mfvpr.evaluation import Judge
from mfvpr.pipeline import MatchSet
from mfvpr.report import runs
from mfvpr.stores.manifest import recipe_fingerprint
from mfvpr.types import Shortlist


def sweep(settings: dict[str, Any]) -> None:
    """Matches -> rows of every setting's ranking -> the best setting -> table, heat maps, files."""
    settings = _as_final(settings)
    with run_folder.claimed(settings) as folder:
        found, kept = _found(settings)
        run_folder.leave(
            folder, settings, truth.described(settings, found.images.dataset), text=sweep_outputs.text(found),
            write=lambda new: sweep_outputs.write(new, found), figures=sweep_outputs.figures(found),
        )  # fmt: skip
    if kept is not None:
        shutil.rmtree(kept, ignore_errors=True)


def _as_final(settings: dict[str, Any]) -> dict[str, Any]:
    """Where the score with the filter decides, every setting has it, with the c of the fusion if none is varied."""
    grid = settings["grid"]
    if settings["final"] == "score" or grid["c"] is not None or not any(grid.values()):
        return settings
    return settings | {"grid": grid | {"c": [settings["fusion"]["c"]]}}


def _found(settings: dict[str, Any]) -> tuple[sweep_outputs.Found, Path | None]:
    """What the sweep found, and where its blocks are kept until that is written."""
    varied = axes(settings)
    if settings["search"] == "grid":
        require_memory(f"grid: {varied.size:,} settings", varied.size * BYTES_PER_SETTING,
                       "use fewer values, or search=optuna")  # fmt: skip
    else:
        from experiments import optuna_search

        optuna_search.require()
    tools = prepare.extractors(settings)
    watch = prepare.Stopwatch()
    with watch("data"):
        images = prepare.images(settings)
    judgment = truth.judge(settings, images.dataset)
    matches, candidates = prepare.matched(settings, tools, images, watch)
    require_bins(settings, varied, matches)
    judgment = judgment.of(candidates)
    kept = _kept(settings, images, candidates)
    with watch("sweep"):
        written, rows = _search(settings, varied, judgment, matches, candidates, kept)
    return sweep_outputs.Found(settings, images, varied, judgment, written, rows, watch.seconds), kept


def _search(
    settings: dict[str, Any], varied: Axes, judgment: Judge, matches: MatchSet, candidates: Shortlist, kept: Path | None
) -> tuple[list[dict[str, Any]], np.ndarray]:
    """Settings as written, and the rows `[V, S, Q, depth]` of their rankings."""

    def rows_of(written: list[dict[str, Any]], label: str) -> np.ndarray:
        return sweeping.sweep(
            scorer(settings), list(map(varied.setting, written)), matches, candidates,
            views=judgment.views, depth=max(settings["recall"]["ks"]), ties=settings["ties"],
            filter_score=settings["fusion"]["filter_score"],
            settings_per_block=settings["chunk"]["settings"], queries_per_block=settings["chunk"]["queries"],
            folder=kept, track=console.track(label),
        )  # fmt: skip

    own = dict(varied.own)
    if settings["search"] == "grid":
        written = varied.grid()
        written += [] if own in written else [own]
        _require_memory(settings, judgment, matches, len(written))
        return written, rows_of(written, "sweep")
    from experiments import optuna_search

    return optuna_search.search(settings, varied, judgment, rows_of)


def _require_memory(settings: dict[str, Any], judgment: Judge, matches: MatchSet, num_settings: int) -> None:
    queries, num_candidates = matches.counts.shape
    depth = max(settings["recall"]["ks"])
    require_memory(
        f"grid: rankings of {queries:,} queries by {num_settings:,} settings",
        sweeping.result_bytes(len(judgment.views), num_settings, queries, depth),
        "use fewer values, smaller recall.ks, or search=optuna",
    )
    chunk = settings["chunk"]
    if chunk["settings"] or chunk["queries"]:
        lines, columns = min(chunk["settings"] or 64, num_settings), min(chunk["queries"] or 1, queries)
        require_memory(
            f"chunk: {lines:,} settings x {columns:,} queries",
            sweeping.block_bytes(matches, num_candidates, lines, columns),
            "use a smaller chunk.settings or chunk.queries, or leave them null",
        )


def _kept(settings: dict[str, Any], images: prepare.Images, candidates: Shortlist) -> Path | None:
    """Where an interrupted sweep goes on: its finished blocks on these matches, by this version."""
    if settings["store"] is None:
        return None
    recipe = stores.matches_recipe(settings, images.fingerprints, candidates.mask.shape[1])
    names = ("scorer", "grid", "search", "trials", "seed", "split", "recall", "ties", "fusion")
    own = {name: settings[name] for name in names}  # or another sweep that ends would take away what this one needs
    versions = {name: runs.versions()[name] for name in ("mfvpr", "jax", "numpy")}
    name = recipe_fingerprint({"matches": recipe, "sweep": own, "versions": versions})
    return build.expanded(settings["store"]) / f"{settings['dataset']['name']}_sweep-{name}"
