"""Computations on the devices of several hosts together: retrieval by rows of the database, scores by queries.

    jax.distributed.initialize("host:1234", num_processes=2, process_id=0)  # in each process
    mesh = all_devices()
    shortlist = retrieve_on_mesh(queries, database, num_candidates=50, mesh=mesh)
    scores = score_on_mesh(HistogramOfShifts(), matches_of_some_queries, mesh=mesh)

Every process calls the same functions in the same order. Each process holds its part of the data, and all get the
complete result. Without `jax.distributed` the devices are those of this process.
"""

from collections.abc import Callable
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from mfvpr.datasets.positives import Positives
from mfvpr.reranking.ranking import BIN_STEP, check_candidates
from mfvpr.retrieval.search import retrieve
from mfvpr.scoring.parameters import with_capacity
from mfvpr.scoring.scorer import Scorer, check_host, on_host
from mfvpr.types import Array, Matches, Shortlist
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import Device, compiled, masked, round_up, with_static_functions

AXIS = "devices"  # the only one of a mesh


def all_devices(devices: list[Device] | None = None) -> Mesh:
    """The mesh of all devices of all processes, or of the given ones."""
    devices = jax.devices() if devices is None else devices
    return jax.make_mesh((len(devices),), (AXIS,), axis_types=(AxisType.Auto,), devices=devices)


def retrieve_on_mesh(
    queries: np.ndarray,
    database: np.ndarray,
    *,
    num_candidates: int,
    mesh: Mesh,
    excluded: Positives | None = None,
) -> Shortlist:
    """Compute the shortlist of `mfvpr.retrieve`: each device finds the best of its rows, then the best of all.

    Scores may differ in their last bits, and so may the order of near ties.

    Args:
        queries: `[Q, D]`, the same in every process.
        database: `[N, D]`; a process reads only the rows of its own devices, so it may be a memory-mapped file.
        num_candidates: C.
        mesh: see `all_devices`.
        excluded: database rows that must not be candidates of each query.

    Returns:
        `[Q, C]`, NumPy, in every process; the first row wins a tie.
    """
    number = round_up(len(database), mesh.size)  # added rows are NaN, which are never candidates
    sharded, replicated = NamedSharding(mesh, PartitionSpec(AXIS)), NamedSharding(mesh, PartitionSpec())

    def rows(index: Any) -> np.ndarray:
        start, stop, _ = index[0].indices(number)
        part = np.asarray(database[start : min(stop, len(database))], np.float32)
        return np.pad(part, ((0, stop - start - len(part)), (0, 0)), constant_values=np.nan)

    def mask(index: Any) -> np.ndarray:
        start, stop, _ = index[0].indices(number)
        allowed = np.ones((stop - start, len(queries)), bool)
        if excluded is not None:
            for query in range(len(queries)):
                forbidden = excluded.of(query)
                allowed[forbidden[(forbidden >= start) & (forbidden < stop)] - start, query] = False
        return allowed

    arrays = (
        jax.make_array_from_callback(queries.shape, replicated, lambda index: np.asarray(queries[index], np.float32)),
        jax.make_array_from_callback((number, database.shape[1]), sharded, rows),
        jax.make_array_from_callback((number, len(queries)), sharded, mask),
    )
    return jax.tree.map(np.asarray, _retrieve(*arrays, num_candidates=num_candidates, mesh=mesh))


def retrieve_everywhere(
    queries: np.ndarray, database: np.ndarray, *, num_candidates: int, excluded: Positives | None = None
) -> Shortlist:
    """`retrieve_on_mesh` on the devices of all processes, all of which must call it."""
    return retrieve_on_mesh(queries, database, num_candidates=num_candidates, mesh=all_devices(), excluded=excluded)


@partial(jax.jit, static_argnames=("num_candidates", "mesh"))
def _retrieve(queries: Array, database: Array, allowed: Array, *, num_candidates: int, mesh: Mesh) -> Shortlist:
    rows_per_device = len(database) // mesh.size

    def best(queries: Array, rows: Array, allowed: Array) -> Shortlist:
        local = retrieve(queries, rows, num_candidates=num_candidates, mask=allowed.T)
        first = jax.lax.axis_index(AXIS) * rows_per_device
        local = Shortlist(jnp.where(local.mask, local.indices + first, -1), local.scores, local.mask)
        # [Q, devices * C] in the order of the rows, so that the first row wins a tie.
        gathered = jax.tree.map(lambda field: jax.lax.all_gather(field, AXIS, axis=1, tiled=True), local)
        _, place = jax.lax.top_k(masked(gathered.scores, gathered.mask, -jnp.inf), num_candidates)
        return jax.tree.map(lambda field: jnp.take_along_axis(field, place, axis=1), gathered)

    sharded, replicated = PartitionSpec(AXIS), PartitionSpec()
    specs = {"in_specs": (replicated, sharded, sharded), "out_specs": replicated}
    return jax.shard_map(best, mesh=mesh, **specs, check_vma=False)(queries, database, allowed)


def score_on_mesh(scorer: Scorer, matches: Matches, *, mesh: Mesh) -> np.ndarray:
    """Scores `[Q, C]` of all queries, in every process; each process has the matches of some queries.

    Args:
        scorer: see `mfvpr.score_candidates`; the same in every process.
        matches: `[q, C, K, ...]` of this process's queries, with the same shape in every process. If queries were added
            to reach it, the caller removes their scores. Queries are in the order of the processes.
        mesh: see `all_devices`.

    Raises:
        InputError: a number of queries that this process's devices cannot share, or a scorer that runs on the host.
    """
    check_host(scorer)
    if on_host(scorer):
        raise InputError(f"{type(scorer).__name__}: expected a scorer that runs on devices, got one of the host")
    check_candidates(jax.tree.map(lambda field: field[0], matches))
    number, num_devices = len(matches.mask), len(mesh.local_devices)
    if number % num_devices:
        raise InputError(f"matches: expected a multiple of {num_devices} queries, one for each device of this process, "
                         f"got {number}; add queries without matches")  # fmt: skip
    sharding = NamedSharding(mesh, PartitionSpec(AXIS))
    sharded = jax.tree.map(lambda field: jax.make_array_from_process_local_data(sharding, np.asarray(field)), matches)
    fitted = with_capacity(scorer, np.asarray(matches.image_size0), np.asarray(matches.image_size1), multiple=BIN_STEP)
    return np.asarray(score_program(mesh)(with_static_functions(fitted), sharded))


@cache
def score_program(mesh: Mesh) -> Callable[[Scorer, Matches], Array]:
    """The program of a mesh; scores `[Q, C]`."""

    def score(scorer: Scorer, local: Matches) -> Array:
        scores = jax.lax.map(jax.vmap(scorer), local)  # query by query, all candidates of each
        return jax.lax.all_gather(scores, AXIS, axis=0, tiled=True)

    specs = {"in_specs": (PartitionSpec(), PartitionSpec(AXIS)), "out_specs": PartitionSpec()}
    return compiled(jax.shard_map(score, mesh=mesh, **specs, check_vma=False))
