"""Computations on the devices of several hosts together: the filter by rows of the database, scores by queries.

    jax.distributed.initialize("host:1234", num_processes=2, process_id=0)  # in each process
    mesh = all_devices()
    shortlist = retrieve_spread(queries, database, num_candidates=50, mesh=mesh)
    scores = score_spread(HistogramOfShifts(), matches_of_own_queries, mesh=mesh)

Every process calls the same, in the same order; each holds its part, and all get the whole. Without
`jax.distributed` the devices are those of this process.
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
from mfvpr.scoring.parameters import fit
from mfvpr.scoring.scorer import Scorer, check_host, on_host
from mfvpr.types import Array, Matches, Shortlist
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import Device, compiled, held, masked, round_up

AXIS = "devices"  # the only one of a mesh


def all_devices(devices: list[Device] | None = None) -> Mesh:
    """The mesh of all devices of all processes, or of some."""
    devices = jax.devices() if devices is None else devices
    return jax.make_mesh((len(devices),), (AXIS,), axis_types=(AxisType.Auto,), devices=devices)


def retrieve_spread(
    queries: np.ndarray,
    database: np.ndarray,
    *,
    num_candidates: int,
    mesh: Mesh,
    excluded: Positives | None = None,
) -> Shortlist:
    """The shortlist that `mfvpr.retrieve` finds: each device looks for the best of its rows, then for those of all.

    Scores may differ in their last bits, and with them the order of near ties.

    Args:
        queries: `[Q, D]`, the same in every process.
        database: `[N, D]`, of which a process reads the rows of its own devices alone: it may be mapped from a file.
        num_candidates: C.
        mesh: see `all_devices`.
        excluded: what each query may not find.

    Returns:
        `[Q, C]`, NumPy, in every process; of equal ones the first row wins.
    """
    number = round_up(len(database), mesh.size)  # rows beyond are no numbers, which nobody finds
    spread = NamedSharding(mesh, PartitionSpec(AXIS))

    def rows(index: Any) -> np.ndarray:
        start, stop, _ = index[0].indices(number)
        part = np.asarray(database[start : min(stop, len(database))], np.float32)
        return np.pad(part, ((0, stop - start - len(part)), (0, 0)), constant_values=np.nan)

    def allowed(index: Any) -> np.ndarray:
        start, stop, _ = index[0].indices(number)
        found = np.ones((stop - start, len(queries)), bool)
        if excluded is not None:
            for query in range(len(queries)):
                own = excluded.of(query)
                found[own[(own >= start) & (own < stop)] - start, query] = False
        return found

    whole = NamedSharding(mesh, PartitionSpec())
    arrays = (
        jax.make_array_from_callback(queries.shape, whole, lambda index: np.asarray(queries[index], np.float32)),
        jax.make_array_from_callback((number, database.shape[1]), spread, rows),
        jax.make_array_from_callback((number, len(queries)), spread, allowed),
    )
    return jax.tree.map(np.asarray, _retrieved(*arrays, num_candidates=num_candidates, mesh=mesh))


def retrieve_everywhere(
    queries: np.ndarray, database: np.ndarray, *, num_candidates: int, excluded: Positives | None = None
) -> Shortlist:
    """`retrieve_spread` on the devices of all processes, which ask the same at the same time."""
    return retrieve_spread(queries, database, num_candidates=num_candidates, mesh=all_devices(), excluded=excluded)


@partial(jax.jit, static_argnames=("num_candidates", "mesh"))
def _retrieved(queries: Array, database: Array, allowed: Array, *, num_candidates: int, mesh: Mesh) -> Shortlist:
    rows_of_one = len(database) // mesh.size

    def best(queries: Array, rows: Array, allowed: Array) -> Shortlist:
        own = retrieve(queries, rows, num_candidates=num_candidates, mask=allowed.T)
        first = jax.lax.axis_index(AXIS) * rows_of_one
        own = Shortlist(jnp.where(own.mask, own.indices + first, -1), own.scores, own.mask)
        # [Q, devices * C] in the order of the rows, so that of equal ones the first row wins.
        every = jax.tree.map(lambda field: jax.lax.all_gather(field, AXIS, axis=1, tiled=True), own)
        _, place = jax.lax.top_k(masked(every.scores, every.mask, -jnp.inf), num_candidates)
        return jax.tree.map(lambda field: jnp.take_along_axis(field, place, axis=1), every)

    spread, whole = PartitionSpec(AXIS), PartitionSpec()
    program = jax.shard_map(best, mesh=mesh, in_specs=(whole, spread, spread), out_specs=whole, check_vma=False)
    return program(queries, database, allowed)


def score_spread(scorer: Scorer, matches: Matches, *, mesh: Mesh) -> np.ndarray:
    """Scores `[Q, C]` of all queries, in every process, each of which has the matches of some.

    Args:
        scorer: see `mfvpr.score_candidates`; the same in every process.
        matches: `[q, C, K, ...]` of this process's queries, as many slots, candidates and queries as every other has
            (those that are too many are cut off by whoever calls): the queries come in the order of the processes.
        mesh: see `all_devices`.

    Raises:
        InputError: a number of queries that this process's devices cannot share, or a scorer that runs on the host.
    """
    check_host(scorer)
    if on_host(scorer):
        raise InputError(f"{type(scorer).__name__}: expected a scorer that runs on devices, got one of the host")
    check_candidates(jax.tree.map(lambda field: field[0], matches))
    number, own = len(matches.mask), len(mesh.local_devices)
    if number % own:
        raise InputError(f"matches: expected a multiple of {own} queries, one for each device of this process, got "
                         f"{number}; add queries without matches")  # fmt: skip
    spread = NamedSharding(mesh, PartitionSpec(AXIS))
    everywhere = jax.tree.map(lambda field: jax.make_array_from_process_local_data(spread, np.asarray(field)), matches)
    fitted = fit(scorer, np.asarray(matches.image_size0), np.asarray(matches.image_size1), multiple=BIN_STEP)
    return np.asarray(score_program(mesh)(held(fitted), everywhere))


@cache
def score_program(mesh: Mesh) -> Callable[[Scorer, Matches], Array]:
    """The program of a mesh; scores `[Q, C]`."""

    def own(scorer: Scorer, some: Matches) -> Array:
        scores = jax.lax.map(jax.vmap(scorer), some)  # query by query, all candidates of each
        return jax.lax.all_gather(scores, AXIS, axis=0, tiled=True)

    spread, whole = PartitionSpec(AXIS), PartitionSpec()
    return compiled(jax.shard_map(own, mesh=mesh, in_specs=(whole, spread), out_specs=whole, check_vma=False))
