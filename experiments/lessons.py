"""The stages of learning: what is learned on one half of the path, beside what is set by hand, on the other half."""

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
import optax

import mfvpr
from experiments import axes, build, console, learn_outputs, prepare, run_folder, stores, truth
from experiments.models import LOSSES, Lesson, Model, model
from experiments.settings import SettingsError
from mfvpr import pipeline, sweeping
from mfvpr.evaluation import Half, Judge, Positives, best_setting, hits, separated
from mfvpr.learning.match_weight import LearnedWeight
from mfvpr.learning.parameters import can_learn
from mfvpr.learning.training import Fit, fit
from mfvpr.numerics import round_up
from mfvpr.pipeline import MatchSet
from mfvpr.report import runs
from mfvpr.scoring import SCORERS, parameters
from mfvpr.stores.manifest import recipe_fingerprint
from mfvpr.types import Matches, Shortlist

VALIDATION = 0.25  # of the queries to learn on, the end of their block


@dataclass(frozen=True)
class School:
    """One half of the path to learn on.

    Attributes:
        settings: all.
        matches: of all queries.
        candidates: of all queries.
        judge: what is right.
        half: where to choose and where to report.
        learning: `[t]` queries of the losses.
        validating: `[v]` queries that stop the learning.
        seen: `[Q, C]` bool, candidates that learning may look at.
        name: of the half.
    """

    settings: dict[str, Any]
    matches: MatchSet
    candidates: Shortlist
    judge: Judge
    half: Half
    learning: np.ndarray
    validating: np.ndarray
    seen: np.ndarray
    name: str

    def part(self, queries: np.ndarray) -> tuple[MatchSet, Shortlist]:
        """Matches and candidates of some queries."""
        chosen = [self.matches.matches[query] for query in queries]
        part = MatchSet(chosen, self.matches.counts[queries], self.matches.capacity)
        return part, jax.tree.map(lambda values: values[queries], self.candidates)

    @cached_property
    def right(self) -> np.ndarray:
        """`[Q, C]` bool, candidates that are right within the threshold that decides."""
        return self._positive(self.judge.positives[self.judge.main])

    @cached_property
    def usable(self) -> np.ndarray:
        """`[Q, C]` bool, candidates of the losses: seen, and not right by the widest threshold alone."""
        return self.seen & ~(self._positive(self.judge.positives[-1]) & ~self.right)

    def _positive(self, positives: Positives) -> np.ndarray:
        return positives.contains(self.candidates.indices) & self.candidates.mask

    @cached_property
    def width(self) -> int:
        """Candidates that hold every query's usable ones."""
        return round_up(int(self.usable[self.half.tune].sum(axis=1).max()), 8)

    def lesson(self, queries: np.ndarray, size: int) -> Lesson:
        """Some queries, padded to `size`; padding has no candidates, and what is no candidate has no matches."""
        padded = np.concatenate([queries, np.repeat(queries[-1:], size - len(queries))])
        places = np.argsort(~self.usable[padded], axis=1, kind="stable")[:, : self.width]
        take = partial(np.take_along_axis, indices=places, axis=1)
        mask = take(self.usable[padded]) & (np.arange(size) < len(queries))[:, None]
        matches = [jax.tree.map(lambda values: values[order], self.matches[query])  # noqa: B023
                   for query, order in zip(padded, places, strict=True)]  # fmt: skip
        stacked: Matches = jax.tree.map(lambda *values: np.stack(values), *matches)
        stacked = replace(stacked, mask=stacked.mask & mask[..., None])
        return Lesson(stacked, take(self.candidates.scores[padded]), take(self.right[padded]), mask)


def learn(settings: dict[str, Any]) -> None:
    """Matches -> learned, searched and hand-set scores on the half that none of them saw -> table, figures, files."""
    with run_folder.claimed(settings) as folder:
        outcome = _outcome(settings)
        run_folder.leave(
            folder, settings, truth.described(settings, outcome.images.dataset), text=learn_outputs.text(outcome),
            write=lambda new: learn_outputs.write(new, outcome), figures=learn_outputs.figures(outcome),
        )  # fmt: skip


def _outcome(settings: dict[str, Any]) -> "learn_outputs.Outcome":
    method = settings["scorer"].get("method", "all")
    known = [name for name, scorer in SCORERS.items() if can_learn(scorer)]
    if method not in known:
        raise SettingsError(f"scorer={method}: expected one to learn, of {', '.join(known)}")
    varied = axes.axes(settings)
    if settings["split"] is None:
        raise SettingsError("split=null: what is learned is never reported on the same queries; expected first_half, "
                            "second_half or both")  # fmt: skip
    tools = prepare.extractors(settings)
    watch = prepare.Stopwatch()
    with watch("data"):
        images = prepare.images(settings)
    judgment = truth.judge(settings, images.dataset)
    matches, candidates = prepare.matched(settings, tools, images, watch, with_ratio=True)
    axes.require_bins(settings, varied, matches)
    candidates = replace(candidates, scores=pipeline.filter_scores(candidates, settings["fusion"]["filter_score"]))
    checkpoints = _checkpoints(settings, images, candidates, judgment)
    results = []
    with watch("learning"):
        for school in _schools(settings, matches, candidates, judgment):
            results.append(list(_lessons(school, varied, checkpoints)))
    return learn_outputs.Outcome(settings, images, judgment, matches, candidates, results, watch.seconds)


def _schools(settings: dict[str, Any], matches: MatchSet, candidates: Shortlist, judgment: Judge) -> Iterator[School]:
    names = ["first_half", "second_half"] if settings["split"] == "both" else [settings["split"]]
    for name, half in zip(names, judgment.halves, strict=True):
        cut = len(half.tune) - round(VALIDATION * len(half.tune))
        apart = separated(judgment.places, half.tune[:cut], half.tune[cut:])
        seen = candidates.mask & half.allowed[np.maximum(candidates.indices, 0)]
        school = School(settings, matches, candidates, judgment, half, apart.tune, apart.report, seen, name)
        right, wrong = school.right & school.usable, ~school.right & school.usable
        teaches = np.asarray(right.any(axis=1) & wrong.any(axis=1))  # the loss of others is 0, whatever the scores
        school = replace(
            school, learning=apart.tune[teaches[apart.tune]], validating=apart.report[teaches[apart.report]]
        )
        if not len(school.learning) or not len(school.validating):
            raise SettingsError(
                f"split={name}: expected queries to learn on and to validate with, got {len(school.learning)} and "
                f"{len(school.validating)}; use more queries or candidates"
            )
        yield school


def _lessons(
    school: School, varied: axes.Axes, checkpoints: Callable[[str, str], Any]
) -> Iterator["learn_outputs.Result"]:
    """Every row of the table, on the queries of the half that is reported on."""
    own, c = axes.scorer(school.settings), _own_c(school.settings)
    yield _reported(school, "paper", own, {})
    yield _reported(school, "paper + filter", own, {"c": c})
    spread = _spread(school, own)
    for fused in (False, True):
        chosen, written = _searched(school, varied, spread, fused=fused)
        yield replace(_reported(school, "grid search" + " + filter" * fused, own, chosen), values=written)
    for learned_weight in (False, True):
        for fused in (False, True):
            name = ("match weights" if learned_weight else "gradient") + " + filter" * fused
            start = _start(school, name, own, fused=fused, learned_weight=learned_weight)
            fitted = _fit(school, start, *checkpoints(school.name, name))
            values = _values(start, fitted)
            setting = {"c": values["c"]} if fused else {}
            found = _reported(school, name, start.scorer_of(fitted.parameters), setting)
            yield replace(found, values=values, fitted=fitted)


def _own_c(settings: dict[str, Any]) -> float | None:
    """The filter's weight by hand, None = balanced."""
    c = settings["fusion"]["c"]
    return None if c == "auto" else float(c)


def _start(school: School, name: str, own: Any, *, fused: bool, learned_weight: bool) -> Model:
    weight = None
    if learned_weight:
        own = replace(own, weight=mfvpr.UnitWeight())  # what a learned weight starts as
        seed = jax.random.key(school.settings["seed"])
        sample = school.lesson(school.learning[: school.settings["batch"]], school.settings["batch"])
        weight = LearnedWeight.create(seed, sample.matches, school.settings["hidden"])
    spread = _spread(school, own)
    start = 0.3 * _balance(school, spread) if fused else None
    return model(name, parameters.fit(own, *school.matches.image_sizes), spread, fused=start, weight=weight)


def _fit(school: School, start: Model, folder: Path | None, recipe: dict[str, Any]) -> Fit:
    settings, size = school.settings, school.settings["batch"]
    objective = start.objective(LOSSES[settings["loss"]])
    validated = jax.jit(objective)
    parts = [school.validating[place : place + size] for place in range(0, len(school.validating), size)]
    lessons = [school.lesson(part, size) for part in parts]

    def batches(step: int) -> Lesson:
        """Every query once before any comes again, in an order that the step alone decides."""
        per_epoch = -(-len(school.learning) // size)
        epoch, place = divmod(step, per_epoch)
        order = np.random.default_rng([settings["seed"], epoch]).permutation(school.learning)
        return school.lesson(order[place * size : (place + 1) * size], size)

    def validate(parameters: Any) -> float:
        found = [float(validated(parameters, lesson)) * len(part) for lesson, part in zip(lessons, parts, strict=True)]
        return sum(found) / len(school.validating)

    return fit(
        start.start, objective, batches, optimizer=optax.adam(settings["learning_rate"]), steps=settings["steps"],
        validate=validate, every=settings["every"], patience=settings["patience"], folder=folder, recipe=recipe,
        track=console.track(f"{school.name}: {start.name}"),
    )  # fmt: skip


def _reported(school: School, name: str, scorer: Any, setting: dict[str, Any]) -> "learn_outputs.Result":
    """A scorer with the values of a setting, on the half that is reported on, with all candidates."""
    [rows] = _ranked(school, name, scorer, [setting], school.half.report, school.candidates.mask)
    right = [hits(rows, positives.take(school.half.report)) for positives in school.judge.positives]
    return learn_outputs.Result(school.name, name, np.stack(right), {}, None)


def _searched(
    school: School, varied: axes.Axes, spread: float, *, fused: bool
) -> tuple[dict[str, Any], dict[str, Any]]:
    """The best setting of the grid on the half to choose on: its values, and as they were written."""
    values = {name: axis for name, axis in varied.values.items() if name != "c" or fused}
    written, balance = sweeping.grid(values), _balance(school, spread)

    def setting(one: dict[str, Any]) -> dict[str, Any]:
        chosen = dict(varied.setting(one))
        if fused and "c" not in chosen:
            return chosen | {"c": _own_c(school.settings)}
        return chosen | ({"c": chosen["c"] * balance} if chosen.get("c") is not None else {})

    settings, tune = [setting(one) for one in written], school.half.tune
    own = axes.scorer(school.settings)
    rows = _ranked(school, "grid search" + " + filter" * fused, own, settings, tune, school.seen)
    right = school.judge.positives[school.judge.main].take(tune)
    best = best_setting(hits(rows, right).mean(axis=-1), values)
    return settings[best], written[best]


def _ranked(
    school: School, name: str, scorer: Any, settings: list[dict[str, Any]], queries: np.ndarray, seen: np.ndarray
) -> np.ndarray:
    """`[S, q, 1]` the first row of some queries' rankings of the candidates that are seen, by every setting."""
    matches, candidates = school.part(queries)
    track = console.track(f"{school.name}: {name}") if len(settings) > 1 else pipeline.untracked
    views, ties = [seen[queries]], school.settings["ties"]
    return sweeping.sweep(scorer, settings, matches, candidates, views=views, depth=1, ties=ties, track=track)[0]


def _spread(school: School, scorer: Any) -> float:
    """Standard deviation of the scores that learning may see."""
    matches, candidates = school.part(school.learning)
    scores = pipeline.score({"it": scorer}, matches, candidates)["it"]
    return float(np.std(scores[school.seen[school.learning]])) or 1.0


def _balance(school: School, spread: float) -> float:
    """The c that gives the filter's scores the same spread."""
    deviation = float(np.std(school.candidates.scores[school.learning][school.seen[school.learning]]))
    return spread / deviation if deviation else 0.0


def _values(start: Model, fitted: Fit) -> dict[str, Any]:
    numbers = start.scorer_of(fitted.parameters)
    names = fitted.parameters["numbers"]
    values: dict[str, Any] = {name: float(getattr(numbers, name)) for name in names}
    c = start.c_of(fitted.parameters)
    return values if c is None else values | {"c": float(c)}


def _checkpoints(
    settings: dict[str, Any], images: prepare.Images, candidates: Shortlist, judgment: Judge
) -> Callable[[str, str], tuple[Path | None, dict[str, Any]]]:
    """Where the training of a half's model is kept, and what identifies it."""
    data = stores.matches_recipe(settings, images.fingerprints, candidates.mask.shape[1])
    names = ("scorer", "loss", "every", "patience", "batch", "learning_rate", "hidden", "seed")
    recipe = {"matches": data, "tolerances": settings["recall"]} | {name: settings[name] for name in names}
    recipe["filter_score"] = settings["fusion"]["filter_score"]
    flat = [array.tobytes() for right in judgment.positives for array in (right.offsets, right.rows)]
    recipe["positives"] = hashlib.sha256(b"".join(flat)).hexdigest()[:16]
    recipe["versions"] = {name: runs.versions()[name] for name in ("mfvpr", "jax", "numpy")}
    root = settings["checkpoints"] or settings["store"]
    own = "" if settings["checkpoints"] else f"{settings['dataset']['name']}_learning-{recipe_fingerprint(recipe)}"

    def of(half: str, name: str) -> tuple[Path | None, dict[str, Any]]:
        place = f"{half}-{name}".replace(" ", "_").replace("_+_", "_")
        return (build.expanded(root) / own / place if root else None), recipe | {"half": half, "model": name}

    return of
