"""Ragged rows <-> padded arrays and a mask: the only padding there is.

Images have as many keypoints, and pairs as many matches, as they happen to have. On the host these are rows of their
own length, arrays by name; what is compiled takes them in arrays of few shapes, zeros where a row has ended.
"""

from collections.abc import Mapping, Sequence
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

Row = Mapping[str, np.ndarray]  # [n, ...] by name
Tree = TypeVar("Tree")


def padded(rows: Sequence[Row], capacity: int, *, total: int | None = None) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Rows `[n_i, ...]` as arrays `[R, capacity, ...]` by name, 0 beyond their ends, and the mask `[R, capacity]`.

    Args:
        rows: at least one, of the same names; none longer than `capacity`.
        capacity: slots of a row.
        total: R; those beyond `rows` are empty. By default as many as there are.
    """
    total = len(rows) if total is None else total
    arrays = {name: np.empty((total, capacity, *values.shape[1:]), values.dtype) for name, values in rows[0].items()}
    counts = np.zeros(total, int)
    for place, row in enumerate(rows):
        counts[place] = len(next(iter(row.values())))
        for name, values in row.items():
            arrays[name][place, : counts[place]] = values
    for place, count in enumerate(counts.tolist()):
        for values in arrays.values():
            values[place, count:] = 0
    return arrays, np.arange(capacity) < counts[:, None]


def split(flat: Row, counts: np.ndarray) -> list[dict[str, np.ndarray]]:
    """Rows of lengths `counts` `[R]`, views of arrays in which they stand one after the other."""
    ends = np.cumsum(counts)
    return [
        {name: values[end - count : end] for name, values in flat.items()}
        for count, end in zip(counts.tolist(), ends.tolist(), strict=True)
    ]


def joined(rows: Sequence[Row]) -> dict[str, np.ndarray]:
    """Rows one after the other, at least one."""
    return {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}


def sizes(counts: np.ndarray, quantiles: Sequence[float], step: int) -> np.ndarray:
    """Few capacities, ascending multiples of `step`, that rows of lengths `counts` fit into with little padding.

    They are quantiles over all rows that are not empty, so that neither a row's company nor the part of the rows that
    is worked on changes the shape it is computed in.
    """
    some = counts[counts > 0]
    if not some.size:
        return np.array([step])
    return np.unique(np.ceil(np.quantile(some, quantiles) / step).astype(int) * step)


def worthwhile(capacities: np.ndarray, counts: np.ndarray, saving: float) -> np.ndarray:
    """Those of ascending `capacities` without which there would be at least `saving` slots more; the largest always."""
    some = counts[counts > 0]
    while len(capacities) > 1:
        rows = np.bincount(np.searchsorted(capacities, some), minlength=len(capacities))
        saved = rows[:-1] * np.diff(capacities)
        if saved.min() >= saving:
            break
        capacities = np.delete(capacities, saved.argmin())
    return capacities


def fitting(capacities: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """The smallest of ascending `capacities` that holds each of `counts`."""
    return capacities[np.searchsorted(capacities, counts)]


def filled(values: np.ndarray, total: int) -> np.ndarray:
    """`values` `[n, ...]`, n > 0, with its last entry again and again until there are `total`."""
    return np.concatenate([values, np.repeat(values[-1:], total - len(values), axis=0)])


def at_least_one(tree: Tree) -> Tree:
    """Arrays `[n, ...]` with n = 0 as one entry of zeros, so that there is something to index. Traced or not."""
    return jax.tree.map(lambda leaf: leaf if len(leaf) else jnp.zeros((1, *leaf.shape[1:]), leaf.dtype), tree)


def in_front(tree: Tree, mask: jax.Array, capacity: int) -> Tree:
    """Entries of arrays `[n, ...]` where `mask` `[n]` is set, in their order, in `capacity` slots. Traced or not.

    Entries beyond the capacity are dropped; what stands in slots beyond those that are set means nothing.
    """
    slots = jnp.nonzero(mask, size=capacity, fill_value=0)[0]
    return jax.tree.map(lambda leaf: at_least_one(jnp.asarray(leaf))[slots], tree)
