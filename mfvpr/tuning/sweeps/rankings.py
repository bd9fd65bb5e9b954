"""Scores and the first rows of the rankings of every query by every setting of a sweep.

Settings are batch axes of one compiled call. Matches are scored pair by pair, whatever query they belong to. Work goes
block by block (some settings, some queries): this bounds the memory, and an interrupted sweep continues with the next
block.
"""

import itertools
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from mfvpr.core import ranking
from mfvpr.core.batch import WEIGHTINGS, refuse_own_names, score_settings
from mfvpr.core.scorer import check_host, on_host
from mfvpr.core.types import Array, Matches, Shortlist, per_match, per_pair
from mfvpr.evaluation.batched_scoring import PaddedBatch, all_batches, fuse_all, run_batches
from mfvpr.evaluation.rankings import Ranked
from mfvpr.evaluation.shortlist_scores import RetrievalScore, Ties, breaks_ties_by_row, fuse, retrieval_scores
from mfvpr.evaluation.validation import require_finite
from mfvpr.matchers.match_set import MatchSet, Scales, partition, queries_that_fit, scales, shapes
from mfvpr.tuning.sweeps.drives import DriveRanking
from mfvpr.tuning.sweeps.settings import FUSION, Group, Setting, distinct, group_by_program
from mfvpr.utils.arrays import read_arrays, write_arrays
from mfvpr.utils.errors import InputError
from mfvpr.utils.fingerprints import content_hash
from mfvpr.utils.numerics import Device, available_cpus, compiled
from mfvpr.utils.runtime import DEFAULT_RUNTIME, Runtime

SETTINGS_PER_BLOCK = 64
_ALONE = "alone"  # the c of a score that is not fused
_STEP = 1.0  # seconds of the settings that one batch is scored with, about
_MEASURED = 64  # settings x batches: less work is done before its time is measured


@dataclass(frozen=True)
class SweepOptions:
    """Options of a sweep. Only `ks`, `ties`, `retrieval_score` and `sequence` change its results.

    Attributes:
        ks: depths of the recall; the largest is the number of rows of a ranking.
        ties: see `mfvpr.evaluation.shortlist_scores.rank_shortlist`.
        retrieval_score: see `mfvpr.evaluation.shortlist_scores.retrieval_scores`.
        sequence: ranks the queries of a drive together, from their rankings by a setting; then blocks have all queries.
            None = each query alone.
        settings_per_block: None = 64.
        queries_per_block: None = as many as fit into 256 MB.
        folder: where finished blocks are stored, and read instead of being computed again; None = nowhere. It may hold
            blocks of other sweeps, which differ in matches, shortlists, values or the program of the scorer. Blocks of
            a scorer that calls back to Python or runs on the host are never stored, since its code is not known.
        runtime: devices that share the batches of pairs, progress, and a log of the work and its expected time.
        label: of the progress.
    """

    ks: Sequence[int] = (1, 5, 10)
    ties: Ties = "retrieval"
    retrieval_score: RetrievalScore = "cosine"
    sequence: DriveRanking | None = None
    settings_per_block: int | None = None
    queries_per_block: int | None = None
    folder: Path | None = None
    runtime: Runtime = DEFAULT_RUNTIME
    label: str = "sweep"


DEFAULT_OPTIONS = SweepOptions()


@dataclass(frozen=True, eq=False)
class Work:
    """The arguments of `rank_settings` for a part of the queries."""

    match_set: MatchSet | Scales  # of all queries
    queries: range  # the part: candidates and views are of these queries
    settings: float  # that a program scores, on average: batches are smaller with more
    candidates: Shortlist
    views: Sequence[np.ndarray]
    options: SweepOptions

    @cached_property
    def digest(self) -> str:
        """Hash of the matches, the fusion of scales, the shortlist and the views of these queries."""
        parts = [scale.take(self.queries) for scale in scales(self.match_set)]
        fusion = (self.match_set.weights, self.match_set.normalize) if isinstance(self.match_set, Scales) else ()
        return content_hash(
            fusion, [(scale.counts, scale.matches) for scale in parts], self.candidates, list(self.views)
        )

    @cached_property
    def num_batches(self) -> int:
        """Number of batches of pairs."""
        sets = scales(self.match_set)
        return sum(len(partition(scale, self.queries, settings=self.settings)) for scale in sets)

    def parts(self, size: int) -> Iterator["Work"]:
        """Split into at most `size` queries at a time."""
        for start in range(0, len(self.queries), size):
            part = slice(start, start + size)
            candidates = jax.tree.map(lambda values: values[part], self.candidates)  # noqa: B023
            views = [view[part] & candidates.mask for view in self.views]
            yield replace(self, queries=self.queries[part], candidates=candidates, views=views)


@dataclass(frozen=True)
class Block:
    """A block of settings for a part of the queries."""

    part: Work
    group: Group  # settings with different scores
    number: int  # of the program
    members: Sequence[int]  # places of the settings of `rank_settings`
    repeats: Sequence[int]  # number of members that share the scores of one of the group
    cs: Sequence[Any]  # by member

    @property
    def amount(self) -> int:
        """Settings times batches."""
        return self.group.rows.size * self.part.num_batches

    @cached_property
    def _key(self) -> str:
        """Hash of everything that determines the rows: matches and shortlist, the scorer's program and numbers."""
        group, options = self.group, self.part.options
        names = [*group.settings, *group.weightings]
        drives = options.sequence and content_hash(repr(options.sequence.drive_filter), vars(options.sequence))
        of_rows = max(options.ks), options.ties, options.retrieval_score, drives, list(map(repr, self.cs))
        numbers = group.scorer, dict(group.settings), dict(group.weightings)
        return content_hash(repr((*of_rows, group.rows.tolist(), names)), group.program, self.part.digest, numbers)

    def read(self) -> np.ndarray | None:
        """Stored rows; None if they are missing, damaged or not stored."""
        folder = self.part.options.folder
        if folder is not None and "callback" not in self.group.program:
            with suppress(OSError, InputError):
                return read_arrays(folder / f"{self._key}.npz", self._key)["rows"]
        return None

    def write(self, rows: np.ndarray) -> None:
        """Store rows, if they are stored."""
        folder = self.part.options.folder
        if folder is not None and "callback" not in self.group.program:
            with suppress(FileNotFoundError):  # another process that ends the same sweep removes the folder
                write_arrays(folder / f"{self._key}.npz", {"rows": rows}, self._key)

    def rows(self, batches: Sequence[PaddedBatch], size: int, ticks: Iterator[Any]) -> np.ndarray:
        """Rows `[V, W, q, depth]` of the members; at most `size` settings of one call, each takes one of the ticks."""
        part, group = self.part, self.group
        shape = len(scales(part.match_set)), *part.candidates.mask.shape
        scores = block_scores(group, batches, shape, part.options.runtime.devices, size, ticks)
        _, first = np.unique(group.rows, return_index=True)
        scores = scores[:, np.sort(first)]

        def first_rows(number: int, view: np.ndarray) -> np.ndarray:
            fused = np.repeat(fuse_all(part.match_set, scores, view), self.repeats, axis=0)
            return _first_rows(part, fused, self.cs, number)

        return np.stack([first_rows(*view) for view in enumerate(part.views)])


def rank_settings(
    scorer: Any, settings: Sequence[Setting], match_set: MatchSet | Scales, candidates: Shortlist, *,
    views: Sequence[Bool[np.ndarray, "queries candidates"]] | None = None, options: SweepOptions = DEFAULT_OPTIONS,
) -> Int[np.ndarray, "views settings queries depth"]:  # fmt: skip
    """Database rows of the first candidates of every query's ranking by every setting, best first, -1 = none.

    Args:
        scorer: its other parameters stay.
        settings: values by name, the same names in each: fields of the scorer (numbers are batch axes; each value of a
            static field has its own program), `weight` (a Weight), `max_distance` of matches, and `c` of the fusion
            with retrieval (None = balanced). Without `c` the score alone ranks.
        match_set: matches of queries with their candidates; several scales are scored one by one and fused over the
            candidates that are ranked.
        candidates: their shortlist.
        views: candidates that are ranked; by default one view, all of the shortlist.
        options: depth and ties of the rankings, sizes of blocks and their folder, and the runtime.
    """
    check_host(scorer)
    refuse_own_names(scorer, {*itertools.chain(*settings)}, reserved=(*WEIGHTINGS, FUSION))
    views = [candidates.mask] if views is None else views
    work = Work(match_set, range(len(candidates.mask)), 1, candidates, views, options)
    all_rows = np.full((len(views), len(settings), len(work.queries), max(options.ks)), -1, np.int32)
    missing = []
    for block in _blocks(scorer, settings, work):
        rows = block.read()
        if rows is None:
            missing.append(block)
        else:
            all_rows[:, block.members, block.part.queries.start : block.part.queries.stop] = rows
    for block, rows in _compute(missing, options):
        block.write(rows)
        all_rows[:, block.members, block.part.queries.start : block.part.queries.stop] = rows
    return all_rows


def _blocks(scorer: Any, settings: Sequence[Setting], work: Work) -> Iterator[Block]:
    options, (unique, places) = work.options, distinct(settings)
    per_block = min(options.settings_per_block or SETTINGS_PER_BLOCK, len(unique))
    programs = list(group_by_program(scorer, unique, work.match_set.image_sizes))
    work = replace(work, settings=len(unique) / len(programs))
    if options.folder is not None:
        programs = [replace(group, program=group_program(work, group)) for group in programs]
    size = options.queries_per_block or queries_that_fit(work.match_set, per_block)
    for part in work.parts(size if options.sequence is None else max(1, len(work.queries))):
        for number, program in enumerate(programs):
            for group in program.blocks(per_block):
                of_settings = [places[row] for row in dict.fromkeys(group.rows.reshape(-1).tolist())]
                members = list(itertools.chain(*of_settings))
                cs = [settings[place].get(FUSION, _ALONE) for place in members]
                yield Block(part, group, number, members, list(map(len, of_settings)), cs)


def _compute(blocks: Sequence[Block], options: SweepOptions) -> Iterator[tuple[Block, np.ndarray]]:
    """Rows of the blocks; long work logs its expected time, and advances its progress about every second."""
    size, amount = SETTINGS_PER_BLOCK, sum(block.amount for block in blocks)
    if amount > _MEASURED:
        programs = list({block.number: block for block in blocks if block.amount}.values())
        probes = {0, len(programs) // 2, len(programs) - 1}
        pace, compilation = np.mean([_seconds(programs[place]) for place in probes], axis=0)
        options.runtime.log(f"{options.label}: {duration(amount * pace + len(programs) * compilation)}")
        size = max(1, int(_STEP / pace))
    total = sum(block.part.num_batches * len([*block.group.blocks(size)]) for block in blocks)
    ticks = iter(options.runtime.progress(options.label)(range(total), total))
    for part, of_part in itertools.groupby(blocks, lambda block: block.part):
        batches = list(all_batches(part.match_set, part.queries, settings=part.settings))
        for block in of_part:
            yield block, block.rows(batches, size, ticks)
    next(ticks, None)


def _seconds(block: Block) -> tuple[float, float]:
    """Measured seconds of a setting and a batch, with all cores at work, and of the compilation for all shapes."""
    part, devices = block.part, block.part.options.runtime.devices
    workers = max(available_cpus(), len(devices or ()))
    batch = next(all_batches(part.match_set, part.queries, settings=part.settings))

    def run(group: Group) -> float:
        start, inputs = time.perf_counter(), (group.scorer, group.settings, group.weightings)
        list(run_batches(_score_settings, inputs, [batch] * workers, devices=devices))
        return time.perf_counter() - start

    group = next(block.group.blocks(1))
    first, again = run(group), run(group)  # the first run compiles
    if again < workers * _STEP / 2:
        group = next(block.group.blocks(int(workers * _STEP / again)))
        first, again = run(group), min(run(group), run(group))
    num_shapes = sum(len(shapes(scale, settings=part.settings)) for scale in scales(part.match_set))
    return again / workers / group.rows.size, (first - again) * num_shapes


def duration(seconds: float) -> str:
    """Seconds or minutes in words."""
    return f"about {seconds:.0f} s" if seconds < 100 else f"about {seconds / 60:,.0f} min"


def block_scores(
    block: Group, batches: Sequence[PaddedBatch], shape: tuple[int, int, int], devices: Sequence[Device] | None,
    size: int, ticks: Iterator[Any],
) -> Float[np.ndarray, "scales settings queries candidates"]:  # fmt: skip
    """Scores of every scale, settings by weightings; a pair without matches scores 0."""
    scores = np.zeros((block.rows.size, math.prod(shape)), np.float32)
    numbered = replace(block, rows=np.arange(block.rows.size).reshape(block.rows.shape))
    for part in numbered.blocks(size):
        inputs = part.scorer, part.settings, part.weightings
        for places, values in run_batches(_score_settings, inputs, batches, devices=devices):
            next(ticks, None)
            scores[np.ix_(part.rows.reshape(-1), places)] = values.reshape(-1, len(places))
    for of_setting in scores:
        require_finite("a setting of the sweep", of_setting)
    return np.moveaxis(scores.reshape(-1, *shape), 1, 0)


def _score_settings(matches: Matches, scorer: Any, *values: Mapping[str, Array]) -> Array:
    return score_settings(scorer, matches, *values)


def _first_rows(part: Work, scores: np.ndarray, cs: Sequence[Any], number: int) -> np.ndarray:
    """Database rows `[W, q, depth]` by scores `[W, q, C]` of a view, each setting fused with its own c."""
    view = part.views[number]
    indices, by_retrieval = part.candidates.indices, retrieval_scores(part.candidates, part.options.retrieval_score)
    rows = np.full((*scores.shape[:2], max(part.options.ks)), -1, np.int32)
    kinds = np.array(["alone" if c == _ALONE else "balanced" if c is None else "given" for c in cs])
    for kind in np.unique(kinds):
        members = np.flatnonzero(kinds == kind)
        c = np.array([cs[int(member)] for member in members], np.float32) if kind == "given" else None
        tie_break = indices if breaks_ties_by_row(part.options.ties) else None
        fused = kind != "alone"
        order, final = map(np.asarray, _orders(by_retrieval, scores[members], c, view, tie_break, fused=fused))
        ranked = np.where(np.take_along_axis(view[None], order, -1), np.take_along_axis(indices[None], order, -1), -1)
        if (sequence := part.options.sequence) is not None:
            pairs = zip(ranked, np.take_along_axis(final, order, -1), strict=True)
            ranked = np.stack([sequence.rows(Ranked(*pair), number) for pair in pairs])
        ranked = ranked[..., : max(part.options.ks)]
        rows[members, :, : ranked.shape[-1]] = ranked
    return rows


@partial(compiled, static_argnames="fused")
def _orders(
    by_retrieval: Array, scores: Array, c: Array | None, view: Array, tie_break: Array | None, *, fused: bool
) -> tuple[Array, Array]:
    """Positions `[W, q, C]` into the shortlist, best first, and the final scores, one setting at a time."""

    def order(scores_c: tuple[Array, Array | None]) -> tuple[Array, Array]:
        scores, c = scores_c
        scores = fuse(by_retrieval, scores, view, c) if fused else scores
        return ranking.rank(scores, view, tie_break=tie_break), scores

    return jax.lax.map(order, (scores, c))


def group_program(work: Work, group: Group) -> str:
    """The scorer's program for batches of these shapes, as text: user code may change while the class name stays."""
    if on_host(group.scorer):
        return "callback"

    def text(matches: Matches, size: int, pairs: int) -> str:
        entries, of_pair = per_match(matches).items(), per_pair(matches).items()
        example = {name: np.zeros((pairs, size, *values.shape[1:]), values.dtype) for name, values in entries}
        shape = {name: np.shape(values)[name.endswith("1") :] for name, values in of_pair}  # of one candidate
        ones = {name: np.ones((pairs, *shape[name]), values.dtype) for name, values in of_pair}
        batch = Matches(**example, **ones, mask=np.ones((pairs, size), bool))
        settings = {name: axis[:1] for name, axis in group.settings.items()}
        program = partial(score_settings)  # equal to no other: nor is another class's program
        return jax.jit(program).lower(group.scorer, batch, settings, group.weightings).as_text()

    return "".join(
        text(scale.matches[0], *shape)
        for scale in scales(work.match_set)
        for shape in shapes(scale, settings=work.settings).items()
    )
