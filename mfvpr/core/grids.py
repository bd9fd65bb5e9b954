"""Scores of the candidates of one query for grids of parameters: `lax.map` around `vmap`."""

import difflib
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import is_dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, Num

from mfvpr.baselines.weight_registry import named_weight
from mfvpr.core.histogram import HistogramOfShifts
from mfvpr.core.nearest_neighbors import filter_matches
from mfvpr.core.parameters import numbers_by_name, parameters_of, whole_numbers, with_capacity, with_parameters
from mfvpr.core.ranking import BIN_STEP, check_candidates, fit_to_sizes
from mfvpr.core.scorer import check_host, on_host, require_real, score_pairs, with_static_functions
from mfvpr.core.types import Array, Matches
from mfvpr.core.weights import ChosenWeight, Weight, match_weights
from mfvpr.utils.numerics import (
    available_cpus,
    compiled,
    device_of,
    holds_function,
    is_concrete,
    knows_own_context,
)

WEIGHTINGS = ("weight", "max_distance")  # axes that only change how much a match counts


def score_grid(scorer: Any, matches: Matches, **axes: Sequence[Any] | Array) -> Float[jax.Array, "*grid candidates"]:
    """Scores of every combination of parameter values, `[len(axis1), ..., C]`, from matches `[C, K, ...]`.

        scorer = mfvpr.HistogramOfShifts()
        mfvpr.score_grid(scorer, candidate_matches, sigma=[10.0, 22.5], weight=["ratio", "fs"])  # [sigma, weight, C]

    Each capacity of bins is one traced computation, so that fine bins do not slow coarse bins down. Other values within
    the same capacities cost no compilation, other lengths do. With a plain function, every call compiles. An axis that
    is empty, not one-dimensional, or names no numeric parameter of the scorer raises a `ValueError`.

    The `axes` are values of the scorer's numbers; of numbers of its parts, `**{"inner.sigma": [10., 22.5]}`; of
    `max_distance`, beyond which matches do not count; and of `weight`, by name or a value such as `UnitWeight()`.
    """
    if not axes:
        raise ValueError("score_grid: expected at least one axis, such as sigma=[10.0, 22.5]")
    check_candidates(matches)
    refuse_own_names(scorer, axes)
    check_host(scorer)
    weights = _weights(scorer, axes)
    if weights:
        scorer, axes["weight"] = replace(scorer, weight=ChosenWeight(weights, 0)), np.arange(len(weights))
    plain, scorer = holds_function(scorer), with_static_functions(scorer)
    values = {name: _axis(scorer, name, axis) for name, axis in axes.items()}
    inner = [name for name in values if name in WEIGHTINGS]
    outer = [name for name in values if name not in WEIGHTINGS]
    settings, weightings = _product(values, outer), _product(values, inner)
    rows = int(np.prod([len(values[name]) for name in outer]))
    groups = fit_to_sizes(partial(by_capacity, scorer, settings, rows), matches)
    on_cpu = device_of(matches).platform == "cpu"

    def score(matches: Matches) -> list[Array]:
        # On a CPU one after the other, because programs that run at the same time would share the cache.
        scores = (
            score_settings(fitted, matches, {name: axis[part] for name, axis in settings.items()}, weightings)
            for fitted, part in groups
        )
        return [jax.block_until_ready(group_scores) if on_cpu else group_scores for group_scores in scores]

    # A plain function may close over traced values, which only the thread that traces them can use.
    use_threads = is_concrete((scorer, matches, values)) and not plain
    scores = _on_every_core(score, matches) if use_threads else score(matches)
    # On a CPU, single operations of JAX would wait for its queue; elsewhere NumPy would wait for the device.
    xp: Any = np if on_cpu and is_concrete(scores) else jnp
    order = np.argsort(np.concatenate([part for _, part in groups]))
    names = outer + inner
    scores = xp.concatenate(scores)[order].reshape(*(len(values[name]) for name in names), -1)
    return jnp.asarray(xp.moveaxis(scores, range(len(names)), [list(axes).index(name) for name in names]))


def refuse_own_names(scorer: Any, names: Iterable[str], reserved: Iterable[str] = WEIGHTINGS) -> None:
    """Raise a ValueError if a number of the scorer has the name of an axis with another meaning."""
    for name in {*names} & {*numbers_by_name(scorer)} & {*reserved}:
        raise ValueError(f"{type(scorer).__name__}.{name}: a grid means something else by {name}; rename the field")


def by_capacity(
    scorer: Any,
    settings: Mapping[str, Num[Array, " settings"]],
    num_settings: int,
    image_size0: Num[Array, "*pairs0 2"],
    image_size1: Num[Array, "*pairs1 2"],
) -> list[tuple[Any, Int[np.ndarray, " _"]]]:
    """Group settings by the capacity of bins that they need: (scorer, rows of settings); one group if traced."""
    if not is_concrete(settings):
        first = with_parameters(scorer, {name: values[0] for name, values in settings.items()})
        return [(with_capacity(first, image_size0, image_size1, multiple=BIN_STEP), np.arange(num_settings))]
    settings = jax.tree.map(np.asarray, settings)
    groups: dict[Any, tuple[Any, list[int]]] = {}
    for row in range(num_settings):
        varied = with_parameters(scorer, {name: values[row] for name, values in settings.items()})
        fitted = with_capacity(varied, image_size0, image_size1, multiple=BIN_STEP)
        groups.setdefault(jax.tree.structure(fitted), (fitted, []))[1].append(row)
    return [(fitted, np.array(rows)) for fitted, rows in groups.values()]


def score_settings(
    scorer: Any,
    matches: Matches,
    settings: Mapping[str, Num[Array, " settings"]],
    weightings: Mapping[str, Num[Array, " weightings"]],
) -> Num[Array, "_ _ ..."]:
    """Scores `[G, W, C]` of matches `[C, K, ...]` for every combination of G settings and W weightings.

    Settings are scored one after the other, because all at once would leave the cache, and in one traced computation,
    so that other values cost no compilation; those of a histogram on an accelerator at once, as many as fit `CHUNK`.
    A histogram needs a capacity that suffices for every `bin_size`.
    Weightings: `max_distance`, and `weight` (index of the scorer's `ChosenWeight`). Without any, G or W is 1.
    """
    if on_host(scorer):
        scores = _on_host(scorer, matches, settings, weightings)
    else:
        scores = _in_jax(scorer, matches, settings, weightings, on_cpu=device_of(matches).platform == "cpu")
    require_real("scorer", scores)
    return scores


def _on_host(
    scorer: Any, matches: Matches, settings: Mapping[str, Array], weightings: Mapping[str, Array]
) -> np.ndarray:
    def rows(values: Mapping[str, Array]) -> list[dict[str, Any]]:
        columns = [np.asarray(axis) for axis in values.values()]
        return [dict(zip(values, row, strict=True)) for row in zip(*columns, strict=True)] if columns else [{}]

    def score(setting: dict[str, Any], weighting: dict[str, Any]) -> np.ndarray:
        return score_pairs(*_apply_weighting(with_parameters(scorer, setting), matches, weighting))

    return np.array([[score(setting, weighting) for weighting in rows(weightings)] for setting in rows(settings)])


@partial(compiled, static_argnames="on_cpu")
def _in_jax(
    scorer: Any, matches: Matches, settings: Mapping[str, Array], weightings: Mapping[str, Array], *, on_cpu: bool
) -> Array:
    # The Gaussians of a histogram are the same for all weightings. A subclass may score in another way.
    is_histogram = isinstance(scorer, HistogramOfShifts) and type(scorer).__call__ is HistogramOfShifts.__call__
    weights = jax.vmap(partial(_weights_of_pair, scorer, weightings))(matches) if is_histogram else None

    def score_setting(setting: dict[str, Array]) -> Array:
        varied = with_parameters(scorer, setting)
        if weights is not None:
            return varied.batch_scores_by_weights(matches, weights).T
        return jax.vmap(partial(_score_weightings, varied, weightings), out_axes=-1)(matches)

    if on_cpu or weights is None or not settings:
        return _map(score_setting, settings)
    fitting = max(1, scorer.pairs_at_once(matches, weights.shape[1]) // max(1, len(weights)))
    num_settings = len(next(iter(settings.values())))
    together = max(size for size in range(1, min(fitting, num_settings) + 1) if num_settings % size == 0)
    return jax.lax.map(score_setting, dict(settings), batch_size=together)


def _apply_weighting(scorer: Any, matches: Matches, weighting: Mapping[str, Array]) -> tuple[Any, Matches]:
    near = filter_matches(matches, max_distance=weighting.get("max_distance"))
    if "weight" not in weighting:
        return scorer, near
    return replace(scorer, weight=replace(scorer.weight, index=weighting["weight"])), near


def _weights_of_pair(
    scorer: Any, weightings: Mapping[str, Array], matches: Matches
) -> Float[jax.Array, "weightings slots"]:

    def weigh(weighting: dict[str, Array]) -> Array:
        varied, near = _apply_weighting(scorer, matches, weighting)
        return match_weights(varied.weight, near)

    return jax.vmap(weigh)(dict(weightings)) if weightings else weigh({})[None]


def _score_weightings(scorer: Any, weightings: Mapping[str, Array], matches: Matches) -> Array:

    def score_weighting(weighting: dict[str, Array]) -> Array:
        varied, near = _apply_weighting(scorer, matches, weighting)
        return varied(near)

    return _map(score_weighting, weightings)


def _map(function: Callable[[dict[str, Array]], Array], values: Mapping[str, Array]) -> Array:
    """`function` of every row of `values`, one at a time; once if there are no values."""
    return jax.lax.map(function, dict(values)) if values else function({})[None]


def _on_every_core(function: Callable[[Matches], Any], matches: Matches) -> Any:
    """`function` of matches `[C, K, ...]`, with candidates as the last axis of its results, split over the cores.

    There is a single call for few candidates, on accelerators, and with settings of JAX that threads do not inherit.
    """
    cores, count = available_cpus(), len(matches.mask)
    if cores == 1 or count < 4 * cores or device_of(matches).platform != "cpu" or not knows_own_context():
        return function(matches)
    size = -(-count // cores)
    starts = [min(core * size, count - size) for core in range(cores)]  # one size, one program; parts may overlap
    host = jax.tree.map(np.asarray, matches)

    def score_part(start: int) -> Any:
        return jax.tree.map(np.asarray, function(jax.tree.map(lambda leaf: leaf[start : start + size], host)))

    with ThreadPoolExecutor(cores) as pool:
        parts = list(pool.map(score_part, starts))
    overlaps = [core * size - start for core, start in enumerate(starts)]

    def join(*leaves: np.ndarray) -> np.ndarray:
        return np.concatenate([leaf[..., skip:] for leaf, skip in zip(leaves, overlaps, strict=True)], axis=-1)

    return jax.tree.map(join, *parts)


def _product(values: Mapping[str, Array], names: Sequence[str]) -> dict[str, Array]:
    """Every combination of the values of the named axes: `[G]` by axis."""
    xp = np if is_concrete(dict(values)) else jnp
    points = xp.meshgrid(*(values[name] for name in names), indexing="ij")
    return {name: point.reshape(-1) for name, point in zip(names, points, strict=True)}


def _weights(scorer: Any, axes: Mapping[str, Any]) -> tuple[Weight, ...]:
    if "weight" not in axes or not hasattr(scorer, "weight"):
        return ()
    weights = tuple(map(named_weight, axes["weight"]))
    if not all(map(callable, weights)):
        raise ValueError(f"grid axis weight: expected weights such as 'ratio' or UnitWeight(), got {list(weights)}")
    return weights


def _axis(scorer: Any, name: str, axis: Sequence[float] | Array) -> Array:
    """One checked axis of a grid, float `[n]`."""
    values = numbers_by_name(scorer)
    numeric = [*values, *(["weight"] if hasattr(scorer, "weight") else []), "max_distance"]
    if name not in numeric:
        nearest = difflib.get_close_matches(name, numeric, n=1) or numeric
        raise ValueError(
            f"{type(scorer).__name__} has no numeric parameter {name!r}; expected one of {', '.join(numeric)} "
            f"(nearest: {nearest[0]})"
        )
    points = np.asarray(axis) if is_concrete(axis) else jnp.asarray(axis)  # on the host, which takes them apart
    if not (jnp.issubdtype(points.dtype, jnp.integer) and (name == "weight" or name in whole_numbers(scorer))):
        points = points.astype(jnp.result_type(float))
    if points.ndim != 1 or points.size == 0:
        raise ValueError(f"grid axis {name}: expected at least one value in one dimension, got shape {points.shape}")
    parameters = parameters_of(scorer) if is_dataclass(scorer) else {}
    if isinstance(points, np.ndarray) and name in parameters and not parameters[name].choices:
        parameters[name].check(name, points)
    return points
