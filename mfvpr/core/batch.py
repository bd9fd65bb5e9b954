"""Scores of the candidates of one query, by one scorer or by a grid of its parameters: `lax.map` around `vmap`.

sigma=[10, 20] of a grid is an axis (`_axis`), becomes rows of settings (`_product`), which are grouped by the capacity
that they need (`by_capacity`); one program per group (`_score_settings`) puts the sigma of each row into the scorer
(`with_parameters`), and calls it.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import is_dataclass, replace
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, Num

from mfvpr.core.matching import filter_matches
from mfvpr.core.scorer import (
    Scorer,
    check_host,
    fit_capacities,
    numbers_by_name,
    on_host,
    parameters_of,
    require_scores,
    score_pairs,
    shares_weightings,
    whole_numbers,
    with_parameters,
    with_static_functions,
)
from mfvpr.core.types import Array, Matches
from mfvpr.core.weights import WEIGHTS, ChosenWeight, match_weights
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import available_cpus, compiled, device_of, holds_function, is_concrete, knows_own_context

Tree = TypeVar("Tree")
BIN_STEP = 8  # capacities of histograms are multiples of it
MATCH_AXES = ("weight", "max_distance")  # axes that only change how much a match counts


def score_candidates(scorer: Scorer, matches: Matches) -> Float[jax.Array, " candidates"]:
    """Scores of matches `[C, K, ...]`; other shapes raise a ValueError.

        mfvpr.score_candidates(mfvpr.HistogramOfShifts(), candidate_matches)  # [C]

    The program is compiled once per shape, and reused for other numbers in the scorer. A scorer that is or holds a
    plain function runs operation by operation. Capacities (`max_bins` of the histogram) are fitted to the image sizes;
    under a caller's `jit`, where sizes are traced, set them before.
    """
    check_candidates(scorer, matches)
    if on_host(scorer):
        return jnp.asarray(score_pairs(scorer, matches))
    scores = _score_candidates(fit_to_sizes(partial(fit_capacities, scorer, multiple=BIN_STEP), matches), matches)
    require_scores(type(scorer).__name__, scores, len(matches.mask))
    return scores


@compiled
def _score_candidates(scorer: Scorer, matches: Matches) -> jax.Array:
    return jax.vmap(scorer)(matches)


def score_grid(scorer: Any, matches: Matches, **axes: Sequence[Any] | Array) -> Float[jax.Array, "*grid candidates"]:
    """Scores of every combination of parameter values, `[len(axis1), ..., C]`, from matches `[C, K, ...]`.

        scorer = mfvpr.HistogramOfShifts()
        mfvpr.score_grid(scorer, candidate_matches, sigma=[10.0, 22.5], weight=["ratio", "fs"])  # [sigma, weight, C]

    Each capacity of bins is one traced computation, so that fine bins do not slow coarse bins down. Other values within
    the same capacities cost no compilation, other lengths do. With a plain function, every call compiles. An axis that
    is empty, not one-dimensional, or names no numeric parameter of the scorer raises a `ValueError`.

    The `axes` are values of the scorer's numbers; of numbers of its parts, `**{"inner.sigma": [10., 22.5]}`; of
    `max_distance`, beyond which matches do not count (None = any); and of `weight`, by the words fs, dmf, ratio, unit
    or a value such as `UnitWeight()`.
    """
    if not axes:
        raise ValueError("score_grid: expected at least one axis, such as sigma=[10.0, 22.5]")
    check_candidates(scorer, matches)
    refuse_own_names(scorer, axes)
    weights = _weights(axes["weight"]) if "weight" in axes and hasattr(scorer, "weight") else ()
    values = {
        name: np.arange(len(weights)) if name == "weight" and weights else _axis(scorer, name, axis)
        for name, axis in axes.items()
    }
    if weights:
        scorer = replace(scorer, weight=ChosenWeight(weights, 0))
    plain, scorer = holds_function(scorer), with_static_functions(scorer)
    match_axes = [name for name in values if name in MATCH_AXES]
    scorer_axes = [name for name in values if name not in MATCH_AXES]
    settings, weightings = _product(values, scorer_axes), _product(values, match_axes)
    rows = int(np.prod([len(values[name]) for name in scorer_axes]))
    groups = fit_to_sizes(partial(by_capacity, scorer, settings, rows), matches)
    on_cpu = device_of(matches).platform == "cpu"

    def score(matches: Matches) -> list[Array]:
        # On a CPU one after the other, because programs that run at the same time would share the cache.
        scores = (
            score_settings(fitted, matches, {name: axis[part] for name, axis in settings.items()}, weightings)
            for fitted, part in groups
        )
        waited = [jax.block_until_ready(group_scores) if on_cpu else group_scores for group_scores in scores]
        for group_scores in waited:
            require_scores("scorer", group_scores.reshape(-1, *group_scores.shape[2:])[0], len(matches.mask))
        return waited

    # A plain function may close over traced values, which only the thread that traces them can use.
    use_threads = is_concrete((scorer, matches, values)) and not plain
    scores = _on_every_core(score, matches) if use_threads else score(matches)
    # On a CPU, single operations of JAX would wait for its queue; elsewhere NumPy would wait for the device.
    xp: Any = np if on_cpu and is_concrete(scores) else jnp
    order = np.argsort(np.concatenate([part for _, part in groups]))
    names = scorer_axes + match_axes
    scores = xp.concatenate(scores)[order].reshape(*(len(values[name]) for name in names), -1)
    return jnp.asarray(xp.moveaxis(scores, range(len(names)), [list(axes).index(name) for name in names]))


def score_settings(
    scorer: Any,
    matches: Matches,
    settings: Mapping[str, Num[Array, " settings"]],
    weightings: Mapping[str, Num[Array, " weightings"]],
) -> Num[Array, "_ _ ..."]:
    """Scores `[G, W, C]` of matches `[C, K, ...]` for every combination of G settings and W weightings.

    Settings are scored one after the other, because all at once would leave the cache, and in one traced computation,
    so that other values cost no compilation; on an accelerator as many at once as `pairs_at_once` of the scorer allows.
    A histogram needs a capacity that suffices for every `bin_size`. Weightings: `max_distance`, and `weight` (index of
    the scorer's `ChosenWeight`). Without any, G or W is 1.
    """
    if on_host(scorer):
        scores = np.array(
            [
                [score_pairs(*_weigh(with_parameters(scorer, setting), matches, row)) for row in _rows(weightings)]
                for setting in _rows(settings)
            ]
        )
    else:
        scores = _score_settings(scorer, matches, dict(settings), dict(weightings))
    require_scores("scorer", scores)
    return scores


def _rows(values: Mapping[str, Array]) -> list[dict[str, Any]]:
    columns = [np.asarray(axis) for axis in values.values()]
    return [dict(zip(values, row, strict=True)) for row in zip(*columns, strict=True)] if columns else [{}]


@compiled
def _score_settings(
    scorer: Any, matches: Matches, settings: Mapping[str, Array], weightings: Mapping[str, Array]
) -> Array:
    at_once, is_shared = 1, shares_weightings(scorer)
    if is_shared:
        weigh = lambda varied, near: match_weights(varied.weight, near)  # noqa: E731
        weights = jax.vmap(partial(_each_weighting, weigh, scorer, weightings))(matches)  # [C, W, K]
        at_once = max(1, scorer.pairs_at_once(matches, weights.shape[1]) // max(1, len(weights)))

    def score_setting(setting: Mapping[str, Array]) -> Float[Array, "weightings candidates"]:
        varied = with_parameters(scorer, setting)
        if is_shared:
            return varied.score_weightings(matches, weights).T
        score = lambda weighted, near: weighted(near)  # noqa: E731
        return jax.vmap(partial(_each_weighting, score, varied, weightings), out_axes=-1)(matches)

    return _map(score_setting, settings, at_once=at_once)


def _each_weighting(
    function: Callable[[Any, Matches], Array], scorer: Any, weightings: Mapping[str, Array], matches: Matches
) -> Array:
    """`function` of the scorer and the matches of one pair, by weighting."""
    return _map(lambda weighting: function(*_weigh(scorer, matches, weighting)), weightings)


def _weigh(scorer: Any, matches: Matches, weighting: Mapping[str, Array]) -> tuple[Any, Matches]:
    """The scorer and the matches of one pair with one weighting."""
    near = filter_matches(matches, max_distance=weighting.get("max_distance"))
    if "weight" not in weighting:
        return scorer, near
    return replace(scorer, weight=replace(scorer.weight, index=weighting["weight"])), near


def _map(function: Callable[[dict[str, Array]], Array], values: Mapping[str, Array], *, at_once: int = 1) -> Array:
    """`function` of every row of `values`, few at a time; once if there are no values."""
    if not values:
        return function({})[None]
    return jax.lax.map(function, dict(values), batch_size=None if at_once == 1 else at_once)


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
        return [(fit_capacities(first, image_size0, image_size1, multiple=BIN_STEP), np.arange(num_settings))]
    settings = jax.tree.map(np.asarray, settings)
    groups: dict[Any, tuple[Any, list[int]]] = {}
    for row in range(num_settings):
        varied = with_parameters(scorer, {name: values[row] for name, values in settings.items()})
        fitted = fit_capacities(varied, image_size0, image_size1, multiple=BIN_STEP)
        groups.setdefault(jax.tree.structure(fitted), (fitted, []))[1].append(row)
    return [(fitted, np.array(rows)) for fitted, rows in groups.values()]


def fit_to_sizes(fit: Callable[[Array, Array], Tree], matches: Matches) -> Tree:
    """`fit(sizes0, sizes1)` for the sizes of both images, without pairs that have no matches and arbitrary sizes."""
    sizes = matches.image_size0, matches.image_size1
    if not is_concrete((matches.mask, sizes)) or any(size is None for size in sizes):
        return fit(*sizes)
    size0, size1 = (np.broadcast_to(size, (len(matches.mask), 2)) for size in sizes)
    if (size0 == size0[:1]).all() and (size1 == size1[:1]).all():  # an accelerator need not say which have matches
        with suppress(InputError):  # perhaps no pair has matches
            return fit(size0[:1], size1[:1])
    has_matches = np.any(matches.mask, axis=-1)
    return fit(size0[has_matches], size1[has_matches])


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


def check_candidates(scorer: Any, matches: Matches) -> None:
    """Raise a ValueError unless the matches are `[C, K, ...]`, and a scorer of the host is a value."""
    check_host(scorer)
    if np.ndim(matches.mask) != 2:
        raise ValueError(
            f"expected matches [C, K, ...] of candidates, got a mask of shape {np.shape(matches.mask)}; of one pair "
            "[K] the score is scorer(matches)"
        )


def refuse_own_names(scorer: Any, names: Iterable[str], reserved: Iterable[str] = MATCH_AXES) -> None:
    """Raise an InputError if a number of the scorer has the name of an axis with another meaning."""
    for name in {*names} & {*numbers_by_name(scorer)} & {*reserved}:
        raise InputError(f"{type(scorer).__name__}.{name}: a grid means something else by {name}; rename the field")


def _product(values: Mapping[str, Array], names: Sequence[str]) -> dict[str, Array]:
    """Every combination of the values of the named axes: `[G]` by axis."""
    xp = np if is_concrete(dict(values)) else jnp
    points = xp.meshgrid(*(values[name] for name in names), indexing="ij")
    return {name: point.reshape(-1) for name, point in zip(names, points, strict=True)}


def _weights(axis: Sequence[Any]) -> tuple[Any, ...]:
    for weight in axis:
        if weight not in WEIGHTS if isinstance(weight, str) else not callable(weight):
            raise ValueError(f"weight={weight!r}: expected one of {', '.join(WEIGHTS)}, or a weight as UnitWeight()")
    return tuple(WEIGHTS[weight] if isinstance(weight, str) else weight for weight in axis)


def _axis(scorer: Any, name: str, axis: Sequence[float] | Array) -> Array:
    """One checked axis of a grid, float `[n]`."""
    numeric = [*numbers_by_name(scorer), *(["weight"] if hasattr(scorer, "weight") else []), "max_distance"]
    if name not in numeric:
        names = ", ".join(numeric)
        raise ValueError(f"{type(scorer).__name__} has no numeric parameter {name!r}; expected one of {names}")
    if name == "max_distance" and not hasattr(axis, "dtype"):
        axis = [np.inf if value is None else value for value in axis]
    points = np.asarray(axis) if is_concrete(axis) else jnp.asarray(axis)  # on the host, which takes them apart
    if not (jnp.issubdtype(points.dtype, jnp.integer) and name in whole_numbers(scorer)):
        points = points.astype(jnp.result_type(float))
    if points.ndim != 1 or points.size == 0:
        raise ValueError(f"grid axis {name}: expected at least one value in one dimension, got shape {points.shape}")
    if isinstance(points, np.ndarray) and np.isnan(points).any():
        raise ValueError(f"grid axis {name}: expected numbers, got {points.tolist()}")
    parameters = parameters_of(scorer) if is_dataclass(scorer) else {}
    if isinstance(points, np.ndarray) and name in parameters:
        parameters[name].check_numbers(name, points)
    return points
