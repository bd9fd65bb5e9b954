"""An accelerator beside torch on the same device, and beside the device's own rates: is mfvpr correct and fast there?

`CASES` lists everything that is timed. A case names a function of the case's sizes, which returns the calls to time
and the work that one call does. Arrays are on the device beforehand; only the extractors take images of the host.
"""

import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache, partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import mfvpr
from experiments.benchmark import networks
from experiments.benchmark.harness import duration
from mfvpr.report import Table
from mfvpr.retrieval.search import ExactSearch
from mfvpr.types import Features, Matches
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import write_text
from mfvpr.utils.numerics import available_cpus
from mfvpr.utils.versions import versions

SIZE, BIN, SIGMA = 336, 15.0, 22.5  # px
SLOTS, MATCHED = 384, 300  # of a pair
SHARE = 0.4  # of its keypoints that an image shares with the other view
NEAREST = 50
AXES = {"sigma": np.linspace(8, 40, 10), "bin_size": np.array([10.0, 12.0, 15.0, 20.0, 24.0]),
        "weight": ("fs", "unit"), "max_distance": np.linspace(0.5, 1.4, 10)}  # fmt: skip
GIGAFLOPS = {networks.D2NET: 120.0, networks.MIXVPR: 14.2, networks.ALIKED[0]: 2.1}  # of an image, by XLA
ROUNDS, CASE_SECONDS = 30, 1.5  # timed calls of an implementation, and about how long all of a case may take
HAS_TORCH = find_spec("torch") is not None
EXACT = jax.lax.Precision.HIGHEST

Calls = dict[str, Callable[[], Any]]  # implementation -> call; the others are compared with the first


class Work(NamedTuple):
    """What a call does, in units of `unit` per second: TFLOP, GB or thousands of items."""

    amount: float
    unit: str


class Case(NamedTuple):
    """A step that is timed, with its sizes on an accelerator and on a CPU."""

    group: str
    title: str  # with the sizes in braces
    make: Callable[..., tuple[Calls, Work]]
    sizes: tuple[Any, ...]
    small: tuple[Any, ...]
    is_quick: bool = True


# --- data, on the device -------------------------------------------------------------------------------------


def _unit(rows: jax.Array) -> jax.Array:
    return rows / jnp.linalg.norm(rows, axis=-1, keepdims=True)


def _features(points: jax.Array, descriptors: jax.Array) -> Features:
    shape = points.shape[:-1]
    scores = 100 + 900 * jax.random.uniform(jax.random.key(1), shape)
    return Features(points, descriptors, scores, jnp.ones(shape, bool), jnp.full((*shape[:-1], 2), float(SIZE)))


@partial(jax.jit, static_argnums=(0, 1, 2))
def _images(count: int, keypoints: int, dimension: int, seed: int) -> Features:
    """Features of images that have nothing in common; descriptors are non-negative like those of D2-Net."""
    key0, key1 = jax.random.split(jax.random.key(seed))
    descriptors = jnp.maximum(jax.random.normal(key1, (count, keypoints, dimension)), 0)
    return _features(jax.random.uniform(key0, (count, keypoints, 2), maxval=SIZE), _unit(descriptors))


@jax.jit
def _views(places: Features) -> Features:
    """Another view of each image: some keypoints move together, with noise; the others are new."""
    key0, key1, key2 = jax.random.split(jax.random.key(2), 3)
    others = jax.random.normal(key0, places.descriptors.shape) / places.descriptors.shape[-1] ** 0.5
    is_common = jnp.arange(places.mask.shape[-1]) < SHARE * places.mask.shape[-1]
    descriptors = jnp.where(is_common[:, None], places.descriptors + 0.5 * others, jnp.maximum(others, 0))
    moved = places.keypoints + 20 + 4 * jax.random.normal(key1, places.keypoints.shape)
    elsewhere = jax.random.uniform(key2, places.keypoints.shape, maxval=SIZE)
    points = jnp.clip(jnp.where(is_common[:, None], moved, elsewhere), 0, SIZE - 1)
    order = np.random.default_rng(0).permutation(places.mask.shape[-1])
    return _features(points[..., order, :], _unit(jnp.maximum(descriptors, 0))[..., order, :])


@cache
def shortlist_of(candidates: int, keypoints: int, dimension: int) -> tuple[Features, Features]:
    """A query, and candidates that share keypoints with it."""
    images = _images(1, keypoints, dimension, 0)
    query = jax.tree.map(lambda field: field[0], images)
    return query, _views(jax.tree.map(lambda field: jnp.repeat(field, candidates, axis=0), images))


@cache
def matches_of(pairs: int) -> Matches:
    """Matches of pairs; a third of the matches of a pair agree."""

    @jax.jit
    def make() -> Matches:
        keys = jax.random.split(jax.random.key(3), 6)
        points = jax.random.uniform(keys[0], (pairs, SLOTS, 2), maxval=SIZE)
        moved = jnp.clip(points + 20 + 5 * jax.random.normal(keys[1], points.shape), 0, SIZE - 1)
        elsewhere = jax.random.uniform(keys[2], points.shape, maxval=SIZE)
        distance, scores0, scores1 = (jax.random.uniform(key, (pairs, SLOTS), minval=0.1) for key in keys[3:])
        real = jnp.broadcast_to(jnp.arange(SLOTS) < MATCHED, (pairs, SLOTS))
        points1 = jnp.where((jnp.arange(SLOTS) % 3 == 0)[:, None], moved, elsewhere)
        size = jnp.full((pairs, 2), float(SIZE))
        return Matches(points, points1, 1.4 * distance, scores0, scores1, real, size, size)

    return jax.block_until_ready(make())


def ready(function: Callable[..., Any], *inputs: Any, **options: Any) -> Callable[[], Any]:
    """Call of JAX that waits for its result."""
    return lambda: jax.block_until_ready(function(*inputs, **options))


def with_torch(calls: Callable[..., Calls], *arrays: jax.Array) -> Calls:
    """Calls of torch on the same arrays, which are not copied; products are of float32, without TF32."""
    if not HAS_TORCH:
        return {}
    import torch

    is_cuda = jax.default_backend() in ("gpu", "cuda")
    if is_cuda and not torch.cuda.is_available():
        return {}
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = False
    tensors = [torch.from_dlpack(array) for array in jax.block_until_ready(arrays)]

    def wait(call: Callable[[], Any]) -> Any:
        with torch.inference_mode():
            result = call()
        if is_cuda:
            torch.cuda.synchronize()
        return result

    return {name: partial(wait, call) for name, call in calls(torch, *tensors).items()}


# --- the steps -----------------------------------------------------------------------------------------------


def bare_product(side: int) -> tuple[Calls, Work]:
    """Square matrices."""
    left, right = (jax.random.normal(jax.random.key(seed), (side, side)) for seed in (0, 1))
    product = jax.jit(jnp.matmul, static_argnames="precision")
    rounded = left.astype(jnp.bfloat16), right.astype(jnp.bfloat16)
    calls = {"float32": ready(product, left, right, precision=EXACT), "JAX's default": ready(product, left, right),
             "bfloat16": ready(product, *rounded)}  # fmt: skip
    calls |= with_torch(lambda _, left, right: {"torch, float32": lambda: left @ right}, left, right)
    return calls, Work(2 * side**3 / 1e12, "TFLOP")


def bare_memory(gigabytes: float) -> tuple[Calls, Work]:
    """Read an array, or copy it, which reads and writes."""
    array = jnp.ones(int(gigabytes * 1e9 / 8))
    calls = {"copy half": ready(jax.jit(lambda array: array + 1), array)}
    calls |= with_torch(lambda _, array: {"torch, copy half": lambda: array + 1}, array)
    return calls | {"empty call": ready(jax.jit(lambda array: array + 1), jnp.ones(8))}, Work(gigabytes, "GB")


def matching(candidates: int, keypoints: int, dimension: int, **options: Any) -> tuple[Calls, Work]:
    """One query with its candidates: mutual nearest neighbors and their distances."""
    query, images = shortlist_of(candidates, keypoints, dimension)
    sides = query.descriptors, images.descriptors
    match = partial(mfvpr.match_candidates, **options)

    def product(query: jax.Array, candidates: jax.Array) -> jax.Array:
        return jnp.max(jnp.einsum("nd,cmd->cnm", query, candidates, precision=EXACT), axis=(1, 2))

    def calls(torch: Any, query: Any, candidates: Any) -> Calls:
        from experiments.benchmark import torch_scores

        def match() -> tuple[Any, ...]:
            nearest, mutual = torch_scores.match(query, candidates)
            return nearest, mutual, torch.linalg.vector_norm(query - torch_scores.take(candidates, nearest), dim=2)

        return {"torch": match}

    return {
        "mfvpr": ready(match, query, images),
        "mfvpr, in one jit": ready(jax.jit(match), query, images),
        "bare product": ready(jax.jit(product), *sides),
    } | with_torch(calls, *sides), Work(2 * candidates * keypoints**2 * dimension / 1e12, "TFLOP")


def scoring(pairs: int, *, scorer: Any) -> tuple[Calls, Work]:
    """Scores of matches. The least a device has to do is to read the matches once."""
    matches, capacity = matches_of(pairs), int(2 * SIZE / BIN) + 1
    fixed = replace(scorer, max_bins=capacity) if hasattr(scorer, "max_bins") else scorer
    arrays = (matches.points0, matches.points1, matches.scores0, matches.scores1, matches.distance, matches.mask)

    def read(arrays: Sequence[jax.Array]) -> jax.Array:
        return sum((jnp.sum(array.astype(jnp.float32)) for array in arrays), start=jnp.zeros(()))

    def calls(torch: Any, points0: Any, points1: Any, scores0: Any, scores1: Any, distance: Any, mask: Any) -> Calls:
        from experiments.benchmark import torch_scores

        centers = torch.arange(-SIZE + BIN / 2, SIZE, BIN, device=points0.device)
        functions = {
            "HistogramOfShifts": lambda weights: torch_scores.histogram(points1 - points0, weights, centers, SIGMA),
            "AnchorPoints": lambda weights: torch_scores.anchor(points0, points1, weights, SIZE),
            "AggregatedScore": lambda weights: torch_scores.aggregate(points1 - points0, weights, mask, SIZE),
        }
        weight = (lambda: 2 - distance) if isinstance(scorer, mfvpr.AggregatedScore) else (lambda: scores0 + scores1)
        return {"torch": lambda: functions[type(scorer).__name__](torch.where(mask, weight(), 0.0))}

    return {
        "mfvpr": ready(mfvpr.score_candidates, scorer, matches),
        "mfvpr, in one jit": ready(jax.jit(partial(mfvpr.score_candidates, fixed)), matches),
        "read the matches": ready(jax.jit(read), arrays),
    } | with_torch(calls, *arrays), Work(pairs / 1e3, "1000 pairs")


def grid(queries: int, candidates: int, *, at_once: bool) -> tuple[Calls, Work]:
    """1,000 settings of the histogram."""
    matches, scorer = matches_of(queries * candidates), mfvpr.HistogramOfShifts()
    starts = [0] if at_once else range(0, queries * candidates, candidates)
    parts = [jax.tree.map(lambda field: field[start : start + len(matches.mask) // len(starts)], matches)  # noqa: B023
             for start in starts]  # fmt: skip
    arrays = matches.points1 - matches.points0, matches.scores0 + matches.scores1, matches.distance, matches.mask

    def calls(torch: Any, *tensors: Any) -> Calls:
        from experiments.benchmark import torch_scores

        distances = torch.tensor(AXES["max_distance"], device=tensors[0].device, dtype=torch.float32)
        centers = [torch.arange(-SIZE + size / 2, SIZE, size, device=tensors[0].device) for size in AXES["bin_size"]]

        def score() -> list[Any]:
            scores = []
            for start in range(0, queries * candidates, candidates):
                shifts, sums, distance, mask = (tensor[start : start + candidates] for tensor in tensors)
                near = ((distance[:, None] <= distances[:, None]) & mask[:, None]).float()
                weights = torch.cat([sums[:, None] * near, near], 1)
                scores += [torch_scores.histogram(shifts, weights, center, sigma)
                           for center in centers for sigma in AXES["sigma"]]  # fmt: skip
            return scores

        return {"torch": score}

    score = partial(mfvpr.score_grid, scorer, **AXES)
    settings = int(np.prod([len(axis) for axis in AXES.values()]))
    our_calls = {"mfvpr": ready(lambda: [score(part) for part in parts])}
    return our_calls | with_torch(calls, *arrays), Work(settings * queries * candidates / 1e3, "1000 pairs")


@cache
def database_of(images: int, dimension: int) -> jax.Array:
    """Global descriptors."""
    return jax.jit(lambda: _unit(jax.random.normal(jax.random.key(4), (images, dimension))))()


def searching(queries: int, images: int, dimension: int) -> tuple[Calls, Work]:
    """The nearest global descriptors."""
    database = database_of(images, dimension)
    vectors = _unit(database[:queries] + 0.02 * jax.random.normal(jax.random.key(5), (queries, dimension)))

    def product(queries: jax.Array, database: jax.Array) -> jax.Array:
        return jnp.max(jnp.matmul(queries, database.T, precision=EXACT), axis=1)

    def calls(_: Any, *sides: Any) -> Calls:
        from experiments.benchmark import torch_scores

        return {"torch": partial(torch_scores.search, *sides, NEAREST)}

    search = ExactSearch().shortlist
    return {
        "mfvpr": ready(mfvpr.retrieve, vectors, database, num_candidates=NEAREST),
        "mfvpr, ExactSearch": partial(search, np.asarray(vectors), database, NEAREST),  # pyright: ignore
        "bare product": ready(jax.jit(product), vectors, database),
    } | with_torch(calls, vectors, database), Work(2 * queries * images * dimension / 1e12, "TFLOP")


@cache
def _network(checkpoint: str) -> tuple[Any, Any]:
    return networks.make_network(checkpoint)


@cache
def _street() -> np.ndarray:
    return networks.make_images(SIZE)


def network(batch: int, *, step: str) -> tuple[Calls, Work]:
    """A network, from images of the host to features of the host; the dense map stays on the device."""
    contest = next(contest for contest in networks.contests() if contest.step == step)
    model, arrays = _network(contest.checkpoint)
    images = np.stack([networks.resize(image, contest.size) for image in _street()])[np.arange(batch) % len(_street())]
    calls: Calls = {"mfvpr": partial(contest.extractor(model, batch_size=batch), images)}
    if HAS_TORCH and contest.peer:
        calls |= {name: call for _, name, call in networks.torch_entries(contest, arrays, images, (batch,))}
    return calls, Work(batch * GIGAFLOPS[contest.checkpoint] / 1e3, "TFLOP")


def query(queries: int, images: int, candidates: int, keypoints: int, dimension: int) -> tuple[Calls, Work]:
    """From the features of queries and of their candidates to rankings by the histogram."""
    database = _images(images, keypoints, dimension, 6)
    rows = (jnp.arange(queries)[:, None] + jnp.arange(candidates)) % images
    views = _views(jax.tree.map(lambda field: field[rows[:, 0]], database))
    scorer = mfvpr.HistogramOfShifts(max_bins=int(2 * SIZE / BIN) + 1)

    def take(features: Features, index: Any) -> Features:
        return jax.tree.map(lambda field: field[index], features)

    def rank_one(query: Features, candidates: Features) -> jax.Array:
        return mfvpr.rank(mfvpr.score_candidates(scorer, mfvpr.match_candidates(query, candidates)))

    def rank_all(views: Features, database: Features, rows: jax.Array) -> jax.Array:
        return jax.lax.map(lambda one: rank_one(one[0], take(database, one[1])), (views, rows))

    def calls(torch: Any, rows: Any, *tensors: Any) -> Calls:
        from experiments.benchmark import torch_scores

        centers = torch.arange(-SIZE + BIN / 2, SIZE, BIN, device=rows.device)
        views, database = tensors[:3], tensors[3:]

        def rank() -> list[Any]:
            ranks = []
            for number in range(queries):
                (points0, query, scores0), row = (field[number] for field in views), rows[number]
                points1, others, scores1 = (field[row] for field in database)
                nearest, mutual = torch_scores.match(query, others)
                shifts = torch_scores.take(points1, nearest) - points0
                weights = torch.where(mutual, scores0 + torch.gather(scores1, 1, nearest), 0.0)
                ranks.append(torch_scores.histogram(shifts, weights, centers, SIGMA).argsort(descending=True))
            return ranks

        return {"torch": rank}

    one, others = take(views, 0), take(database, rows[0])
    arrays = [field for side in (views, database) for field in (side.keypoints, side.descriptors, side.scores)]
    calls_of_one = ready(rank_one, one, others), ready(jax.jit(rank_one), one, others)
    our_calls: Calls = dict(zip(("mfvpr", "mfvpr, in one jit"), calls_of_one, strict=True))
    if queries > 1:
        our_calls = {"mfvpr": ready(jax.jit(rank_all), views, database, rows)}
    product = Work(2 * queries * candidates * keypoints**2 * dimension / 1e12, "TFLOP")
    return our_calls | with_torch(calls, rows, *arrays), product


HISTOGRAM, ANCHOR, SUM = (
    partial(scoring, scorer=scorer)
    for scorer in (mfvpr.HistogramOfShifts(), mfvpr.AnchorPoints(), mfvpr.AggregatedScore())
)
CASES = [
    Case("rates", "product {0} x {0}", bare_product, (8192,), (256,)),
    Case("rates", "memory {} GB", bare_memory, (4.0,), (0.01,)),
    Case("matching", "{} x {} x {}", matching, (50, 700, 512), (3, 64, 32)),
    Case("matching", "{} x {} x {}", matching, (1000, 1000, 128), (8, 64, 16)),
    Case("matching", "{} x {} x {}, with ratio", partial(matching, with_ratio=True), (50, 700, 512), (3, 64, 32)),
    Case("matching", "{} x {} x {}, bfloat16", partial(matching, product="bfloat16", chunk_size=1), (50, 700, 512),
         (3, 64, 32), False),
    *(Case("scores", f"{name}, {{:,}} pairs", step, (pairs,), (pairs // 50 or 1,), pairs != 1000)
      for pairs in (50, 1000, 10_000)
      for name, step in (("histogram", HISTOGRAM), ("anchor", ANCHOR), ("sum", SUM))),
    Case("grids", "1,000 settings, {} queries x {}", partial(grid, at_once=False), (100, 50), (1, 2)),
    Case("grids", "1,000 settings, {} queries x {}, in one call", partial(grid, at_once=True), (100, 50), (1, 2),
         False),
    *(Case("search", "{} in {:,} x {}", searching, (queries, 1_000_000, 512), (queries, 2000, 16), queries != 100)
      for queries in (1, 100, 1000)),
    *(Case("networks", f"{step}, batch {{}}", partial(network, step=step), (batch,), (1,), batch == 8)
      for batch in (1, 32, 8)
      for step in (networks.MAP, networks.FEATURES, f"{networks.ALIKED[0]} features", "MixVPR descriptor")),
    Case("queries", "{} query, {} images, {} candidates x {} x {}", query, (1, 50, 50, 700, 512), (1, 4, 3, 64, 32)),
    Case("queries", "{} queries, {} images, {} candidates x {} x {}", query, (1000, 1000, 50, 700, 512),
         (3, 4, 3, 64, 32), False),
]  # fmt: skip
TIMED = ("case", "who", "ms", "25 %", "75 %", "calls", "/ first", "rate", "per s", "first call, s", "note")
CHECKED = ("what", "reference", "deviation", "allowed", "differ", "entries", "exact")
# Group -> seconds that it may take on an accelerator, with compilation; with --quick a fifth.
SECONDS = {"correct": 75, "rates": 10, "matching": 35, "scores": 40, "grids": 25, "search": 25, "networks": 60,
           "queries": 30}  # fmt: skip


# --- the run -------------------------------------------------------------------------------------------------


def run(rounds: int | None, out: Path, groups: Sequence[str] = (), *, is_quick: bool = False) -> dict[str, Any]:
    """Run groups, by default all; print a table after each group, and write all tables so far as JSON to `out`."""
    if unknown := {*groups} - {*SECONDS}:
        raise InputError(f"group: expected {', '.join(SECONDS)}, got {', '.join(sorted(unknown))}")
    device, on_cpu = jax.devices()[0], jax.default_backend() == "cpu"
    report: dict[str, Any] = {"machine": _machine(), "versions": versions(), "quick": is_quick, "groups": {}}
    print(report["machine"], report["versions"], sep="\n", flush=True)
    end = time.monotonic()
    for group in groups or SECONDS:
        start, end = time.monotonic(), end + SECONDS[group] / (5 if is_quick else 1)
        if group == "correct":
            from experiments.benchmark.accelerator_checks import checks

            rows, names = list(checks(is_small=on_cpu or is_quick, end=end)), CHECKED
        else:
            rows, names = list(_rows(group, rounds or ROUNDS, is_quick=is_quick, on_cpu=on_cpu, end=end)), TIMED
        table = Table(names, [[_cell(row.get(name, "")) for name in names] for row in rows], text_columns=2)
        peak = (device.memory_stats() or {}).get("peak_bytes_in_use")
        report["groups"][group] = {"seconds": time.monotonic() - start, "peak_bytes": peak, "rows": rows}
        memory = "" if peak is None else f", at most {peak / 1e9:.2f} GB so far"
        print(f"\n{group}: {time.monotonic() - start:.1f} s{memory}", table.text(), sep="\n", flush=True)
        write_text(out, json.dumps(report, indent=1) + "\n")
    print(f"results: {out}", flush=True)
    return report


def _machine() -> dict[str, Any]:
    machine = {"device": jax.devices()[0].device_kind, "backend": jax.default_backend(), "cores": available_cpus(),
               "matmul precision": jax.config.values["jax_default_matmul_precision"]}  # fmt: skip
    if HAS_TORCH:
        import torch

        machine |= {"torch": torch.__version__, "torch's CUDA": torch.version.cuda}
    return machine


def _rows(group: str, rounds: int, *, is_quick: bool, on_cpu: bool, end: float) -> Iterator[dict[str, Any]]:
    """Time the cases of a group; a CPU has small sizes, which are the same for some cases."""
    cases = [case for case in CASES if case.group == group and (case.is_quick or not is_quick)]
    sized = [(case, case.small if on_cpu else case.sizes) for case in cases]
    for title, (case, sizes) in {case.title.format(*sizes): (case, sizes) for case, sizes in sized}.items():
        if time.monotonic() > end:
            yield {"case": title, "note": "skipped: out of time"}
        else:
            yield from _time(title, *case.make(*sizes), rounds, end)


def _time(title: str, calls: Calls, work: Work, rounds: int, end: float) -> Iterator[dict[str, Any]]:
    """Time calls in turns; a call that fails says so."""
    rows: dict[str, dict[str, Any]] = {who: {"case": title, "who": who} for who in calls}
    times: dict[str, list[float]] = {}
    for who, call in calls.items():
        try:
            rows[who]["first call, s"] = duration(call)
            times[who] = [duration(call)]
        except Exception as error:  # such as memory that does not suffice: the other calls go on
            rows[who]["note"] = " ".join(f"failed: {error!r}".split())[:80]
    stop = min(time.monotonic() + CASE_SECONDS, end)
    while times and len(next(iter(times.values()))) < rounds and time.monotonic() < stop:
        for who, seconds in times.items():
            seconds.append(duration(calls[who]))
    medians = {who: float(np.median(seconds)) for who, seconds in times.items()}
    for who, seconds in times.items():
        rows[who] |= {"ms": 1e3 * medians[who], "25 %": 1e3 * float(np.quantile(seconds, 0.25)),
                      "75 %": 1e3 * float(np.quantile(seconds, 0.75)), "calls": len(seconds),
                      "/ first": medians[who] / next(iter(medians.values())),
                      "rate": work.amount / medians[who], "per s": work.unit}  # fmt: skip
    yield from rows.values()


def _cell(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
