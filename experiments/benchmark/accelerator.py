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
from experiments.benchmark.harness import duration, ready, write_report
from mfvpr.core.types import Features, Matches
from mfvpr.report import Table
from mfvpr.utils.errors import InputError

SIZE, BINS = 336, 45  # px; bins of the histogram per axis
SLOTS, MATCHES, SHARE = 384, 300, 0.4  # of a pair; share of the keypoints that two views of a place have in common
NEAREST = 50
AXES = {"sigma": np.linspace(8, 40, 25), "bin_size": np.array([10.0, 15.0]), "weight": ("fs", "unit"),
        "max_distance": np.linspace(0.5, 1.4, 10)}  # fmt: skip
GIGAFLOPS = {networks.D2NET: 120.0, networks.MIXVPR: 14.2, networks.ALIKED[0]: 2.1}  # of an image, by XLA
ROUNDS, LEAST_ROUNDS, CASE_SECONDS = 30, 3, 1.0  # timed calls; a case has more than the least for about this time
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
    is_quick: bool = False


def with_torch(function: str, *arrays: jax.Array, **options: Any) -> Calls:
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
            result = getattr(torch_scores, function)(*tensors, **options)
        if on_gpu:
            torch.cuda.synchronize()
        return result

    return {"torch": call}


@cache
@partial(jax.jit, static_argnums=(0, 1, 2))
def scene(images: int, keypoints: int, dimension: int) -> tuple[Features, Features]:
    """Features of images, and of another view of each: some keypoints move together, the others are new."""
    keys = jax.random.split(jax.random.key(0, impl="rbg"), 6)
    shape, is_common = (images, keypoints), (np.arange(keypoints) < SHARE * keypoints)[None, :, None]
    points, elsewhere = (jax.random.uniform(key, (*shape, 2), maxval=SIZE) for key in keys[:2])
    rows, new_rows = (jax.random.normal(key, (*shape, dimension)) for key in keys[2:4])
    moved = jnp.clip(points + 20 + 4 * jax.random.normal(keys[4], points.shape), 0, SIZE - 1)
    scores, size = jax.random.uniform(keys[5], shape, minval=100, maxval=1000), jnp.full((images, 2), float(SIZE))

    def features(points: jax.Array, rows: jax.Array) -> Features:
        rows = jnp.maximum(rows, 0)  # as D2-Net's
        rows = rows / jnp.linalg.norm(rows, axis=-1, keepdims=True)
        return Features(points, rows, scores, jnp.ones(shape, bool), size)

    order = np.random.default_rng(0).permutation(keypoints)
    view = jnp.where(is_common, moved, elsewhere), jnp.where(is_common, rows + 0.5 * new_rows, new_rows)
    return features(points, rows), features(*(values[:, order] for values in view))


@cache
@partial(jax.jit, static_argnums=0)
def matches_of(pairs: int) -> Matches:
    """Matches of pairs; a third of the matches of a pair agree."""
    keys = jax.random.split(jax.random.key(1, impl="rbg"), 6)
    points, elsewhere = (jax.random.uniform(key, (pairs, SLOTS, 2), maxval=SIZE) for key in keys[:2])
    moved = jnp.clip(points + 20 + 5 * jax.random.normal(keys[2], points.shape), 0, SIZE - 1)
    points1 = jnp.where((np.arange(SLOTS) % 3 == 0)[None, :, None], moved, elsewhere)
    distance, scores0, scores1 = (jax.random.uniform(key, (pairs, SLOTS), minval=0.1) for key in keys[3:])
    real, size = jnp.broadcast_to(jnp.arange(SLOTS) < MATCHES, (pairs, SLOTS)), jnp.full((pairs, 2), float(SIZE))
    return Matches(points, points1, 1.4 * distance, scores0, scores1, real, size, size)


@cache
@partial(jax.jit, static_argnums=(0, 1))
def database_of(images: int, dimension: int) -> jax.Array:
    """Global descriptors."""
    rows = jax.random.normal(jax.random.key(2, impl="rbg"), (images, dimension))
    return rows / jnp.linalg.norm(rows, axis=1, keepdims=True)


def rows_of(features: Features, index: Any) -> Features:
    """Features of some images."""
    return jax.tree.map(lambda field: field[index], features)


def product_rate(side: int) -> Timed:
    """Product of square matrices."""
    left = right = jax.random.normal(jax.random.key(3), (side, side))
    product, rounded = jax.jit(jnp.matmul, static_argnames="precision"), left.astype(jnp.bfloat16)
    calls = {"float32": ready(product, left, right, precision=EXACT), "JAX's default": ready(product, left, right)}
    calls["bfloat16"] = ready(product, rounded, rounded)
    return calls | with_torch("product", left, right), 2 * side**3 / 1e12, "TFLOP"


def memory_rate(gigabytes: float) -> Timed:
    """Copy of an array: half of the bytes are read, half are written."""
    array = jnp.ones(int(gigabytes * 1e9 / 8))
    return {"copy": ready(jax.jit(lambda array: array + 1), array)} | with_torch("copy", array), gigabytes, "GB"


def matching(candidates: int, keypoints: int, dimension: int, *, with_ratio: bool = False) -> Timed:
    """One query with its candidates: mutual nearest neighbors and their distances."""
    images, views = scene(candidates, keypoints, dimension)
    query, match = rows_of(views, 0), partial(mfvpr.match_candidates, with_ratio=with_ratio)
    sides = query.descriptors, images.descriptors
    product = jax.jit(partial(jnp.einsum, "nd,cmd->cnm", precision=EXACT))
    calls: Calls = {"mfvpr": ready(match, query, images)}
    if not with_ratio:
        calls |= {"mfvpr, in one jit": ready(jax.jit(match), query, images), "bare product": ready(product, *sides)}
        calls |= with_torch("match_with_distances", *sides)
    return calls, 2 * candidates * keypoints**2 * dimension / 1e12, "TFLOP"


def scoring(pairs: int, *, name: str) -> Timed:
    """Scores of matches, which a device has to read once."""
    histogram, anchor, aggregated = (
        mfvpr.HistogramOfShifts(max_bins=BINS),
        mfvpr.AnchorPoints(),
        mfvpr.AggregatedScore(),
    )
    scorer = {"histogram": histogram, "anchor": anchor, "sum": aggregated}[name]
    m, score = matches_of(pairs), partial(mfvpr.score_candidates, scorer)
    arrays = m.points0, m.points1, m.scores0, m.scores1, m.distance, m.mask
    read = jax.jit(lambda *arrays: [jnp.sum(array) for array in arrays])
    calls = {"mfvpr": ready(score, m), "mfvpr, in one jit": ready(jax.jit(score), m), "read": ready(read, *arrays)}
    return calls | with_torch("score", *arrays, scorer=name), pairs / 1e3, "1000 pairs"


def grid(queries: int, candidates: int) -> Timed:
    """1,000 settings of the histogram for all pairs."""
    m = matches_of(queries * candidates)
    arrays = m.points1 - m.points0, m.scores0 + m.scores1, m.distance, m.mask
    axes = {"sigmas": AXES["sigma"], "bin_sizes": AXES["bin_size"], "max_distances": AXES["max_distance"]}
    calls = {"mfvpr": ready(mfvpr.score_grid, mfvpr.HistogramOfShifts(), m, **AXES)}
    calls |= with_torch("grid", *arrays, **axes)
    return calls, np.prod([len(axis) for axis in AXES.values()]) * queries * candidates / 1e3, "1000 pairs"


def searching(queries: int, images: int, dimension: int) -> Timed:
    """The nearest global descriptors."""
    database = database_of(images, dimension)
    vectors = database[:queries] + 0.02 * jax.random.normal(jax.random.key(4), (queries, dimension))
    product = jax.jit(partial(jnp.einsum, "qd,nd->qn", precision=EXACT))
    calls = {"mfvpr": ready(mfvpr.retrieve, vectors, database, num_candidates=NEAREST)}
    calls |= {"bare product": ready(product, vectors, database)} | with_torch(
        "search", vectors, database, candidates=NEAREST
    )
    return calls, 2 * queries * images * dimension / 1e12, "TFLOP"


_network, _images = cache(networks.make_network), cache(networks.make_images)


def network(batch: int, *, step: str) -> Timed:
    """A network, from images on the host to features on the host; a dense map stays on the device."""
    contest = next(contest for contest in networks.contests() if contest.step == step)
    model, arrays = _network(contest.checkpoint)
    street = np.stack([networks.resize(image, contest.size) for image in _images(SIZE)])
    images = street[np.arange(batch) % len(street)]
    calls: Calls = {"mfvpr": partial(contest.extractor(model, batch_size=batch), images)}
    if find_spec("torch"):
        entries = networks.torch_entries(contest, arrays, images, (batch,))
        calls |= {name: call for _, name, call in entries if "channels last" not in name}
    return calls, batch * GIGAFLOPS[contest.checkpoint] / 1e3, "TFLOP"


def ranking(queries: int, candidates: int, keypoints: int, dimension: int) -> Timed:
    """From the features of queries and of their candidates to rankings by the histogram."""
    images, views = scene(candidates, keypoints, dimension)
    rows = jnp.asarray((np.arange(queries)[:, None] + np.arange(candidates)) % candidates)
    scorer = mfvpr.HistogramOfShifts(max_bins=BINS)

    def rank(query: Features, candidates: Features) -> jax.Array:
        return mfvpr.rank(mfvpr.score_candidates(scorer, mfvpr.match_candidates(query, candidates)))

    @jax.jit
    def rank_all(views: Features, images: Features, rows: jax.Array) -> jax.Array:
        return jax.lax.map(lambda row: rank(rows_of(views, row[0]), rows_of(images, row)), rows)

    calls: Calls = {"mfvpr": ready(rank, rows_of(views, 0), images)} if queries == 1 else {}
    calls |= {"mfvpr, in one jit": ready(rank_all, views, images, rows)}
    fields = [field for side in (views, images) for field in (side.keypoints, side.descriptors, side.scores)]
    calls |= with_torch("rank", rows, *fields)
    return calls, 2 * queries * candidates * keypoints**2 * dimension / 1e12, "TFLOP"


CASES = [
    Case("rates", "product {0} x {0}", product_rate, (8192,), (256,), True),
    Case("rates", "copy, {} GB", memory_rate, (4.0,), (0.01,)),
    Case("rates", "call without work", memory_rate, (1e-6,), (1e-6,)),
    Case("matching", "{} x {} x {}", matching, (50, 700, 512), (3, 64, 32), True),
    Case("matching", "{} x {} x {}", matching, (1000, 1000, 128), (8, 64, 16)),
    Case("matching", "{} x {} x {}, ratio", partial(matching, with_ratio=True), (50, 700, 512), (3, 64, 32)),
    *(Case("scores", f"{name}, {{:,}} pairs", partial(scoring, name=name), (pairs,), (4,), (name, pairs) == ("sum", 50))
      for pairs in (50, 1000, 10_000) for name in ("histogram", "anchor", "sum")),
    Case("grids", "1,000 settings, {} queries x {}", grid, (100, 50), (1, 2), True),
    *(Case("search", "{} in {:,} x {}", searching, (queries, 1_000_000, 512), (3, 2000, 16), queries == 1)
      for queries in (1, 100, 1000)),
    *(Case("networks", f"{step}, batch {{}}", partial(network, step=step), (batch,), (1,), (step, batch) == (aliked, 8))
      for batch in (1, 8, 32) for aliked in [f"{networks.ALIKED[0]} features"]
      for step in (networks.MAP, networks.FEATURES, aliked, "MixVPR descriptor")
      if (step, batch) != (networks.FEATURES, 32)),
    Case("queries", "{} query x {} x {} x {}", ranking, (1, 50, 700, 512), (1, 3, 64, 32), True),
    Case("queries", "{} queries x {} x {} x {}", ranking, (1000, 50, 700, 512), (3, 3, 64, 32)),
]  # fmt: skip
# Group -> seconds that it needs on an accelerator, mostly to compile; time that is left goes to the groups after it.
SECONDS = {"rates": 20, "correct": 50, "matching": 45, "scores": 35, "grids": 35, "search": 25, "networks": 65,
           "queries": 20}  # fmt: skip
QUICK_SECONDS = 12
TIMED = ("case", "who", "ms", "25 %", "75 %", "calls", "/ first", "rate", "per s", "first call, s", "note")
CHECKED = ("what", "reference", "deviation", "allowed", "differ", "entries", "exact")


def run(rounds: int | None, out: Path, groups: Sequence[str] = (), *, is_quick: bool = False) -> dict[str, Any]:
    """Run groups, by default all; print a table after each group, and write all tables so far as JSON to `out`."""
    if unknown := {*groups} - {*SECONDS}:
        raise InputError(f"groups: expected some of {', '.join(SECONDS)}, got {', '.join(sorted(unknown))}")
    on_cpu, end, group_reports = jax.default_backend() == "cpu", time.monotonic(), {}
    report = {"torch": version("torch") if find_spec("torch") else None, "is_quick": is_quick, "groups": group_reports}
    report["matmul_precision"] = jax.config.values["jax_default_matmul_precision"]
    for group in groups or SECONDS:
        start, end = time.monotonic(), end + (QUICK_SECONDS if is_quick else SECONDS[group])
        if group == "correct":
            rows, names = list(checks(is_small=on_cpu or is_quick, end=end)), CHECKED
        else:
            cases = [case for case in CASES if case.group == group and (case.is_quick or not is_quick)]
            rows, names = list(time_cases(cases, rounds or ROUNDS, on_cpu=on_cpu, end=end)), TIMED
        seconds, first_calls = time.monotonic() - start, sum(row.get("first call, s", 0) for row in rows)
        peak = (jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use")
        group_reports[group] = {"seconds": seconds, "first_calls_s": first_calls, "peak_bytes": peak, "rows": rows}
        table = Table(names, [[_cell(row.get(name, "")) for name in names] for row in rows], text_columns=2)
        title = f"{group}: {seconds:.1f} s, of first calls {first_calls:.1f} s; "
        title += "no GPU: sizes are tiny, and times mean nothing" if on_cpu else f"peak memory so far {peak} bytes"
        write_report(out, title, [table], report)
    return report


def time_cases(cases: Sequence[Case], rounds: int, *, on_cpu: bool, end: float) -> Iterator[dict[str, Any]]:
    """Rows of all calls of cases; a CPU has small sizes, which are the same for some cases."""
    sized = [(case, case.small if on_cpu else case.sizes) for case in cases]
    for title, (case, sizes) in {case.title.format(*sizes): (case, sizes) for case, sizes in sized}.items():
        if time.monotonic() > end:
            yield {"case": title, "note": "skipped: out of time"}
        else:
            yield from time_calls(title, *case.make(*sizes), rounds)


def time_calls(title: str, calls: Calls, work: float, unit: str, rounds: int) -> Iterator[dict[str, Any]]:
    """Time calls in turns, after a first call that compiles; a call that fails says so."""
    rows: dict[str, dict[str, Any]] = {name: {"case": title, "who": name} for name in calls}
    times: dict[str, list[float]] = {}
    for name, call in calls.items():
        try:
            rows[name]["first call, s"] = duration(call)
            times[name] = []
        except Exception as error:  # such as memory that does not suffice: the other calls go on
            rows[name]["note"] = " ".join(f"failed: {error!r}".split())[:80]
    stop = time.monotonic() + CASE_SECONDS
    for number in range(rounds):
        if number < LEAST_ROUNDS or time.monotonic() < stop:
            for name, seconds in times.items():
                seconds.append(duration(calls[name]))
    medians = {name: float(np.median(seconds)) for name, seconds in times.items()}
    for name, seconds in times.items():
        low, high = (1e3 * float(np.quantile(seconds, share)) for share in (0.25, 0.75))
        rows[name] |= {"ms": 1e3 * medians[name], "25 %": low, "75 %": high, "calls": len(seconds), "per s": unit}
        rows[name] |= {"/ first": medians[name] / next(iter(medians.values())), "rate": float(work / medians[name])}
    yield from rows.values()


def _cell(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
