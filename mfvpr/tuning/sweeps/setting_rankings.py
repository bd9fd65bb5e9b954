"""The first rows of the rankings of every query by every setting of a sweep.

Settings are batch axes of one compiled call. Matches are scored pair by pair, whatever query they belong to. Work goes
block by block (some settings, some queries): this bounds the memory. With a folder, the rows of each setting are kept
in a file, and only settings that are missing are ranked.
"""

import itertools
import math
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from mfvpr.core import ranking
from mfvpr.core.batch import MATCH_AXES, by_capacity, score_settings
from mfvpr.core.scorer import check_host, static_names, whole_numbers, with_parameters, with_static_functions
from mfvpr.core.types import Array, Shortlist
from mfvpr.core.weights import ChosenWeight
from mfvpr.datasets.datasets import Dataset
from mfvpr.datasets.positives import Positives
from mfvpr.evaluation.drives import DriveFilter
from mfvpr.evaluation.protocol import EvaluationProtocol, Half
from mfvpr.evaluation.rankings import Ranked, RetrievalScore, Ties, breaks_ties_by_row, fuse, retrieval_scores
from mfvpr.evaluation.stages import PaddedBatch, all_batches, fuse_all, require_finite, run_batches
from mfvpr.matchers.match_set import MatchSet, Scales, partition, queries_that_fit, scales
from mfvpr.storage.cache_files import CacheFiles
from mfvpr.utils.errors import InputError
from mfvpr.utils.fingerprints import content_hash, fingerprint, recipe_of, versions
from mfvpr.utils.numerics import Device, compiled
from mfvpr.utils.runtime import DEFAULT_RUNTIME, Runtime

Setting = Mapping[str, Any]

FUSION = "c"


@dataclass(frozen=True)
class Group:
    """Settings of one program, the product of G settings and W weightings."""

    scorer: Any  # with the choices and the capacity for these settings
    settings: Mapping[str, Shaped[np.ndarray, " settings"]]
    weightings: Mapping[str, Shaped[np.ndarray, " weightings"]]  # of `weight` (an option's number) and `max_distance`
    rows: Int[np.ndarray, "settings weightings"]  # numbers of the settings

    def blocks(self, size: int) -> Iterator["Group"]:
        """Parts of one shape with at most `size` settings each; the last part repeats settings to reach the shape."""
        width = min(size, self.rows.shape[1])
        for columns in _parts(self.rows.shape[1], width):
            for lines in _parts(self.rows.shape[0], max(1, size // width)):
                settings = {name: values[lines] for name, values in self.settings.items()}
                weightings = {name: values[columns] for name, values in self.weightings.items()}
                yield replace(self, settings=settings, weightings=weightings, rows=self.rows[np.ix_(lines, columns)])


def grid(axes: Mapping[str, Sequence[Any]]) -> list[dict[str, Any]]:
    """Every combination of the axes' values, the last axis fastest."""
    return [dict(zip(axes, values, strict=True)) for values in itertools.product(*axes.values())]


def distinct(settings: Sequence[Setting]) -> tuple[list[dict[str, Any]], list[list[int]]]:
    """Settings with different scores, without `c`, and for each the places in `settings` that share its scores."""
    by_scores = _group_by(settings, range(len(settings)), lambda name, _: name != FUSION)
    return [setting for setting, _ in by_scores], [places for _, places in by_scores]


def group_by_program(
    scorer: Any, settings: Sequence[Setting], image_sizes: tuple[np.ndarray, np.ndarray]
) -> Iterator[Group]:
    """Group settings, with the same names in each, by program: each value of a static parameter, and None, has one."""
    static, integers = static_names(scorer), whole_numbers(scorer)
    weights = list({id(s["weight"]): s["weight"] for s in settings if "weight" in s}.values())
    by_choices = _group_by(settings, range(len(settings)), lambda name, value: name in static or value is None)
    for choices, members in by_choices:
        chosen = with_parameters(scorer, choices)
        if weights:
            chosen = replace(chosen, weight=ChosenWeight(tuple(weights), 0))
        chosen = with_static_functions(chosen)
        # Split the members into products `[G, W]` of settings and weightings.
        columns = _group_by(settings, members, lambda name, _: name in MATCH_AXES)
        column = {row: place for place, (_, rows) in enumerate(columns) for row in rows}
        products: dict[tuple[int, ...], list[list[int]]] = {}
        for _, line in _group_by(settings, members, lambda name, _: name not in MATCH_AXES):
            line = sorted(line, key=column.__getitem__)
            products.setdefault(tuple(column[row] for row in line), []).append(line)
        for rows in map(np.array, products.values()):
            values = _arrays([settings[row] for row in rows[:, 0]], weights, integers, without={*choices, *MATCH_AXES})
            parameter_names = set(settings[0]) - set(MATCH_AXES)
            weightings = _arrays([settings[row] for row in rows[0]], weights, integers, without=parameter_names)
            for fitted, part in by_capacity(chosen, values, len(rows), *image_sizes):
                yield Group(fitted, {name: axis[part] for name, axis in values.items()}, weightings, rows[part])


def _group_by(
    settings: Sequence[Setting], members: Sequence[int], chosen: Callable[[str, Any], bool]
) -> list[tuple[dict, list[int]]]:
    """Group the members by the values of the chosen names; return the values and the members of each group."""
    groups: dict[Any, tuple[dict, list[int]]] = {}
    for row in members:
        shared = {name: value for name, value in settings[row].items() if chosen(name, value)}
        key = tuple((name, id(value) if name == "weight" else value) for name, value in shared.items())
        groups.setdefault(key, (shared, []))[1].append(row)
    return list(groups.values())


def _arrays(
    settings: Sequence[Setting], weights: Sequence[Any], integers: set[str], *, without: set[str]
) -> dict[str, np.ndarray]:
    """Values `[n]` by name; a match weight is its number among `weights`."""
    number = {id(weight): place for place, weight in enumerate(weights)}
    names = [name for name in settings[0] if name not in without]
    return {
        name: np.array([number[id(setting[name])] for setting in settings])
        if name == "weight"
        else np.array([setting[name] for setting in settings], int if name in integers else np.float32)
        for name in names
    }


def _parts(total: int, size: int) -> list[np.ndarray]:
    """Parts of range(total) of one length, at most `size`; the last part repeats its last number."""
    length = -(-total // -(-total // size))
    return [np.minimum(np.arange(start, start + length), total - 1) for start in range(0, total, length)]


SETTINGS_PER_BLOCK = 64
ALONE = "alone"  # the c of a score that is not fused


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
    """Options of a sweep. Only the first four change its results.

    The `folder` may hold rows of other data and scorers; rows of a scorer without a recipe (`mfvpr.utils.recipe_of`)
    are not kept.
    """

    ks: Sequence[int] = (1, 5, 10)  # depths of the recall; the largest is the number of rows of a ranking
    ties: Ties = "retrieval"  # see `mfvpr.evaluation.rankings.rank_shortlist`
    retrieval_score: RetrievalScore = "cosine"  # see `mfvpr.evaluation.rankings.retrieval_scores`
    sequence: DriveRanking | None = None  # ranks the queries of a drive together, in one block; None = each alone
    settings_per_block: int | None = None  # None = 64
    queries_per_block: int | None = None  # None = as many as fit into 256 MB
    folder: Path | None = None  # where the rows of each setting are kept, and read by later sweeps; None = nowhere
    runtime: Runtime = DEFAULT_RUNTIME  # devices that share the batches of pairs, progress and messages
    label: str = "sweep"  # of the progress


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

    Raises:
        InputError: a setting that cannot be scored, or the folder cannot be used.
    """
    check_host(scorer)
    views = [candidates.mask] if views is None else views
    num_queries, at_once = len(candidates.mask), min(options.settings_per_block or SETTINGS_PER_BLOCK, len(settings))
    size = num_queries if options.sequence else options.queries_per_block or queries_that_fit(match_set, at_once)
    rows = np.full((len(views), len(settings), num_queries, max(options.ks)), -1, np.int32)
    files, recipes = _files(scorer, options, settings)
    parts, total = list[_Part](), 0  # total: batches of pairs for all blocks
    for start in range(0, num_queries, max(1, size)):
        queries = range(num_queries)[start : start + size]
        part = slice(queries.start, queries.stop)
        shortlist = jax.tree.map(lambda values: values[part], candidates)  # noqa: B023
        seen = [view[part] & shortlist.mask for view in views]
        keys, missing = list[str](), range(len(settings))
        if files is not None:
            fusion = (match_set.weights, match_set.normalize) if isinstance(match_set, Scales) else ()
            of_scales = [scale.take(queries) for scale in scales(match_set)]
            digest = content_hash(fusion, [(each.counts, each.matches) for each in of_scales], shortlist, seen)
            keys, missing = [fingerprint([recipe, digest]) for recipe in recipes], list[int]()
            for number, key in enumerate(keys):
                if (found := files.get(key)) is None:
                    missing.append(number)
                else:
                    rows[:, number, part] = found
        if not missing:
            continue
        unique, places = distinct([settings[number] for number in missing])
        groups = list(group_by_program(scorer, unique, match_set.image_sizes))
        blocks = [block for group in groups for block in group.blocks(at_once)]
        share = len(unique) / len(groups)
        total += len(blocks) * sum(len(partition(each, queries, settings=share)) for each in scales(match_set))
        numbers = [[missing[place] for place in each] for each in places]
        parts.append(_Part(queries, shortlist, seen, keys, numbers, blocks, share))

    ticks = iter(options.runtime.progress(options.label)(range(total), total))
    for part in parts:
        batches = list(all_batches(match_set, part.queries, settings=part.share))
        shape = len(scales(match_set)), *part.candidates.mask.shape
        place = slice(part.queries.start, part.queries.stop)
        for block in part.blocks:
            of_block, firsts = np.unique(block.rows, return_index=True)  # the last block of a program repeats settings
            scores = block_scores(block, batches, shape, options.runtime.devices, ticks)[:, firsts]
            numbers = [number for row in of_block for number in part.numbers[row]]
            repeats = [len(part.numbers[row]) for row in of_block]
            cs = [settings[number].get(FUSION, ALONE) for number in numbers]
            for view, seen in enumerate(part.views):
                fused = np.repeat(fuse_all(match_set, scores, seen), repeats, axis=0)
                rows[view, numbers, place] = _first_rows(fused, cs, part.candidates, seen, view, options)
            if files is not None:
                files.update({part.keys[int(number)]: rows[:, number, place] for number in numbers})
    next(ticks, None)  # ends the progress
    return rows


class _Part(NamedTuple):
    """Some queries of a sweep, and the settings by which they are not ranked yet."""

    queries: range
    candidates: Shortlist
    views: Sequence[np.ndarray]
    keys: Sequence[str]  # of the files of all settings
    numbers: Sequence[Sequence[int]]  # of the settings of each score, which differ in c
    blocks: Sequence[Group]  # of the scores
    share: float  # scores of a program, on average: with more, batches are smaller


def _files(
    scorer: Any, options: SweepOptions, settings: Sequence[Setting] = ()
) -> tuple[CacheFiles[np.ndarray] | None, list[Any]]:
    """Files of rows, by what determines them but for setting and data, and recipes of the settings; None without."""
    if options.folder is None:
        return None, []
    of_rows = max(options.ks), options.ties, options.retrieval_score, options.sequence
    try:
        recipe = {"scorer": recipe_of(scorer), "rows": recipe_of(of_rows), "versions": recipe_of(versions())}
        recipes = [recipe_of(setting) for setting in settings]
    except (TypeError, InputError) as error:
        options.runtime.log(f"{options.label}: no results are kept in {options.folder}, as there is no recipe: {error}")
        return None, []
    pack, unpack = lambda rows: {"rows": rows}, itemgetter("rows")
    return CacheFiles(options.folder, "sweep", recipe, pack, unpack, compress=True), recipes


def forget_rankings(scorer: Any, options: SweepOptions) -> None:
    """Remove the rankings that a sweep kept in its folder: when it is finished, changed code may rank otherwise."""
    if (files := _files(scorer, options)[0]) is not None:
        shutil.rmtree(files.folder, ignore_errors=True)


def _first_rows(
    scores: Float[np.ndarray, "settings queries candidates"],
    cs: Sequence[Any],
    candidates: Shortlist,
    view: Bool[np.ndarray, "queries candidates"],
    number: int,
    options: SweepOptions,
) -> Int[np.ndarray, "settings queries depth"]:
    """Database rows by the scores of settings, each fused with its own c, in the view of a number."""
    by_retrieval = retrieval_scores(candidates, options.retrieval_score)
    tie_break = candidates.indices if breaks_ties_by_row(options.ties) else None
    rows = np.full((*scores.shape[:2], max(options.ks)), -1, np.int32)
    kinds = np.array([ALONE if c == ALONE else "balanced" if c is None else "given" for c in cs])
    for kind in np.unique(kinds):
        members = np.flatnonzero(kinds == kind)
        c = np.array([cs[member] for member in members.tolist()], np.float32) if kind == "given" else None
        orders = _orders(by_retrieval, scores[members], c, view, tie_break, fused=kind != ALONE)
        order, final = map(np.asarray, orders)
        is_seen = np.take_along_axis(view[None], order, -1)
        ranked = np.where(is_seen, np.take_along_axis(candidates.indices[None], order, -1), -1)
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
    program = lambda matches, scorer, *values: score_settings(scorer, matches, *values)  # noqa: E731
    for places, values in run_batches(program, inputs, batches, devices=devices):
        next(ticks, None)
        scores[:, places] = values.reshape(-1, len(places))
    for of_setting in scores:
        require_finite("a setting of the sweep", of_setting)
    return np.moveaxis(scores.reshape(-1, *shape), 1, 0)


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
