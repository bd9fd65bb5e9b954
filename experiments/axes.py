"""The settings `grid.`: which parameters of which scorer are varied, and whether that fits into memory."""

from typing import Any

from experiments import build
from experiments.settings import SettingsError
from mfvpr.matching import MatchSet, Scales
from mfvpr.matching.match_set import block_bytes, scales
from mfvpr.scoring import SCORERS
from mfvpr.scoring.fields import declared
from mfvpr.tuning import sweeps
from mfvpr.tuning.learning.parameters import can_learn
from mfvpr.tuning.sweeps import Axes
from mfvpr.tuning.sweeps.search import require_optuna
from mfvpr.tuning.sweeps.sweep import SETTINGS_PER_BLOCK
from mfvpr.utils import InputError
from mfvpr.utils.numerics import free_host_bytes

OF_MATCHES = ("max_distance", "c")  # what is no parameter of a scorer
BYTES_PER_SETTING = 2000  # of Python's own, about
_MB = 1e6


def as_final(settings: dict[str, Any]) -> dict[str, Any]:
    """Where the score with the filter decides, every setting has it, with the c of the fusion if none is varied."""
    grid = settings["grid"]
    if settings["final"] == "score" or grid["c"] is not None or not any(grid.values()):
        return settings
    return settings | {"grid": grid | {"c": [_plain_c(settings)]}}


def axes(settings: dict[str, Any]) -> Axes:
    """The checked axes of one scorer."""
    if "method" not in settings["scorer"]:
        raise SettingsError("scorer: a sweep takes one scorer at a time; choose with scorer=histogram, or several "
                            "with -m scorer=sum,anchor,histogram")  # fmt: skip
    [(method, scorer)] = build.scorers(settings["scorer"]).items()
    known = {*declared(scorer), *OF_MATCHES}
    values = {name: axis for name, axis in settings["grid"].items() if axis is not None}
    for name, axis in values.items():
        if name not in known:
            raise SettingsError(f"grid.{name}: scorer={method} has no such parameter; it has "
                                f"{', '.join(n for n in settings['grid'] if n in known)}")  # fmt: skip
        if len(set(axis)) < len(axis):
            raise SettingsError(f"grid.{name}={axis}: expected different values")
    if not values:
        raise SettingsError("grid: expected at least one axis, such as 'grid.sigma=[10,22.5]', or an experiment=; see "
                            "--help")  # fmt: skip
    limit = settings["matching"].get("max_distance")
    if limit is not None and any(value is None or value > limit for value in values.get("max_distance", [])):
        raise SettingsError(
            f"grid.max_distance={values['max_distance']}: expected values up to {limit}, as "
            f"matching.max_distance={limit} leaves no other matches; set matching.max_distance=null"
        )
    defaults = settings["scorer"] | {"max_distance": limit}
    defaults |= {"c": _plain_c(settings) if settings["final"] == "combined" else 0} if "c" in values else {}
    return Axes(scorer, values, {name: defaults.get(name) for name in values})


def searchable(settings: dict[str, Any]) -> Axes:
    """The axes of a sweep, if they can be searched."""
    varied = axes(settings)
    if settings["search"] == "grid":
        needed = varied.size * BYTES_PER_SETTING
        _require(f"grid: {varied.size:,} settings", needed, "use fewer values, or search=optuna")
        return varied
    try:
        require_optuna()
    except InputError as error:
        raise SettingsError(f"search=optuna: {error}, or search=grid") from error
    return varied


def learnable(settings: dict[str, Any]) -> Axes:
    """What the grid-searched rows vary, of a scorer that can be learned."""
    method = settings["scorer"].get("method")
    known = [name for name, scorer in SCORERS.items() if can_learn(scorer)]
    if method not in known:
        what = f"scorer={method}" if method else "scorer"
        raise SettingsError(f"{what}: expected one to learn, of {', '.join(known)}")
    varied = axes(settings)
    if settings["split"] is None:
        raise SettingsError("split=null: what is learned is never reported on the same queries; expected first_half, "
                            "second_half or both")  # fmt: skip
    return varied


def own_c(settings: dict[str, Any]) -> float | None:
    """The filter's weight by hand, None = balanced."""
    c = _plain_c(settings)
    return None if c == "auto" else float(c)


def _plain_c(settings: dict[str, Any]) -> Any:
    """The same as it is written; a sum of several scores is for evaluations."""
    if (c := settings["fusion"]["c"]) == "zscore":
        raise SettingsError(
            "fusion.c=zscore: expected a number or auto, as sweeps and learning add the filter to one score; set "
            "fusion.c=auto fusion.weights=null, which ranks alike for weights of 1"
        )
    return c


def require_memory(settings: dict[str, Any], varied: Axes, views: int, matches: MatchSet | Scales) -> None:
    """Refuse results, or a chunk, that would not fit, before they are begun."""
    queries = len(scales(matches)[0])
    num_settings = varied.size + (dict(varied.own) not in varied.grid())
    _require(
        f"grid: rankings of {queries:,} queries by {num_settings:,} settings",
        sweeps.result_bytes(views, num_settings, queries, max(settings["recall"]["ks"])),
        "use fewer values, smaller recall.ks, or search=optuna",
    )
    chunk = settings["chunk"]
    if chunk["settings"] or chunk["queries"]:
        lines = min(chunk["settings"] or SETTINGS_PER_BLOCK, num_settings)
        columns = min(chunk["queries"] or 1, queries)
        _require(
            f"chunk: {lines:,} settings x {columns:,} queries",
            block_bytes(matches, lines, columns),
            "use a smaller chunk.settings or chunk.queries, or leave them null",
        )


def _require(what: str, needed: int, mend: str) -> None:
    """Refuse what would not fit, before it is begun."""
    free = free_host_bytes()
    if needed > 0.8 * free:
        raise SettingsError(
            f"{what} would take about {needed / _MB:,.0f} MB of memory, {free / _MB:,.0f} MB are free; {mend}"
        )
