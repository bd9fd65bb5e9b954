"""Is mfvpr correct and fast on an accelerator? Beside torch on the same device, and beside the device's own rates.

`CASES` lists everything that is timed: a case names the function that returns the calls and the work of one call.
Arrays are on the device beforehand; only the networks take images from the host.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import mfvpr
from experiments.benchmark import networks
from experiments.benchmark.accelerator_checks import checks
from experiments.benchmark.harness import duration, write_report
from mfvpr.report import Table
from mfvpr.retrieval.search import ExactSearch
from mfvpr.types import Features, Matches
from mfvpr.utils.errors import InputError

SIZE, BINS = 336, 45  # px; bins of the histogram per axis
SLOTS, MATCHES, SHARE = 384, 300, 0.4  # of a pair; share of the keypoints that two views of a place have in common
NEAREST = 50
AXES = {"sigma": np.linspace(8, 40, 10), "bin_size": np.array([10.0, 12.0, 15.0, 20.0, 24.0]), "weight": ("fs", "unit"),
        "max_distance": np.linspace(0.5, 1.4, 10)}  # fmt: skip
GIGAFLOPS = {networks.D2NET: 120.0, networks.MIXVPR: 14.2, networks.ALIKED[0]: 2.1}  # of an image, by XLA
ROUNDS, CASE_SECONDS = 30, 1.5  # timed calls at most, and about how long the timed calls of a case may take
EXACT = jax.lax.Precision.HIGHEST

Calls = dict[str, Callable[[], Any]]  # implementation -> call; the others are compared with the first
Timed = tuple[Calls, float, str]  # and the work of a call, in a unit


class Case(NamedTuple):
    """A step that is timed, with its sizes on an accelerator and on a CPU."""

    group: str
    title: str  # with the sizes in braces
    make: Callable[..., Timed]
    sizes: tuple[Any, ...]
    small: tuple[Any, ...]
    is_quick: bool = True


def ready(function: Callable[..., Any], *inputs: Any, **options: Any) -> Callable[[], Any]:
    """Call of JAX that waits for its result."""
    return lambda: jax.block_until_ready(function(*inputs, **options))


def with_torch(name: str, *arrays: jax.Array, **options: Any) -> Calls:
    """A call of `torch_scores` on the same arrays, without a copy; products are of float32, without TF32."""
    if find_spec("torch") is None:
        return {}
    import torch

    from experiments.benchmark import torch_scores

    on_gpu = jax.default_backend() != "cpu"
    if on_gpu and not torch.cuda.is_available():
        return {}
    torch.backends.cuda.matmul.allow_tf32 = False
    tensors = [torch.from_dlpack(array) for array in jax.block_until_ready(arrays)]

    def call() -> Any:
        with torch.inference_mode():
            result = getattr(torch_scores, name)(*tensors, **options)
        if on_gpu:
            torch.cuda.synchronize()
        return result

    return {"torch": call}


# --- data on the device --------------------------------------------------------------------------------------


def _features(points: jax.Array, descriptors: jax.Array) -> Features:
    shape, rows = points.shape[:-1], jnp.maximum(descriptors, 0)  # as D2-Net's
    scores = 100 + 900 * jax.random.uniform(jax.random.key(1), shape)
    descriptors = rows / jnp.linalg.norm(rows, axis=-1, keepdims=True)
    return Features(points, descriptors, scores, jnp.ones(shape, bool), jnp.full((*shape[:-1], 2), float(SIZE)))


@partial(jax.jit, static_argnums=(0, 1, 2))
def places(count: int, keypoints: int, dimension: int) -> Features:
    """Features of images that have nothing in common."""
    key0, key1 = jax.random.split(jax.random.key(0))
    points = jax.random.uniform(key0, (count, keypoints, 2), maxval=SIZE)
    return _features(points, jax.random.normal(key1, (count, keypoints, dimension)))


@jax.jit
def views(places: Features) -> Features:
    """Another view of each image: some keypoints move together, with noise; the others are new."""
    keypoints, dimension = places.descriptors.shape[-2:]
    order = np.random.default_rng(0).permutation(keypoints)
    is_common = (np.arange(keypoints) < SHARE * keypoints)[:, None]

    def view(points: jax.Array, descriptors: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        keys = jax.random.split(key, 3)
        moved = jnp.clip(points + 20 + 4 * jax.random.normal(keys[0], points.shape), 0, SIZE - 1)
        elsewhere = jax.random.uniform(keys[1], points.shape, maxval=SIZE)
        others = jax.random.normal(keys[2], descriptors.shape) / dimension**0.5
        descriptors = jnp.where(is_common, descriptors + 0.5 * others, others)
        return jnp.where(is_common, moved, elsewhere)[order], descriptors[order]

    keys = jax.random.split(jax.random.key(2), len(places.mask))
    return _features(*jax.vmap(view)(places.keypoints, places.descriptors, keys))


@cache
def matches_of(pairs: int) -> Matches:
    """Matches of pairs; a third of the matches of a pair agree."""
    keys = jax.random.split(jax.random.key(3), 6)
    points = jax.random.uniform(keys[0], (pairs, SLOTS, 2), maxval=SIZE)
    moved = jnp.clip(points + 20 + 5 * jax.random.normal(keys[1], points.shape), 0, SIZE - 1)
    elsewhere = jax.random.uniform(keys[2], points.shape, maxval=SIZE)
    points1 = jnp.where((np.arange(SLOTS) % 3 == 0)[None, :, None], moved, elsewhere)
    distance, scores0, scores1 = (jax.random.uniform(key, (pairs, SLOTS), minval=0.1) for key in keys[3:])
    real = jnp.broadcast_to(jnp.arange(SLOTS) < MATCHES, (pairs, SLOTS))
    size = jnp.full((pairs, 2), float(SIZE))
    return Matches(points, points1, 1.4 * distance, scores0, scores1, real, size, size)


@cache
def database_of(images: int, dimension: int) -> jax.Array:
    """Global descriptors."""
    rows = jax.random.normal(jax.random.key(4), (images, dimension))
    return rows / jnp.linalg.norm(rows, axis=1, keepdims=True)


# --- the steps -----------------------------------------------------------------------------------------------


def product_rate(side: int) -> Timed:
    """Product of square matrices."""
    left, right = (jax.random.normal(jax.random.key(seed), (side, side)) for seed in (0, 1))
    product = jax.jit(jnp.matmul, static_argnames="precision")
    rounded = left.astype(jnp.bfloat16), right.astype(jnp.bfloat16)
    calls = {"float32": ready(product, left, right, precision=EXACT), "JAX's default": ready(product, left, right),
             "bfloat16": ready(product, *rounded)}  # fmt: skip
    return calls | with_torch("product", left, right), 2 * side**3 / 1e12, "TFLOP"


def memory_rate(gigabytes: float) -> Timed:
    """Copy of an array: half of the bytes are read, half are written."""
    array = jnp.ones(int(gigabytes * 1e9 / 8))
    return {"copy": ready(jax.jit(lambda array: array + 1), array)} | with_torch("copy", array), gigabytes, "GB"


def matching(candidates: int, keypoints: int, dimension: int, **options: Any) -> Timed:
    """One query with its candidates: mutual nearest neighbors and their distances."""
    place = places(1, keypoints, dimension)
    query = jax.tree.map(lambda field: field[0], place)
    images = views(jax.tree.map(lambda field: jnp.repeat(field, candidates, axis=0), place))
    sides, match = (query.descriptors, images.descriptors), partial(mfvpr.match_candidates, **options)

    @jax.jit
    def product(query: jax.Array, candidates: jax.Array) -> jax.Array:
        return jnp.einsum("nd,cmd->cnm", query, candidates, precision=EXACT)

    calls = {"mfvpr": ready(match, query, images), "mfvpr, in one jit": ready(jax.jit(match), query, images),
             "bare product": ready(product, *sides)}  # fmt: skip
    calls |= with_torch("match_with_distances", *sides)
    return calls, 2 * candidates * keypoints**2 * dimension / 1e12, "TFLOP"


def scoring(pairs: int, *, name: str) -> Timed:
    """Scores of matches, which a device has to read once."""
    scorer = {"histogram": mfvpr.HistogramOfShifts(max_bins=BINS), "anchor": mfvpr.AnchorPoints(),
              "sum": mfvpr.AggregatedScore()}[name]  # fmt: skip
    m, score = matches_of(pairs), partial(mfvpr.score_candidates, scorer)
    arrays = m.points0, m.points1, m.scores0, m.scores1, m.distance, m.mask

    @jax.jit
    def read(*arrays: jax.Array) -> list[jax.Array]:
        return [jnp.sum(array) for array in arrays]

    calls = {"mfvpr": ready(score, m), "mfvpr, in one jit": ready(jax.jit(score), m), "read": ready(read, *arrays)}
    return calls | with_torch("score", *arrays, scorer=name), pairs / 1e3, "1000 pairs"


def grid(queries: int, candidates: int, *, at_once: bool) -> Timed:
    """1,000 settings of the histogram, for one query after the other, or for all pairs in one call."""
    m, score = matches_of(queries * candidates), partial(mfvpr.score_grid, mfvpr.HistogramOfShifts(), **AXES)
    pairs = queries * candidates if at_once else candidates
    starts = range(0, queries * candidates, pairs)
    parts = [jax.tree.map(lambda field, start=start: field[start : start + pairs], m) for start in starts]
    arrays = m.points1 - m.points0, m.scores0 + m.scores1, m.distance, m.mask
    axes = {"sigmas": AXES["sigma"], "bin_sizes": AXES["bin_size"], "max_distances": AXES["max_distance"]}
    calls = {"mfvpr": ready(lambda: [score(part) for part in parts])}
    calls |= with_torch("grid", *arrays, pairs=pairs, **axes)
    return calls, np.prod([len(axis) for axis in AXES.values()]) * queries * candidates / 1e3, "1000 pairs"


def searching(queries: int, images: int, dimension: int) -> Timed:
    """The nearest global descriptors."""
    database = database_of(images, dimension)
    vectors = database[:queries] + 0.02 * jax.random.normal(jax.random.key(5), (queries, dimension))
    product = jax.jit(partial(jnp.matmul, precision=EXACT))
    search: Callable[..., Any] = ExactSearch().shortlist
    calls = {"mfvpr": ready(mfvpr.retrieve, vectors, database, num_candidates=NEAREST),
             "mfvpr, ExactSearch": partial(search, np.asarray(vectors), database, NEAREST),
             "bare product": ready(product, vectors, database.T)}  # fmt: skip
    calls |= with_torch("search", vectors, database, candidates=NEAREST)
    return calls, 2 * queries * images * dimension / 1e12, "TFLOP"


@cache
def _network(checkpoint: str) -> tuple[Any, dict[str, np.ndarray]]:
    return networks.make_network(checkpoint)


@cache
def _street() -> np.ndarray:
    return networks.make_images(SIZE)


def network(batch: int, *, step: str) -> Timed:
    """A network, from images on the host to features on the host; a dense map stays on the device."""
    contest = next(contest for contest in networks.contests() if contest.step == step)
    model, arrays = _network(contest.checkpoint)
    images = np.stack([networks.resize(image, contest.size) for image in _street()])[np.arange(batch) % len(_street())]
    calls: Calls = {"mfvpr": partial(contest.extractor(model, batch_size=batch), images)}
    if find_spec("torch"):
        calls |= {name: call for _, name, call in networks.torch_entries(contest, arrays, images, (batch,))}
    return calls, batch * GIGAFLOPS[contest.checkpoint] / 1e3, "TFLOP"


def ranking(queries: int, images: int, candidates: int, keypoints: int, dimension: int) -> Timed:
    """From the features of queries and of their candidates to rankings by the histogram."""
    database = places(images, keypoints, dimension)
    rows = jnp.asarray((np.arange(queries)[:, None] + np.arange(candidates)) % images)
    sides, scorer = (views(_rows(database, rows[:, 0])), database), mfvpr.HistogramOfShifts(max_bins=BINS)

    def rank(query: Features, candidates: Features) -> jax.Array:
        return mfvpr.rank(mfvpr.score_candidates(scorer, mfvpr.match_candidates(query, candidates)))

    @jax.jit
    def rank_all(queries: Features, database: Features, rows: jax.Array) -> jax.Array:
        return jax.lax.map(lambda query: rank(query[0], _rows(database, query[1])), (queries, rows))

    first = _rows(sides[0], 0), _rows(database, rows[0])
    calls: Calls = {"mfvpr, in one jit": ready(rank_all, *sides, rows)}
    if queries == 1:
        calls = {"mfvpr": ready(rank, *first), "mfvpr, in one jit": ready(jax.jit(rank), *first)}
    calls |= with_torch("rank", rows, *(field for f in sides for field in (f.keypoints, f.descriptors, f.scores)))
    return calls, 2 * queries * candidates * keypoints**2 * dimension / 1e12, "TFLOP"


def _rows(features: Features, index: Any) -> Features:
    return jax.tree.map(lambda field: field[index], features)


CASES = [
    Case("rates", "product {0} x {0}", product_rate, (8192,), (256,)),
    Case("rates", "copy, {} GB", memory_rate, (4.0,), (0.01,)),
    Case("rates", "copy, {} GB: a call without work", memory_rate, (1e-6,), (1e-6,)),
    Case("matching", "{} x {} x {}", matching, (50, 700, 512), (3, 64, 32)),
    Case("matching", "{} x {} x {}", matching, (1000, 1000, 128), (8, 64, 16)),
    Case("matching", "{} x {} x {}, ratio", partial(matching, with_ratio=True), (50, 700, 512), (3, 64, 32), False),
    Case("matching", "{} x {} x {}, bfloat16", partial(matching, product="bfloat16", chunk_size=1), (50, 700, 512),
         (3, 64, 32), False),
    *(Case("scores", f"{name}, {{:,}} pairs", partial(scoring, name=name), (pairs,), (4,), pairs != 1000)
      for pairs in (50, 1000, 10_000) for name in ("histogram", "anchor", "sum")),
    Case("grids", "1,000 settings, {} queries x {}", partial(grid, at_once=False), (100, 50), (1, 2)),
    Case("grids", "1,000 settings, {} queries x {}, one call", partial(grid, at_once=True), (100, 50), (1, 2), False),
    *(Case("search", "{} in {:,} x {}", searching, (queries, 1_000_000, 512), (3, 2000, 16), queries != 100)
      for queries in (1, 100, 1000)),
    *(Case("networks", f"{step}, batch {{}}", partial(network, step=step), (batch,), (1,), batch != 8)
      for batch in (1, 32, 8)
      for step in (networks.MAP, networks.FEATURES, f"{networks.ALIKED[0]} features", "MixVPR descriptor")),
    Case("queries", "{} query, {} images, {} candidates x {} x {}", ranking, (1, 50, 50, 700, 512), (1, 4, 3, 64, 32)),
    Case("queries", "{} queries, {} images, {} candidates x {} x {}", ranking, (1000, 1000, 50, 700, 512),
         (3, 4, 3, 64, 32)),
]  # fmt: skip
# Group -> seconds that it may take on an accelerator, with compilation; with --quick a fifth. Unused time goes on.
SECONDS = {"correct": 60, "rates": 10, "matching": 35, "scores": 45, "grids": 25, "search": 25, "networks": 70,
           "queries": 25}  # fmt: skip
TIMED = ("case", "who", "ms", "25 %", "75 %", "calls", "/ first", "rate", "per s", "first call, s", "note")
CHECKED = ("what", "reference", "deviation", "allowed", "differ", "entries", "exact")


def run(rounds: int | None, out: Path, groups: Sequence[str] = (), *, is_quick: bool = False) -> dict[str, Any]:
    """Run groups, by default all; print a table after each group, and write all tables so far as JSON to `out`."""
    if unknown := {*groups} - {*SECONDS}:
        raise InputError(f"groups: expected some of {', '.join(SECONDS)}, got {', '.join(sorted(unknown))}")
    device, on_cpu = jax.devices()[0], jax.default_backend() == "cpu"
    report: dict[str, Any] = {
        "matmul_precision": jax.config.values["jax_default_matmul_precision"],
        "torch": version("torch") if find_spec("torch") else None, "is_quick": is_quick, "groups": {},
    }  # fmt: skip
    end = time.monotonic()
    for group in groups or SECONDS:
        start, end = time.monotonic(), end + SECONDS[group] / (5 if is_quick else 1)
        if group == "correct":
            rows, names = list(checks(is_small=on_cpu or is_quick, end=end)), CHECKED
        else:
            cases = [case for case in CASES if case.group == group and (case.is_quick or not is_quick)]
            rows, names = list(time_cases(cases, rounds or ROUNDS, on_cpu=on_cpu, end=end)), TIMED
        peak, seconds = (device.memory_stats() or {}).get("peak_bytes_in_use"), time.monotonic() - start
        report["groups"][group] = {"seconds": seconds, "peak_bytes": peak, "rows": rows}
        table = Table(names, [[_cell(row.get(name, "")) for name in names] for row in rows], text_columns=2)
        write_report(out, f"{group}: {seconds:.1f} s, peak memory {peak} bytes", [table], report)
    return report


def time_cases(cases: Sequence[Case], rounds: int, *, on_cpu: bool, end: float) -> Iterator[dict[str, Any]]:
    """Rows of all calls of cases; a CPU has small sizes, which are the same for some cases."""
    sized = [(case, case.small if on_cpu else case.sizes) for case in cases]
    for title, (case, sizes) in {case.title.format(*sizes): (case, sizes) for case, sizes in sized}.items():
        if time.monotonic() > end:
            yield {"case": title, "note": "skipped: out of time"}
        else:
            yield from time_calls(title, *case.make(*sizes), rounds, end)


def time_calls(title: str, calls: Calls, work: float, unit: str, rounds: int, end: float) -> Iterator[dict[str, Any]]:
    """Time calls in turns, after a first call that compiles; a call that fails says so."""
    rows: dict[str, dict[str, Any]] = {who: {"case": title, "who": who} for who in calls}
    times: dict[str, list[float]] = {}
    for who, call in calls.items():
        try:
            rows[who]["first call, s"] = duration(call)
            times[who] = [duration(call)]
        except Exception as error:  # such as memory that does not suffice: the other calls go on
            rows[who]["note"] = " ".join(f"failed: {error!r}".split())[:80]
    stop = min(time.monotonic() + CASE_SECONDS, end)
    for _ in range(rounds - 1):
        if time.monotonic() < stop:
            for who, seconds in times.items():
                seconds.append(duration(calls[who]))
    medians = {who: float(np.median(seconds)) for who, seconds in times.items()}
    for who, seconds in times.items():
        low, high = (1e3 * float(np.quantile(seconds, share)) for share in (0.25, 0.75))
        rows[who] |= {"ms": 1e3 * medians[who], "25 %": low, "75 %": high, "calls": len(seconds),
                      "/ first": medians[who] / next(iter(medians.values())),
                      "rate": float(work / medians[who]), "per s": unit}  # fmt: skip
    yield from rows.values()


def _cell(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
