"""Sweeps: every query is ranked by every setting of a scorer, and the best setting is chosen.

Settings are batch axes of one compiled call. Matches are scored pair by pair, whatever query they belong to. Work goes
block by block (some settings), and some queries at a time, which bounds the memory. With a folder, the rows of each
setting are kept in a file, and only settings that are missing are ranked.
"""

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cached_property, lru_cache
from importlib.util import find_spec
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import jax
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from mfvpr.baselines.learned_weight import WORDS, named_weight
from mfvpr.baselines.scorers import SCORERS
from mfvpr.core.batch import MATCH_AXES, by_capacity, refuse_own_names, score_settings
from mfvpr.core.scorer import (
    Scorer,
    check_bounds,
    check_host,
    fit_capacities,
    numbers_by_name,
    parameters_of,
    whole_numbers,
    with_parameters,
    with_static_functions,
)
from mfvpr.core.types import Shortlist
from mfvpr.core.weights import WEIGHTS, ChosenWeight
from mfvpr.datasets.datasets import Dataset
from mfvpr.datasets.positives import Positives
from mfvpr.evaluation.drives import DriveFilter
from mfvpr.evaluation.protocol import EvaluationProtocol, Half, best_setting
from mfvpr.evaluation.rankings import Ranked, RetrievalScore, Scores, Ties, fuse, retrieval_scores
from mfvpr.evaluation.stages import all_batches, fuse_all, pair_scores, require_finite
from mfvpr.evaluation.statistics import Estimate, McNemar, PathTest, estimate, mcnemar, path_test
from mfvpr.matchers.match_set import MatchSet, Scales, partition, queries_that_fit, scales
from mfvpr.storage.cache_files import CacheFiles
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import Setting as Declared
from mfvpr.utils.fingerprints import content_hash, fingerprint, recipe_of, versions
from mfvpr.utils.runtime import DEFAULT_RUNTIME, Runtime

if TYPE_CHECKING:
    import optuna

Setting = Mapping[str, Any]
Views = Sequence[Bool[np.ndarray, "queries candidates"]]
Item = TypeVar("Item")

FUSION, MAX_DISTANCE = "c", "max_distance"
CAPACITY = ("bin_size", "align")  # parameters that determine the number of bins
SETTINGS_PER_BLOCK = 64
BATCH = 16  # settings of one compiled call, after which Optuna gets their recalls


@dataclass(frozen=True)
class Axes:
    """Parameters to vary, and their values.

        axes = Axes(mfvpr.HistogramOfShifts(), {"sigma": [5, 10, 22.5], "weight": ["fs", "ratio"]})

    Attributes:
        scorer: its other parameters stay.
        values: distinct values by name. A name is a field of the scorer, `max_distance` of matches (None = any), or `c`
            of the fusion with retrieval ("auto" = balanced). Values are plain: a weight is the word `fs`, no limit is
            None.
        own_values: plain values without a sweep. Default: the scorer's, no limit of `max_distance`, and c = 0.

    Raises:
        InputError: an axis without values or with equal ones, an unknown word, or a name that the scorer does not have.
    """

    scorer: Scorer
    values: Mapping[str, Sequence[Any]]
    own_values: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        scorer = self.scorer
        refuse_own_names(scorer, self.values, reserved=(*MATCH_AXES, FUSION))
        known = sorted({*numbers_by_name(scorer), *_static_names(scorer), *self.parameters})
        known += ["weight"] if hasattr(scorer, "weight") and "weight" not in known else []
        values = {}
        for name, axis in self.values.items():
            if name not in {*known, MAX_DISTANCE, FUSION}:
                names = ", ".join([*known, MAX_DISTANCE, FUSION])
                raise InputError(f"{name}: expected a parameter of {type(scorer).__name__}, of {names}")
            is_list = np.iterable(axis) and not isinstance(axis, str)
            values[name] = list(map(_plain, axis)) if is_list else []
            if len({*values[name]}) < max(1, len(values[name])):
                raise InputError(f"{name}={axis!r}: expected different values, in a list")
        object.__setattr__(self, "values", values)
        own_values = {name: self.own_values.get(name, self._own_value(name)) for name in values}
        object.__setattr__(self, "own_values", own_values)
        for name, axis in values.items():  # before any work
            for setting in [self.setting({name: value}) for value in axis]:
                if name in self.parameters and type(scorer) in SCORERS.values():
                    check_bounds(with_parameters(scorer, setting))

    @property
    def parameters(self) -> Mapping[str, Declared]:
        """Declared parameters of the scorer."""
        return parameters_of(self.scorer) if is_dataclass(self.scorer) else {}

    @property
    def size(self) -> int:
        """Number of settings of the grid."""
        return math.prod(map(len, self.values.values()))

    def grid(self) -> list[dict[str, Any]]:
        """Every combination of the plain values."""
        return grid(self.values)

    def setting(self, plain: Mapping[str, Any]) -> Setting:
        """Convert plain values to a setting of `mfvpr.tuning.sweeps.rank_settings`."""
        converters: dict[str, Callable[[Any], Any]] = {
            **{name: parameter.value for name, parameter in self.parameters.items()},
            FUSION: lambda c: None if c == "auto" else float(c),
            MAX_DISTANCE: lambda limit: math.inf if limit is None else limit,
            "weight": named_weight,
        }
        return {name: converters[name](value) if name in converters else value for name, value in plain.items()}

    def _own_value(self, name: str) -> Any:
        if name in (MAX_DISTANCE, FUSION):
            return None if name == MAX_DISTANCE else 0
        value = attrgetter(name)(self.scorer)
        if name == "weight":
            words = [word for word, weight in WEIGHTS.items() if weight == value]
            words += [word for word in WORDS if named_weight(word) is value]
            return words[0] if words else value
        return None if name in self.parameters and value == self.parameters[name].none else _plain(value)


def can_learn(scorer: Any) -> bool:
    """Whether a scorer, or a class of scorers, has fields that are declared to be learned."""
    return any(parameter.learned for parameter in parameters_of(scorer).values())


def _plain(value: Any) -> Any:
    """The number that a scalar array holds; any other value as it is."""
    return value.item() if isinstance(value, np.generic | np.ndarray | jax.Array) else value


@dataclass(frozen=True)
class DriveRanking:
    """A drive filter for the queries of a sweep, and what it needs of their data set.

    View 0 ranks all queries. View i + 1 ranks the queries to choose on of `halves[i]`, among its allowed rows.
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
        queries, allowed = np.arange(len(ranked.rows)), np.ones(self.num_rows, bool)
        if view:
            queries, allowed = self.halves[view - 1].tune, self.halves[view - 1].allowed
        hidden = np.tile(~allowed, (len(queries), 1))
        if self.excluded is not None:
            hidden |= self.excluded.dense(queries)
        ranking = self.drive_filter(Ranked(ranked.rows[queries], ranked.scores[queries]), self.num_rows, hidden)
        rows = np.full_like(ranked.rows, -1)
        rows[queries, : ranking.rows.shape[1]] = ranking.rows
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
    sequence: DriveRanking | None = None  # ranks the queries of a drive together; None = each alone
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
    views: Views | None = None,
    options: SweepOptions = DEFAULT_OPTIONS,
) -> Int[np.ndarray, "views settings queries depth"]:
    """Database rows of the first candidates of every query's ranking by every setting, best first, -1 = none.

    Args:
        scorer: its other parameters stay.
        settings: values by name, the same names in each but for `c`: fields of the scorer (numbers are batch axes; each
            value of a static field has its own program), `weight` (a Weight), `max_distance` of matches, and `c` of the
            fusion with retrieval (None = balanced). Without `c` the score alone ranks.
        match_set: matches of queries with their candidates; several scales are fused over the candidates of a view.
        views: candidates that are ranked; by default one view, all of the shortlist.

    Raises:
        InputError: a setting that cannot be scored, or the folder cannot be used.
    """
    check_host(scorer)
    views = [view & candidates.mask for view in views or [candidates.mask]]
    num_queries, at_once = len(candidates.mask), min(options.settings_per_block or SETTINGS_PER_BLOCK, len(settings))
    size = num_queries if options.sequence else options.queries_per_block or queries_that_fit(match_set, at_once)
    parts = [range(num_queries)[start : start + size] for start in range(0, num_queries, max(1, size))]
    rows = np.full((len(settings), len(views), num_queries, max(options.ks)), -1, np.int32)
    files, keys = _files(scorer, settings, (match_set, candidates, views), options)
    missing = []
    for number, key in enumerate(keys):
        if files is None or (stored := files.get(key)) is None:
            missing.append(number)
        else:
            rows[number] = stored
    by_retrieval = retrieval_scores(candidates, options.retrieval_score)

    # Settings that differ in c alone share their scores.
    names = [name for name in settings[0] if name != FUSION]
    alone = [{name: setting[name] for name in names} for setting in settings]
    key_of = lambda number: tuple(id(v) if name == "weight" else v for name, v in alone[number].items())  # noqa: E731
    by_score = list(_group(missing, key_of).values())
    scored = [alone[first] for first, *_ in by_score]
    groups = list(group_by_program(scorer, scored, match_set.image_sizes))
    share = len(scored) / len(groups) if groups else 1  # settings of a program: with more, batches are smaller
    pairs = f"{int(candidates.mask.sum()):,} pairs of {num_queries:,} queries with their candidates"
    options.runtime.log(f"{options.label}: {len(missing):,} of {len(settings):,} settings to do on {pairs}")
    blocks = [block for group in groups for block in group.blocks(at_once)]
    batches_of = lru_cache(maxsize=1)(lambda queries: list(all_batches(match_set, queries, settings=share)))
    batches_of_block = sum(len(partition(each, part, settings=share)) for part in parts for each in scales(match_set))
    total = len(blocks) * batches_of_block
    program = lambda matches, scorer, *values: score_settings(scorer, matches, *values)  # noqa: E731
    ticks = iter(options.runtime.progress(options.label)(range(total), total))
    for block in blocks:
        of_block, firsts = np.unique(block.rows, return_index=True)  # the last block of a program repeats settings
        for queries in parts:
            part = slice(queries.start, queries.stop)
            shape = block.rows.size, len(scales(match_set)), len(queries), candidates.mask.shape[1]
            inputs, batches = (block.scorer, block.settings, block.weightings), batches_of(queries)
            scores = pair_scores(program, inputs, batches, shape, options.runtime.devices, ticks)[firsts]
            for of_setting in scores:
                require_finite("a setting of the sweep", of_setting)
            for view, mask in enumerate(views):
                seen = Shortlist(candidates.indices[part], candidates.scores[part], mask[part])
                for row, of_setting in zip(of_block, fuse_all(match_set, scores, seen.mask), strict=True):
                    for number in by_score[row]:
                        first = _first_rows(seen, of_setting, by_retrieval[part], settings[number], view, options)
                        rows[number, view, part, : first.shape[1]] = first
        if files is not None:
            files.update({keys[number]: rows[number] for row in of_block for number in by_score[row]})
    next(ticks, None)  # ends the progress
    return np.moveaxis(rows, 1, 0)


def _first_rows(
    candidates: Shortlist, scores: Scores, by_retrieval: Scores, setting: Setting, view: int, options: SweepOptions
) -> Int[np.ndarray, "queries _"]:
    """Database rows by the scores of a setting, fused with its c, among the candidates of a view."""
    if FUSION in setting:
        scores = np.asarray(fuse(by_retrieval, scores, candidates.mask, setting[FUSION]))
    ranked = Ranked.of(candidates, scores, options.ties)
    rows = ranked.rows if options.sequence is None else options.sequence.rows(ranked, view)
    return rows[:, : max(options.ks)]


def _files(
    scorer: Any, settings: Sequence[Setting], data: tuple[MatchSet | Scales, Shortlist, Views], options: SweepOptions
) -> tuple[CacheFiles[np.ndarray] | None, list[str]]:
    """Files of rows `[views, queries, depth]` in a folder named by what is swept, and the key of each setting.

    There are no files without a folder, or if a part of the sweep has no recipe.
    """
    no_keys = [""] * len(settings)
    if options.folder is None:
        return None, no_keys
    try:
        recipe = {"scorer": recipe_of(scorer), "versions": recipe_of(versions())}
        recipe["rows"] = recipe_of([max(options.ks), options.ties, options.retrieval_score, options.sequence])
        keys = [fingerprint(recipe_of(setting)) for setting in settings]
    except TypeError as error:
        options.runtime.log(f"{options.label}: no results are kept in {options.folder}, as there is no recipe: {error}")
        return None, no_keys
    match_set, candidates, views = data
    fusion = f"scales of {match_set.weights}" if isinstance(match_set, Scales) else "one scale"
    recipe["data"] = content_hash(fusion, [scale.fingerprint for scale in scales(match_set)], candidates, views)
    pack, unpack = lambda rows: {"rows": rows}, itemgetter("rows")
    return CacheFiles(options.folder, "sweep", recipe, pack, unpack), keys


class Verdict(NamedTuple):
    """Comparison of the recall@1 of the chosen settings, first, with the scorer's own values, at one threshold."""

    threshold: float
    queries: int  # that are reported on
    chosen: Estimate
    own: Estimate
    mcnemar: McNemar
    path_test: PathTest


@dataclass(frozen=True)
class Outcome:
    """All rankings of a sweep, and their evaluation."""

    axes: Axes
    protocol: EvaluationProtocol  # the ground truth, with the views of the shortlist
    settings: Sequence[Mapping[str, Any]]  # in plain values; those of a complete grid come first, in its order
    rows: Int[np.ndarray, "views settings queries depth"]  # of the database, best first
    ks: Sequence[int]  # depths of the recall, ascending, up to the depth of `rows`
    is_grid: bool  # whether `settings` has all settings of the grid

    @cached_property
    def recall(self) -> Float[np.ndarray, "settings tolerances"]:
        """Recall@1 over all queries."""
        return self.protocol.recall(self.rows[0])

    @property
    def own(self) -> int:
        """Number of the setting with the scorer's own values."""
        return self.settings.index(dict(self.axes.own_values))

    @cached_property
    def _tuning(self) -> Float[np.ndarray, "halves settings"]:
        """Recall@1 on the queries to choose on; below 0 for the scorer's own values where they are no choice."""
        recall = self.protocol.tuning(self.rows)[..., self.protocol.main]
        if self.is_grid:
            return recall[:, : self.axes.size]
        return np.where(np.arange(len(self.settings)) == self.own, -1.0, recall)

    @cached_property
    def chosen(self) -> list[int]:
        """Number of the best setting, for each half."""
        return [best_setting(recall, self.axes.values if self.is_grid else None) for recall in self._tuning]

    @cached_property
    def best(self) -> int:
        """Number of the best setting by the mean recall of the halves."""
        return best_setting(self._tuning.mean(axis=0), self.axes.values if self.is_grid else None)

    def forget_rankings(self, match_set: MatchSet | Scales, candidates: Shortlist, options: SweepOptions) -> None:
        """Remove the rows of this finished sweep from its folder, as changed code may rank otherwise."""
        settings, data = map(self.axes.setting, self.settings), (match_set, candidates, self.protocol.views)
        files, keys = _files(self.axes.scorer, [*settings], data, options)
        if files is not None:
            for key in keys:
                files.path(key).unlink(missing_ok=True)

    @cached_property
    def report(self) -> list[Verdict]:
        """Verdicts by threshold, on the queries to report on."""
        chosen_hits = self.protocol.reported_hits(self.rows, self.chosen)
        own_hits = self.protocol.reported_hits(self.rows, [self.own] * len(self.chosen))
        return [
            Verdict(threshold, len(ours), estimate(ours), estimate(own), mcnemar(ours, own), path_test(ours, own))
            for threshold, ours, own in zip(self.protocol.thresholds, chosen_hits, own_hits, strict=True)
        ]


def search_grid(
    axes: Axes,
    protocol: EvaluationProtocol,
    match_set: MatchSet | Scales,
    candidates: Shortlist,
    options: SweepOptions = DEFAULT_OPTIONS,
) -> Outcome:
    """Rank with every setting of a grid, and with the scorer's own values if the grid does not have them."""
    protocol, settings = protocol.of(candidates), axes.grid()
    settings += [] if dict(axes.own_values) in settings else [dict(axes.own_values)]
    of_scorer = list(map(axes.setting, settings))
    rows = rank_settings(axes.scorer, of_scorer, match_set, candidates, views=protocol.views, options=options)
    return Outcome(axes, protocol, settings, rows, sorted({*options.ks}), is_grid=True)


def search_optuna(
    axes: Axes,
    protocol: EvaluationProtocol,
    match_set: MatchSet | Scales,
    candidates: Shortlist,
    options: SweepOptions = DEFAULT_OPTIONS,
    *,
    trials: int,
    seed: int = 0,
) -> Outcome:
    """Rank with the scorer's own values, and with settings that Optuna's sampler (TPE) proposes from a seed.

    Numbers are drawn between the smallest and the largest value of an axis, words among its values. If the protocol has
    halves, Optuna gets the mean recall of the queries to choose on.
    """
    require_optuna()
    import optuna

    for setting in grid({name: axes.values[name] for name in CAPACITY if name in axes.values}):  # before any work
        fit_capacities(with_parameters(axes.scorer, setting), *match_set.image_sizes)
    protocol, settings = protocol.of(candidates), [dict(axes.own_values)]

    def rank(settings: list[dict[str, Any]], label: str) -> np.ndarray:
        of_scorer, labeled = list(map(axes.setting, settings)), replace(options, label=label)
        return rank_settings(axes.scorer, of_scorer, match_set, candidates, views=protocol.views, options=labeled)

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(direction="maximize", sampler=optuna.samplers.TPESampler(seed=seed))
    rows = [rank(settings, "own values")]
    while (done := len(settings) - 1) < trials:
        batch = [study.ask() for _ in range(min(BATCH, trials - done))]
        proposed = [suggest_setting(trial, axes) for trial in batch]
        rows.append(rank(proposed, f"trials {done + 1} to {done + len(batch)} of {trials}"))
        recall = protocol.tuning(rows[-1])[..., protocol.main].mean(axis=0)
        for trial, value in zip(batch, recall, strict=True):
            study.tell(trial, float(value))
        settings += proposed
    return Outcome(axes, protocol, settings, np.concatenate(rows, axis=1), sorted({*options.ks}), is_grid=False)


def require_optuna() -> None:
    """Raise `InputError` if Optuna is not installed."""
    if find_spec("optuna") is None:
        raise InputError("Optuna is not installed; pip install 'mfvpr[sweep]'")


def suggest_setting(trial: "optuna.Trial", axes: Axes) -> dict[str, Any]:
    """Draw a plain value of every axis."""
    setting = {}
    for name, values in axes.values.items():
        numbers = [value for value in values if isinstance(value, int | float) and not isinstance(value, bool)]
        if len(numbers) < len(values) or len(values) == 1:
            setting[name] = trial.suggest_categorical(name, values)
        elif name in axes.parameters and axes.parameters[name].rule.is_whole:
            setting[name] = trial.suggest_int(name, min(values), max(values))
        else:
            setting[name] = trial.suggest_float(name, min(values), max(values))
    return setting


def grid(axes: Mapping[str, Sequence[Any]]) -> list[dict[str, Any]]:
    """Every combination of the axes' values, the last axis fastest."""
    return [dict(zip(axes, values, strict=True)) for values in itertools.product(*axes.values())]


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


def group_by_program(
    scorer: Any, settings: Sequence[Setting], image_sizes: tuple[np.ndarray, np.ndarray]
) -> Iterator[Group]:
    """Group settings, with the same names in each, by program: each value of a static parameter, and None, has one."""
    static, integers = _static_names(scorer), {*whole_numbers(scorer), "weight"}
    weights = {id(setting["weight"]): setting["weight"] for setting in settings if "weight" in setting}
    numbers = {key: number for number, key in enumerate(weights)}  # of match weights, which take the place of them
    plain = [{**each, "weight": numbers[id(each["weight"])]} if weights else each for each in settings]
    pick = lambda row, names: tuple(plain[row][name] for name in names)  # noqa: E731
    column = lambda name, rows: np.array(  # noqa: E731
        [plain[row][name] for row in rows], int if name in integers else np.float32
    )
    is_choice = lambda item: item[0] in static or item[1] is None  # noqa: E731
    by_choices = _group(range(len(plain)), lambda row: tuple(filter(is_choice, plain[row].items())))
    for choices, members in by_choices.items():
        chosen = with_parameters(scorer, dict(choices))
        if weights:
            chosen = replace(chosen, weight=ChosenWeight(tuple(weights.values()), 0))
        chosen = with_static_functions(chosen)
        # Split the members into products `[G, W]` of settings and weightings.
        names = [name for name in plain[members[0]] if name not in dict(choices)]
        inner, outer = ([name for name in names if (name in MATCH_AXES) == is_inner] for is_inner in (True, False))
        lines = _group(members, lambda row: pick(row, outer)).values()  # noqa: B023
        products = _group(lines, lambda line: tuple(pick(row, inner) for row in line))  # noqa: B023
        for rows in map(np.array, products.values()):
            values = {name: column(name, rows[:, 0]) for name in outer}
            weightings = {name: column(name, rows[0]) for name in inner}
            for fitted, part in by_capacity(chosen, values, len(rows), *image_sizes):
                yield Group(fitted, {name: axis[part] for name, axis in values.items()}, weightings, rows[part])


def _group(items: Iterable[Item], key: Callable[[Item], Any]) -> dict[Any, list[Item]]:
    """Items by key, in order."""
    groups: dict[Any, list[Item]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return groups


def _parts(total: int, size: int) -> list[np.ndarray]:
    """Parts of range(total) of one length, at most `size`; the last part repeats its last number."""
    length = -(-total // -(-total // size))
    return [np.minimum(np.arange(start, start + length), total - 1) for start in range(0, total, length)]


def _static_names(scorer: Any) -> set[str]:
    """Dotted names of the static fields of a scorer, whose values select the compiled program."""
    names = set()
    for f in fields(scorer) if is_dataclass(scorer) else ():
        if f.metadata.get("static"):
            names.add(f.name)
        else:
            names |= {f"{f.name}.{name}" for name in _static_names(getattr(scorer, f.name))}
    return names
