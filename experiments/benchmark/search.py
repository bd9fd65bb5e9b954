"""Exact search of global descriptors in mfvpr, FAISS and NumPy; the database is in the memory of each beforehand."""

from collections.abc import Callable, Iterator
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax
import numpy as np

import mfvpr
from experiments.benchmark.harness import Entry, compete

SIZES = ((10_000, 512), (10_000, 4096), (100_000, 512), (100_000, 4096))  # rows and dimensions of the database
QUERIES = (1, 20, 100)
CANDIDATES = 50


def run(rounds: int | None, out: Path) -> None:
    """Time all libraries on random descriptors."""
    entries = [entry for rows, dimensions in SIZES for entry in search_entries(rows, dimensions)]
    setting = {"sizes": SIZES, "queries": QUERIES, "candidates": CANDIDATES}
    title = f"the {CANDIDATES} nearest of random descriptors, exact"
    compete(entries, rounds or 5, out, title=title, setting=setting, remarks=lambda *_: [])


def search_entries(rows: int, dimensions: int) -> Iterator[Entry]:
    """Calls that return the rows of the nearest descriptors `[Q, CANDIDATES]`."""
    rng = np.random.default_rng(0)
    shapes = (rows, dimensions), (max(QUERIES), dimensions)
    database, queries = (rng.standard_normal(shape, dtype=np.float32) for shape in shapes)
    calls: dict[str, Callable[[np.ndarray], Any]] = {
        "mfvpr": partial(_mfvpr, jax.device_put(database)),
        "NumPy": partial(_numpy, database),
    }
    if find_spec("faiss"):
        import faiss

        index = faiss.IndexFlatIP(dimensions)
        index.add(database)  # pyright: ignore[reportCallIssue]
        calls["FAISS"] = partial(_faiss, index)
    for count in QUERIES:
        step = f"{count} of {rows:,} x {dimensions}"
        yield from ((step, name, partial(call, queries[:count])) for name, call in calls.items())


def _mfvpr(database: jax.Array, queries: np.ndarray) -> np.ndarray:
    return np.asarray(mfvpr.retrieve(queries, database, num_candidates=CANDIDATES).indices)


def _numpy(database: np.ndarray, queries: np.ndarray) -> np.ndarray:
    products = queries @ database.T
    nearest = np.argpartition(-products, CANDIDATES, axis=1)[:, :CANDIDATES]
    order = np.argsort(-np.take_along_axis(products, nearest, axis=1), axis=1, kind="stable")
    return np.take_along_axis(nearest, order, axis=1)


def _faiss(index: Any, queries: np.ndarray) -> np.ndarray:
    return index.search(queries, CANDIDATES)[1]
