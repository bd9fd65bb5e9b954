"""The axes of a sweep from the settings `grid.`, and whether its results fit into memory."""

from typing import Any

from mfvpr.baselines import SCORERS
from mfvpr.core.parameters import parameters_of
from mfvpr.matchers import MatchSet, Scales
from mfvpr.matchers.match_set import block_bytes, scales
from mfvpr.systems import assembly
from mfvpr.tuning.sweeps import Axes
from mfvpr.tuning.sweeps.setting_rankings import SETTINGS_PER_BLOCK
from mfvpr.tuning.sweeps.setting_search import require_optuna
from mfvpr.tuning.sweeps.sweep_axes import can_learn
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import free_host_bytes

_BYTES_PER_SETTING = 2000  # Python objects, about


def with_final_axis(settings: dict[str, Any]) -> dict[str, Any]:
    """The settings with grid.c = [fusion.c] if the combined score decides and no c is varied."""
    grid = settings["grid"]
    if settings["final"] == "score" or grid["c"] is not None or not any(grid.values()):
        return settings
    return settings | {"grid": grid | {"c": [_plain_c(settings)]}}


def axes(settings: dict[str, Any]) -> Axes:
    """The axes of the chosen scorer, checked."""
    if "method" not in settings["scorer"]:
        raise InputError("scorer: a sweep takes one scorer at a time; choose with scorer=histogram, or several "
                            "with -m scorer=sum,anchor,histogram")  # fmt: skip
    if isinstance(weights := settings["scorer"].get("weight"), list):
        listed = ",".join(weights)
        raise InputError(f"scorer.weight=[{listed}]: expected one weight; to compare weights, set "
                            f"grid.weight=[{listed}]")  # fmt: skip
    if isinstance(methods := settings.get("sequence"), list):
        raise InputError(f"sequence=[{','.join(methods)}]: a sweep takes one at a time; sweep them with -m "
                            f"sequence={','.join(methods)}")  # fmt: skip
    [scorer] = assembly.scorers(settings["scorer"]).values()
    values = {name: axis for name, axis in settings["grid"].items() if axis is not None}
    known = [name for name in settings["grid"] if name in {*parameters_of(scorer), "max_distance", "c"}]
    if unknown := [name for name in values if name not in known]:
        raise InputError(f"grid.{unknown[0]}: scorer={settings['scorer']['method']} has no such parameter; it has "
                            f"{', '.join(known)}")  # fmt: skip
    if not values:
        raise InputError("grid: expected at least one axis, such as 'grid.sigma=[10,22.5]', or an experiment=; see "
                            "--help")  # fmt: skip
    limit = settings["matching"].get("max_distance")
    if limit is not None and any(value is None or value > limit for value in values.get("max_distance", [])):
        raise InputError(
            f"grid.max_distance={values['max_distance']}: expected values up to {limit}, as "
            f"matching.max_distance={limit} leaves no other matches; set matching.max_distance=null"
        )
    defaults = settings["scorer"] | {"max_distance": limit}
    if "c" in values:
        defaults |= {"c": _plain_c(settings) if settings["final"] == "combined" else 0}
    try:
        return Axes(scorer, values, defaults)
    except InputError as error:
        is_axis = str(error).partition("=")[0].partition(":")[0] in values
        raise InputError(f"grid.{error}" if is_axis else str(error)) from error


def search_axes(settings: dict[str, Any]) -> Axes:
    """The axes of a sweep, if they can be searched here."""
    grid_axes = axes(settings)
    if settings["search"] == "grid":
        _require_bytes(f"grid: {grid_axes.size:,} settings", grid_axes.size * _BYTES_PER_SETTING,
                       "use fewer values, or search=optuna")  # fmt: skip
    else:
        try:
            require_optuna()
        except InputError as error:
            raise InputError(f"search=optuna: {error}, or search=grid") from error
    return grid_axes


def learning_axes(settings: dict[str, Any]) -> Axes:
    """The axes that learning searches for comparison, if the scorer can be learned."""
    method = settings["scorer"].get("method")
    known = [name for name, scorer in SCORERS.items() if can_learn(scorer)]
    if method not in known:
        setting = f"scorer={method}" if method else "scorer"
        raise InputError(f"{setting}: expected one to learn, of {', '.join(known)}")
    grid_axes = axes(settings)
    if settings["split"] is None:
        raise InputError("split=null: what is learned is never reported on the same queries; expected first_half, "
                            "second_half or both")  # fmt: skip
    return grid_axes


def retrieval_weight(settings: dict[str, Any]) -> float | None:
    """The weight of the retrieval score, None = balanced."""
    c = _plain_c(settings)
    return None if c == "auto" else float(c)


def _plain_c(settings: dict[str, Any]) -> Any:
    """The setting fusion.c, which must not fuse several scores here."""
    if (c := settings["fusion"]["c"]) == "zscore":
        raise InputError(
            "fusion.c=zscore: expected a number or auto, as sweeps and learning add retrieval to one score; set "
            "fusion.c=auto fusion.weights=null, which ranks alike for weights of 1"
        )
    return c


def require_memory(settings: dict[str, Any], grid_axes: Axes, views: int, matches: MatchSet | Scales) -> None:
    """Raise a InputError before a sweep whose results, or one chunk, do not fit into memory."""
    queries = len(scales(matches)[0])
    num_settings = grid_axes.size + (dict(grid_axes.own) not in grid_axes.grid())
    _require_bytes(
        f"grid: rankings of {queries:,} queries by {num_settings:,} settings",
        4 * views * num_settings * queries * max(settings["recall"]["ks"]),
        "use fewer values, smaller recall.ks, or search=optuna",
    )
    chunk = settings["chunk"]
    if chunk["settings"] or chunk["queries"]:
        lines = min(chunk["settings"] or SETTINGS_PER_BLOCK, num_settings)
        columns = min(chunk["queries"] or 1, queries)
        _require_bytes(
            f"chunk: {lines:,} settings x {columns:,} queries",
            block_bytes(matches, lines, columns),
            "use a smaller chunk.settings or chunk.queries, or leave them null",
        )


def _require_bytes(purpose: str, needed: int, remedy: str) -> None:
    free = free_host_bytes()
    if needed > 0.8 * free:
        raise InputError(
            f"{purpose} would take about {needed / 1e6:,.0f} MB of memory, {free / 1e6:,.0f} MB are free; {remedy}"
        )
