"""Settings of a sweep -> groups that one program serves: of the same choices, and of about as many bins."""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mfvpr.reranking import grids
from mfvpr.reranking.grids import WEIGHTINGS
from mfvpr.scoring import parameters
from mfvpr.scoring.parameters import with_parameters
from mfvpr.scoring.weights import ChosenWeight
from mfvpr.utils.numerics import held

Setting = Mapping[str, Any]

FUSION = "c"


@dataclass(frozen=True)
class Group:
    """Settings of one program, the product of G settings and W weightings.

    Attributes:
        scorer: with the choices and the capacity of these settings.
        settings: `[G]` values by parameter.
        weightings: `[W]` values of `weight` (an option's number) and `max_distance`.
        rows: `[G, W]` numbers of the settings.
        program: what the scorer computes, where that is asked.
    """

    scorer: Any
    settings: Mapping[str, np.ndarray]
    weightings: Mapping[str, np.ndarray]
    rows: np.ndarray
    program: str = ""

    def blocks(self, size: int) -> Iterator["Group"]:
        """Parts of one shape with at most `size` settings each; the last repeats what it has to reach it."""
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
    """The settings that are scored differently, without `c`, and the places in `settings` that share their scores."""
    places: dict[Any, list[int]] = {}
    scored = {}
    for place, setting in enumerate(settings):
        own = {name: value for name, value in setting.items() if name != FUSION}
        key = _key(own)
        places.setdefault(key, []).append(place)
        scored.setdefault(key, own)
    return list(scored.values()), list(places.values())


def groups(scorer: Any, settings: Sequence[Setting], image_sizes: tuple[np.ndarray, np.ndarray]) -> Iterator[Group]:
    """All settings, group by group.

    Args:
        scorer: whose other parameters stay.
        settings: the same names in each. What is static, or None, costs a program for each value.
        image_sizes: all that occur, `[n, 2]` of queries and of database images.
    """
    static = parameters.choices(scorer)
    whole = parameters.whole_numbers(scorer)
    weights = list({id(s["weight"]): s["weight"] for s in settings if "weight" in s}.values())
    for choices, members in _grouped(
        settings, range(len(settings)), lambda name, value: name in static or value is None
    ):
        chosen = with_parameters(scorer, choices)
        if weights:
            chosen = replace(chosen, weight=ChosenWeight(tuple(weights), 0))
        chosen = held(chosen)
        for rows in _products(settings, members):
            values = _arrays(
                [settings[row] for row in rows[:, 0]], weights, whole=whole, without={*choices, *WEIGHTINGS}
            )
            weightings = _arrays(
                [settings[row] for row in rows[0]], weights, whole=whole, without=set(settings[0]) - set(WEIGHTINGS)
            )
            for fitted, part in grids.by_capacity(chosen, values, len(rows), *image_sizes):
                yield Group(fitted, {name: axis[part] for name, axis in values.items()}, weightings, rows[part])


def _products(settings: Sequence[Setting], members: Sequence[int]) -> list[np.ndarray]:
    """The members as products `[G, W]` of settings and weightings: those with the same weightings are one."""
    columns = _grouped(settings, members, lambda name, _: name in WEIGHTINGS)
    column = {row: place for place, (_, rows) in enumerate(columns) for row in rows}
    products: dict[tuple[int, ...], list[list[int]]] = {}
    for _, line in _grouped(settings, members, lambda name, _: name not in WEIGHTINGS):
        line = sorted(line, key=column.__getitem__)
        products.setdefault(tuple(column[row] for row in line), []).append(line)
    return [np.array(lines) for lines in products.values()]


def _grouped(
    settings: Sequence[Setting], members: Sequence[int], chosen: Callable[[str, Any], bool]
) -> list[tuple[dict, list[int]]]:
    """Members that share the chosen names' values, with those values."""
    groups: dict[Any, tuple[dict, list[int]]] = {}
    for row in members:
        shared = {name: value for name, value in settings[row].items() if chosen(name, value)}
        groups.setdefault(_key(shared), (shared, []))[1].append(row)
    return list(groups.values())


def _arrays(
    settings: Sequence[Setting], weights: Sequence[Any], *, whole: set[str], without: set[str]
) -> dict[str, np.ndarray]:
    """`[n]` values by name, int where `whole`; a kind of weight is its number among `weights`."""
    number = {id(weight): place for place, weight in enumerate(weights)}
    names = [name for name in settings[0] if name not in without]
    return {
        name: np.array([number[id(setting[name])] for setting in settings])
        if name == "weight"
        else np.array([setting[name] for setting in settings], int if name in whole else np.float32)
        for name in names
    }


def _key(setting: Setting) -> tuple:
    return tuple((name, id(value) if name == "weight" else value) for name, value in setting.items())


def _parts(total: int, size: int) -> list[np.ndarray]:
    """Even parts of range(total), none longer than `size`, all of one length: the last repeats its last."""
    length = -(-total // -(-total // size))
    return [np.minimum(np.arange(start, start + length), total - 1) for start in range(0, total, length)]
