"""Settings of a sweep -> groups that share one program: the same choices, and similar numbers of bins."""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Int, Shaped

from mfvpr.core.batch import WEIGHTINGS, by_capacity
from mfvpr.core.scorer import static_names, whole_numbers, with_parameters, with_static_functions
from mfvpr.core.weights import ChosenWeight

Setting = Mapping[str, Any]

FUSION = "c"


@dataclass(frozen=True)
class Group:
    """Settings of one program, the product of G settings and W weightings."""

    scorer: Any  # with the choices and the capacity for these settings
    settings: Mapping[str, Shaped[np.ndarray, " settings"]]
    weightings: Mapping[str, Shaped[np.ndarray, " weightings"]]  # of `weight` (an option's number) and `max_distance`
    rows: Int[np.ndarray, "settings weightings"]  # numbers of the settings

    def blocks(self, size: int) -> Iterator["Group"]:
        """Parts of one shape with at most `size` settings each; the last part repeats settings to reach the shape."""
        width = min(size, self.rows.shape[1])
        for columns in _parts(self.rows.shape[1], width):
            for lines in _parts(self.rows.shape[0], max(1, size // width)):
                settings = {name: values[lines] for name, values in self.settings.items()}
                weightings = {name: values[columns] for name, values in self.weightings.items()}
                yield replace(self, settings=settings, weightings=weightings, rows=self.rows[np.ix_(lines, columns)])


def grid(axes: Mapping[str, Sequence[Any]]) -> list[dict[str, Any]]:
    """Every combination of the axes' values, the last axis fastest."""
    return [dict(zip(axes, values, strict=True)) for values in itertools.product(*axes.values())]


def distinct(settings: Sequence[Setting]) -> tuple[list[dict[str, Any]], list[list[int]]]:
    """Settings with different scores, without `c`, and for each the places in `settings` that share its scores."""
    by_scores = _group_by(settings, range(len(settings)), lambda name, _: name != FUSION)
    return [setting for setting, _ in by_scores], [places for _, places in by_scores]


def group_by_program(
    scorer: Any, settings: Sequence[Setting], image_sizes: tuple[np.ndarray, np.ndarray]
) -> Iterator[Group]:
    """Group settings, with the same names in each, by program: each value of a static parameter, and None, has one."""
    static, integers = static_names(scorer), whole_numbers(scorer)
    weights = list({id(s["weight"]): s["weight"] for s in settings if "weight" in s}.values())
    by_choices = _group_by(settings, range(len(settings)), lambda name, value: name in static or value is None)
    for choices, members in by_choices:
        chosen = with_parameters(scorer, choices)
        if weights:
            chosen = replace(chosen, weight=ChosenWeight(tuple(weights), 0))
        chosen = with_static_functions(chosen)
        for rows in _products(settings, members):
            values = _arrays([settings[row] for row in rows[:, 0]], weights, integers, without={*choices, *WEIGHTINGS})
            parameter_names = set(settings[0]) - set(WEIGHTINGS)
            weightings = _arrays([settings[row] for row in rows[0]], weights, integers, without=parameter_names)
            for fitted, part in by_capacity(chosen, values, len(rows), *image_sizes):
                yield Group(fitted, {name: axis[part] for name, axis in values.items()}, weightings, rows[part])


def _products(settings: Sequence[Setting], members: Sequence[int]) -> list[np.ndarray]:
    """Split the members into products `[G, W]` of settings and weightings."""
    columns = _group_by(settings, members, lambda name, _: name in WEIGHTINGS)
    column = {row: place for place, (_, rows) in enumerate(columns) for row in rows}
    products: dict[tuple[int, ...], list[list[int]]] = {}
    for _, line in _group_by(settings, members, lambda name, _: name not in WEIGHTINGS):
        line = sorted(line, key=column.__getitem__)
        products.setdefault(tuple(column[row] for row in line), []).append(line)
    return [np.array(lines) for lines in products.values()]


def _group_by(
    settings: Sequence[Setting], members: Sequence[int], chosen: Callable[[str, Any], bool]
) -> list[tuple[dict, list[int]]]:
    """Group the members by the values of the chosen names; return the values and the members of each group."""
    groups: dict[Any, tuple[dict, list[int]]] = {}
    for row in members:
        shared = {name: value for name, value in settings[row].items() if chosen(name, value)}
        key = tuple((name, id(value) if name == "weight" else value) for name, value in shared.items())
        groups.setdefault(key, (shared, []))[1].append(row)
    return list(groups.values())


def _arrays(
    settings: Sequence[Setting], weights: Sequence[Any], integers: set[str], *, without: set[str]
) -> dict[str, np.ndarray]:
    """Values `[n]` by name; a match weight is its number among `weights`."""
    number = {id(weight): place for place, weight in enumerate(weights)}
    names = [name for name in settings[0] if name not in without]
    return {
        name: np.array([number[id(setting[name])] for setting in settings])
        if name == "weight"
        else np.array([setting[name] for setting in settings], int if name in integers else np.float32)
        for name in names
    }


def _parts(total: int, size: int) -> list[np.ndarray]:
    """Parts of range(total) of one length, at most `size`; the last part repeats its last number."""
    length = -(-total // -(-total // size))
    return [np.minimum(np.arange(start, start + length), total - 1) for start in range(0, total, length)]
