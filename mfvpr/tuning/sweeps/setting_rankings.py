"""The first rows of the rankings of every query by every setting of a sweep.

Settings are batch axes of one compiled call. Matches are scored pair by pair, whatever query they belong to. Work goes
block by block (some settings, some queries): this bounds the memory, and an interrupted sweep goes on with the blocks
that are missing.
"""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from mfvpr.core import ranking
from mfvpr.core.batch import WEIGHTINGS, refuse_own_names, score_settings
from mfvpr.core.scorer import check_host
from mfvpr.core.types import Array, Matches, Shortlist
from mfvpr.datasets.datasets import Dataset
from mfvpr.datasets.positives import Positives
from mfvpr.evaluation.batched_scoring import PaddedBatch, all_batches, fuse_all, run_batches
from mfvpr.evaluation.protocol import EvaluationProtocol
from mfvpr.evaluation.rankings import Ranked
from mfvpr.evaluation.selection import Half
from mfvpr.evaluation.sequences import DriveFilter
from mfvpr.evaluation.shortlist_scores import RetrievalScore, Ties, breaks_ties_by_row, fuse, retrieval_scores
from mfvpr.evaluation.validation import require_finite
from mfvpr.matchers.match_set import MatchSet, Scales, partition, queries_that_fit, scales
from mfvpr.tuning.sweeps.setting_groups import FUSION, Group, Setting, distinct, group_by_program
from mfvpr.utils.arrays import read_arrays, write_arrays
from mfvpr.utils.errors import InputError
from mfvpr.utils.fingerprints import content_hash, fingerprint, recipe_of
from mfvpr.utils.numerics import Device, compiled
from mfvpr.utils.runtime import DEFAULT_RUNTIME, Runtime
from mfvpr.utils.versions import versions

SETTINGS_PER_BLOCK = 64
_ALONE = "alone"  # the c of a score that is not fused


@dataclass(frozen=True)
class DriveRanking:
    """A drive filter for the queries of a sweep, and what it needs of their data set.

    `halves` are those that the views after the first are of: of a half, only the queries to choose on are ranked, among
    the rows that choosing may see.
    """

    drive_filter: DriveFilter
    num_rows: int
    excluded: Positives | None = None
    halves: Sequence[Half] = ()

    @classmethod
    def of(cls, drive_filter: DriveFilter, dataset: Dataset, protocol: EvaluationProtocol) -> "DriveRanking":
        """A filter for the only sequence of a data set."""
        return cls(drive_filter, len(dataset.database), dataset.only.excluded, protocol.halves)

    def rows(self, ranked: Ranked, view: int) -> Int[np.ndarray, "queries candidates"]:
        """Rows of a view's rankings, -1 where none are ranked."""
        excluded = None if self.excluded is None else self.excluded.dense()
        if not view:
            return self.drive_filter(ranked, self.num_rows, excluded).rows
        half, rows = self.halves[view - 1], np.full_like(ranked.rows, -1)
        unseen = np.broadcast_to(~half.allowed, (len(half.tune), self.num_rows))
        unseen = unseen if excluded is None else unseen | excluded[half.tune]
        tuned = Ranked(ranked.rows[half.tune], ranked.scores[half.tune])
        ranking = self.drive_filter(tuned, self.num_rows, unseen).rows
        rows[half.tune, : ranking.shape[1]] = ranking
        return rows


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
            blocks of other sweeps. Blocks of a scorer without a recipe (`mfvpr.utils.recipe_of`) are not stored.
        runtime: devices that share the batches of pairs, progress and messages.
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


def rank_settings(
    scorer: Any,
    settings: Sequence[Setting],
    match_set: MatchSet | Scales,
    candidates: Shortlist,
    *,
    views: Sequence[Bool[np.ndarray, "queries candidates"]] | None = None,
    options: SweepOptions = DEFAULT_OPTIONS,
) -> Int[np.ndarray, "views settings queries depth"]:
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
    num_queries = len(candidates.mask)
    unique, places = distinct(settings)
    per_block = min(options.settings_per_block or SETTINGS_PER_BLOCK, len(unique))
    groups = list(group_by_program(scorer, unique, match_set.image_sizes))
    blocks = [block for group in groups for block in group.blocks(per_block)]
    size = num_queries if options.sequence else options.queries_per_block or queries_that_fit(match_set, per_block)
    recipe = _recipe(scorer, settings, options) if options.folder else None
    parts = []
    for start in range(0, num_queries, max(1, size)):
        part = slice(start, start + size)
        shortlist = jax.tree.map(lambda values: values[part], candidates)  # noqa: B023
        seen = [view[part] & shortlist.mask for view in views]
        queries = range(num_queries)[part]
        parts.append(_Part(match_set, queries, shortlist, seen, len(unique) / len(groups), options))

    rows = np.full((len(views), len(settings), num_queries, max(options.ks)), -1, np.int32)
    total = len(blocks) * sum(part.num_batches for part in parts)
    ticks = iter(options.runtime.progress(options.label)(range(total), total))
    for part in parts:
        for number, block in enumerate(blocks):
            of_block = np.unique(block.rows)  # the last block of a program repeats settings
            members = [member for row in of_block for member in places[row]]
            path = options.folder / f"{recipe}-{part.digest}-{number}.npz" if options.folder and recipe else None
            found = _read_rows(path) if path else None
            if found is None:
                cs = [[settings[member].get(FUSION, _ALONE) for member in places[row]] for row in of_block]
                found = part.rank(block, cs, ticks)
                if path:
                    with suppress(FileNotFoundError):  # another process that ends the same sweep removes the folder
                        write_arrays(path, {"rows": found}, path.stem)
            else:
                next(itertools.islice(ticks, part.num_batches, part.num_batches), None)
            rows[:, members, part.queries.start : part.queries.stop] = found
    next(ticks, None)  # ends the progress
    return rows


@dataclass(frozen=True, eq=False)
class _Part:
    """Some of the queries of `rank_settings`, with their candidates and views."""

    match_set: MatchSet | Scales  # of all queries
    queries: range
    candidates: Shortlist
    views: Sequence[np.ndarray]
    settings: float  # that a program scores, on average: batches are smaller with more
    options: SweepOptions

    @cached_property
    def num_batches(self) -> int:
        """Number of batches of pairs."""
        sets = scales(self.match_set)
        return sum(len(partition(scale, self.queries, settings=self.settings)) for scale in sets)

    @cached_property
    def batches(self) -> list[PaddedBatch]:
        """All pairs with matches."""
        return list(all_batches(self.match_set, self.queries, settings=self.settings))

    @cached_property
    def digest(self) -> str:
        """Hash of the matches, the fusion of scales, the shortlist and the views."""
        parts = [scale.take(self.queries) for scale in scales(self.match_set)]
        fusion = (self.match_set.weights, self.match_set.normalize) if isinstance(self.match_set, Scales) else ()
        matches = [(scale.counts, scale.matches) for scale in parts]
        return content_hash(fusion, matches, self.candidates, self.views)

    def rank(self, block: Group, cs: Sequence[Sequence[Any]], ticks: Iterator[Any]) -> np.ndarray:
        """Database rows `[V, W, q, depth]` by the W settings of a block: each of its scores with several c."""
        shape = len(scales(self.match_set)), *self.candidates.mask.shape
        scores = block_scores(block, self.batches, shape, self.options.runtime.devices, ticks)
        scores = scores[:, np.unique(block.rows, return_index=True)[1]]
        fused = (fuse_all(self.match_set, scores, view) for view in self.views)
        repeated = (np.repeat(each, list(map(len, cs)), axis=0) for each in fused)
        flat = list(itertools.chain.from_iterable(cs))
        return np.stack([self._first_rows(each, flat, number) for number, each in enumerate(repeated)])

    def _first_rows(self, scores: np.ndarray, cs: Sequence[Any], number: int) -> np.ndarray:
        """Database rows `[W, q, depth]` by scores `[W, q, C]` of a view, each fused with its own c."""
        view, indices, options = self.views[number], self.candidates.indices, self.options
        by_retrieval = retrieval_scores(self.candidates, options.retrieval_score)
        tie_break = indices if breaks_ties_by_row(options.ties) else None
        rows = np.full((*scores.shape[:2], max(options.ks)), -1, np.int32)
        kinds = np.array(["alone" if c == _ALONE else "balanced" if c is None else "given" for c in cs])
        for kind in np.unique(kinds):
            members = np.flatnonzero(kinds == kind)
            c = np.array([cs[member] for member in members.tolist()], np.float32) if kind == "given" else None
            orders = _orders(by_retrieval, scores[members], c, view, tie_break, fused=kind != "alone")
            order, final = map(np.asarray, orders)
            is_seen = np.take_along_axis(view[None], order, -1)
            ranked = np.where(is_seen, np.take_along_axis(indices[None], order, -1), -1)
            if options.sequence is not None:
                pairs = zip(ranked, np.take_along_axis(final, order, -1), strict=True)
                ranked = np.stack([options.sequence.rows(Ranked(*pair), number) for pair in pairs])
            ranked = ranked[..., : max(options.ks)]
            rows[members, :, : ranked.shape[-1]] = ranked
        return rows


def block_scores(
    block: Group,
    batches: Sequence[PaddedBatch],
    shape: tuple[int, int, int],
    devices: Sequence[Device] | None,
    ticks: Iterator[Any],
) -> Float[np.ndarray, "scales settings queries candidates"]:
    """Scores of every scale, settings by weightings; a pair without matches scores 0. Each batch takes a tick."""
    scores = np.zeros((block.rows.size, math.prod(shape)), np.float32)
    inputs = block.scorer, block.settings, block.weightings
    for places, values in run_batches(_score_settings, inputs, batches, devices=devices):
        next(ticks, None)
        scores[:, places] = values.reshape(-1, len(places))
    for of_setting in scores:
        require_finite("a setting of the sweep", of_setting)
    return np.moveaxis(scores.reshape(-1, *shape), 1, 0)


def _score_settings(matches: Matches, scorer: Any, *values: Mapping[str, Array]) -> Array:
    return score_settings(scorer, matches, *values)


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


def _recipe(scorer: Any, settings: Sequence[Setting], options: SweepOptions) -> str | None:
    """Fingerprint of what determines the rows besides the data; None if the scorer or a weight has no recipe."""
    of_rows = max(options.ks), options.ties, options.retrieval_score, options.sequence
    blocks = options.settings_per_block, options.queries_per_block
    try:
        return fingerprint(recipe_of([scorer, settings, of_rows, blocks, versions()]))
    except (TypeError, InputError) as error:
        options.runtime.log(f"{options.label}: no results are kept in {options.folder}, as there is no recipe: {error}")
        return None


def _read_rows(path: Path) -> np.ndarray | None:
    """Stored rows of a block; None if they are missing or damaged."""
    with suppress(OSError, InputError):
        return read_arrays(path, path.stem)["rows"]
    return None
