"""Scores and the first rows of the rankings of every query by every setting of a sweep.

Settings are batch axes of one compiled call. Matches are scored pair by pair, whatever query they belong to. Work goes
block by block (some settings, some queries): this bounds the memory, and an interrupted sweep continues with the next
block.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from mfvpr.matching.match_set import MatchSet, Scales, queries_that_fit, scales, shapes
from mfvpr.reranking import grids, ranking
from mfvpr.reranking.batched_scoring import PaddedBatch, all_batches, fuse_all, run_batches
from mfvpr.reranking.ranking import RetrievalScore, Ties, breaks_ties_by_row, retrieval_scores
from mfvpr.scoring.scorer import check_host, on_host
from mfvpr.tuning.sweeps.settings import FUSION, Group, Setting, distinct, group_by_program
from mfvpr.types import Array, Matches, Shortlist, per_match, per_pair
from mfvpr.utils.arrays import read_arrays, write_arrays
from mfvpr.utils.errors import InputError
from mfvpr.utils.fingerprints import content_hash
from mfvpr.utils.numerics import Device, compiled
from mfvpr.utils.progress import Track, no_progress

SETTINGS_PER_BLOCK = 64
_ALONE = "alone"  # the c of a score that is not fused


@dataclass(frozen=True)
class Work:
    """The arguments of `sweep` for a part of the queries.

    Attributes:
        match_set: of all queries.
        queries: the part; candidates and views are of these queries.
        settings: mean number of settings of a program, for the size of the batches.
    """

    match_set: MatchSet | Scales
    queries: range
    settings: float
    candidates: Shortlist
    views: Sequence[np.ndarray]
    depth: int
    ties: Ties
    retrieval_score: RetrievalScore

    @cached_property
    def digest(self) -> str:
        """Hash of the matches, the fusion of scales, the shortlist and the views of these queries."""
        parts = [scale.take(self.queries) for scale in scales(self.match_set)]
        fusion = (self.match_set.weights, self.match_set.normalize) if isinstance(self.match_set, Scales) else ()
        return content_hash(
            fusion, [(scale.counts, scale.matches) for scale in parts], self.candidates, list(self.views)
        )

    @cached_property
    def batches(self) -> list[PaddedBatch]:
        """Padded pairs of these queries; made only if a block needs them."""
        return list(all_batches(self.match_set, self.queries, settings=self.settings))

    def parts(self, size: int) -> Iterator["Work"]:
        """Split into at most `size` queries at a time."""
        for start in range(0, len(self.queries), size):
            part = slice(start, start + size)
            candidates = jax.tree.map(lambda values: values[part], self.candidates)  # noqa: B023
            views = [view[part] & candidates.mask for view in self.views]
            yield replace(self, queries=self.queries[part], candidates=candidates, views=views)


def sweep(
    scorer: Any, settings: Sequence[Setting], match_set: MatchSet | Scales, candidates: Shortlist, *,
    views: Sequence[Bool[np.ndarray, "queries candidates"]] | None = None, depth: int = 10, ties: Ties = "retrieval",
    retrieval_score: RetrievalScore = "cosine", settings_per_block: int | None = None,
    queries_per_block: int | None = None, folder: Path | None = None, devices: Sequence[Device] | None = None,
    track: Track = no_progress,
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
        depth: number of rows of a ranking to return.
        ties: see `mfvpr.reranking.ranking.rank_shortlist`.
        retrieval_score: see `mfvpr.reranking.ranking.fuse_shortlist`.
        settings_per_block: by default 64. The result does not depend on it.
        queries_per_block: by default as many as fit into 256 MB. The result does not depend on it.
        folder: where finished blocks are stored, and read instead of being computed again; None = nowhere. It may hold
            blocks of other sweeps, which differ in matches, shortlists, values or the program of the scorer. Blocks of
            a scorer that calls back to Python or runs on the host are never stored, since its code is not known.
        devices: that share the batches of pairs, without any change of the scores; None = the one that JAX takes.
        track: progress over blocks.
    """
    check_host(scorer)
    grids.refuse_own_names(scorer, {*itertools.chain(*settings)}, reserved=(*grids.WEIGHTINGS, FUSION))
    all_queries = range(len(candidates.mask))
    views = [candidates.mask] if views is None else views
    unique, places = distinct(settings)
    per_block = min(settings_per_block or SETTINGS_PER_BLOCK, len(unique))
    queries = queries_per_block or queries_that_fit(match_set, per_block)
    programs = list(group_by_program(scorer, unique, match_set.image_sizes))
    work = Work(match_set, all_queries, len(unique) / len(programs), candidates, views, depth, ties, retrieval_score)
    if folder is not None:
        programs = [replace(group, program=group_program(work, group)) for group in programs]
    blocks = [block for group in programs for block in group.blocks(per_block)]
    all_rows = np.full((len(views), len(settings), len(all_queries), depth), -1, np.int32)
    steps = ((part, block) for part in work.parts(queries) for block in blocks)
    for part, block in track(steps, len(blocks) * -(-len(all_queries) // queries)):
        places_of_block = [places[row] for row in dict.fromkeys(block.rows.reshape(-1).tolist())]
        members, repeats = list(itertools.chain(*places_of_block)), list(map(len, places_of_block))
        cs = [settings[place].get(FUSION, _ALONE) for place in members]
        compute = partial(_rows, part, block, cs, repeats, devices)
        rows = _read_or_compute(folder, part, block, cs, compute)
        all_rows[:, members, part.queries.start : part.queries.stop] = rows
    return all_rows


def result_bytes(num_views: int, num_settings: int, num_queries: int, depth: int) -> int:
    """Size of the result of `sweep` in bytes."""
    return 4 * num_views * num_settings * num_queries * depth


def _rows(
    part: Work, block: Group, cs: Sequence[Any], repeats: Sequence[int], devices: Sequence[Device] | None
) -> np.ndarray:
    """Rows `[V, W, q, depth]` of the block's distinct settings, each repeated for all its values of c."""
    shape = len(scales(part.match_set)), *part.candidates.mask.shape
    scores = block_scores(block, part.batches, shape, devices)
    _, first = np.unique(block.rows, return_index=True)
    scores = scores.reshape(shape[0], -1, *shape[1:])[:, np.sort(first)]

    def first_rows(view: np.ndarray) -> np.ndarray:
        return _first_rows(part, np.repeat(fuse_all(part.match_set, scores, view), repeats, axis=0), cs, view)

    return np.stack([first_rows(view) for view in part.views])


def block_scores(
    block: Group, batches: Sequence[PaddedBatch], shape: tuple[int, int, int], devices: Sequence[Device] | None
) -> Float[np.ndarray, "scales settings weightings queries candidates"]:
    """Scores of every scale; a pair without matches scores 0."""
    scores = np.zeros((*block.rows.shape, math.prod(shape)), np.float32)
    inputs = block.scorer, block.settings, block.weightings
    for places, values in run_batches(_score_settings, inputs, batches, devices=devices):
        scores[..., places] = values
    return np.moveaxis(scores.reshape(*block.rows.shape, *shape), 2, 0)


def _score_settings(matches: Matches, scorer: Any, *values: Mapping[str, Array]) -> Array:
    return grids.score_settings(scorer, matches, *values)


def _first_rows(part: Work, scores: np.ndarray, cs: Sequence[Any], view: np.ndarray) -> np.ndarray:
    """Database rows `[W, q, depth]` by scores `[W, q, C]`, each setting fused with its own c."""
    indices, by_retrieval = part.candidates.indices, retrieval_scores(part.candidates, part.retrieval_score)
    rows = np.full((*scores.shape[:2], part.depth), -1, np.int32)
    kinds = np.array(["alone" if c == _ALONE else "balanced" if c is None else "given" for c in cs])
    for kind in np.unique(kinds):
        members = np.flatnonzero(kinds == kind)
        c = np.array([cs[int(member)] for member in members], np.float32) if kind == "given" else None
        tie_break = indices if breaks_ties_by_row(part.ties) else None
        order = np.asarray(_orders(by_retrieval, scores[members], c, view, tie_break, fused=kind != "alone"))
        order = order[..., : part.depth]
        ranked = np.where(np.take_along_axis(view[None], order, -1), np.take_along_axis(indices[None], order, -1), -1)
        rows[members, :, : ranked.shape[-1]] = ranked
    return rows


@partial(compiled, static_argnames="fused")
def _orders(
    by_retrieval: Array, scores: Array, c: Array | None, view: Array, tie_break: Array | None, *, fused: bool
) -> Array:
    """Positions `[W, q, C]` into the shortlist, best first, one setting at a time."""

    def order(scores_c: tuple[Array, Array | None]) -> Array:
        scores, c = scores_c
        return ranking.rank(ranking.fuse(by_retrieval, scores, view, c) if fused else scores, view, tie_break=tie_break)

    return jax.lax.map(order, (scores, c))


def _read_or_compute(
    folder: Path | None, part: Work, block: Group, cs: Sequence[Any], compute: Callable[[], np.ndarray]
) -> np.ndarray:
    """Rows of a block, from its file; if that is missing or damaged, they are computed and written."""
    if folder is None or "callback" in block.program:
        return compute()
    key = _fingerprint(part, block, cs)
    path = folder / f"{key}.npz"
    try:
        return read_arrays(path, key)["rows"]
    except (OSError, InputError):
        pass  # missing or damaged
    rows = compute()
    with suppress(FileNotFoundError):  # another process that ends the same sweep removes the folder
        write_arrays(path, {"rows": rows}, key)
    return rows


def _fingerprint(part: Work, block: Group, cs: Sequence[Any]) -> str:
    """Hash of everything that determines a block's rows: matches and shortlist, the scorer's program and numbers."""
    names = [*block.settings, *block.weightings]
    options = part.depth, part.ties, part.retrieval_score, list(map(repr, cs)), block.rows.tolist(), names
    numbers = block.scorer, dict(block.settings), dict(block.weightings)
    return content_hash(repr(options), block.program, part.digest, numbers)


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
        score_settings = partial(grids.score_settings)  # equal to no other: nor is another class's program
        return jax.jit(score_settings).lower(group.scorer, batch, settings, group.weightings).as_text()

    return "".join(
        text(scale.matches[0], *shape)
        for scale in scales(work.match_set)
        for shape in shapes(scale, settings=work.settings).items()
    )
