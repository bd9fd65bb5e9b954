"""Ragged rows, on the host arrays by name <-> padded arrays of few shapes and a mask, for compiled functions."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Int, Shaped

Row = Mapping[str, np.ndarray]  # [n, ...] by name


def pad_rows(
    rows: Sequence[Row], capacity: int, *, total: int | None = None
) -> tuple[dict[str, Shaped[np.ndarray, "rows slots ..."]], Bool[np.ndarray, "rows slots"]]:
    """At least one row as `total` padded arrays by name, 0 beyond the ends of the rows, and the mask."""
    total = len(rows) if total is None else total
    arrays = {name: np.zeros((total, capacity, *values.shape[1:]), values.dtype) for name, values in rows[0].items()}
    counts = np.zeros(total, int)
    for place, row in enumerate(rows):
        counts[place] = len(next(iter(row.values())))
        for name, values in row.items():
            arrays[name][place, : counts[place]] = values
    return arrays, np.arange(capacity) < counts[:, None]


def split(flat: Row, counts: Int[np.ndarray, " rows"]) -> list[dict[str, np.ndarray]]:
    """Rows of lengths `counts`, as views of arrays that hold one row after the other."""
    ends = np.cumsum(counts)
    return [
        {name: values[end - count : end] for name, values in flat.items()}
        for count, end in zip(counts.tolist(), ends.tolist(), strict=True)
    ]


def join_rows(rows: Sequence[Row]) -> dict[str, np.ndarray]:
    """Rows one after the other, at least one."""
    return {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}


def sizes(counts: Int[np.ndarray, "..."], quantiles: Sequence[float], step: int) -> Int[np.ndarray, " capacities"]:
    """Few capacities, ascending multiples of `step`, that hold rows of lengths `counts`: quantiles of those above 0."""
    lengths = counts[counts > 0]
    if not lengths.size:
        return np.array([step])
    return np.unique(np.ceil(np.quantile(lengths, quantiles) / step).astype(int) * step)


def prune_capacities(
    capacities: Int[np.ndarray, " capacities"], counts: Int[np.ndarray, "..."], saving: float
) -> Int[np.ndarray, " _"]:
    """The largest of ascending `capacities`, and each that saves at least `saving` slots of padding."""
    lengths = counts[counts > 0]
    while len(capacities) > 1:
        rows = np.bincount(np.searchsorted(capacities, lengths), minlength=len(capacities))
        saved = rows[:-1] * np.diff(capacities)
        if saved.min() >= saving:
            break
        capacities = np.delete(capacities, saved.argmin())
    return capacities


def smallest_capacities(
    capacities: Int[np.ndarray, " capacities"], counts: Int[np.ndarray, "*batch"]
) -> Int[np.ndarray, "*batch"]:
    """The smallest of ascending `capacities` that holds each of `counts`."""
    return capacities[np.searchsorted(capacities, counts)]


def repeat_last(values: Shaped[np.ndarray, " _ *rest"], total: int) -> Shaped[np.ndarray, " _ *rest"]:
    """`values`, at least one, with the last entry repeated up to `total` entries."""
    return np.concatenate([values, np.repeat(values[-1:], total - len(values), axis=0)])
