"""The stages of learning: what is learned on one half of the path, or on some data sets, beside what is set by hand."""

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from experiments import build, console, data_sets, run_folder, stages, truth
from experiments.axes import learnable, own_c
from experiments.settings import SettingsError
from experiments.stages import Images
from mfvpr.datasets.sequences import own_rows
from mfvpr.matching import Scales
from mfvpr.report import comparisons, runs
from mfvpr.scoring import Scorer
from mfvpr.scoring.learned_weight import ABSOLUTE, RELATIVE
from mfvpr.tuning.learning.comparison import Checkpoints, compare
from mfvpr.tuning.learning.data_sets import Part, joined
from mfvpr.tuning.learning.losses import LOSSES
from mfvpr.tuning.learning.teaching import Options
from mfvpr.utils import Stopwatch, recipe_of
from mfvpr.utils.files import write_text
from mfvpr.utils.fingerprints import fingerprint
from mfvpr.utils.versions import versions

_INPUTS = {"relative": RELATIVE, "absolute": ABSOLUTE}


class Prepared(NamedTuple):
    """A data set with its matches; `recipe` is of these, `described` of what is right."""

    part: Part
    images: Images
    recipe: dict[str, Any]
    described: dict[str, Any]


def learn(settings: dict[str, Any]) -> None:
    """Matches -> learned, searched and hand-set scores on what none of them saw -> table, figures, files."""
    with run_folder.claimed(settings) as folder:
        varied, how, watch = learnable(settings), _options(settings), Stopwatch()
        sets = [_prepared(one, watch) for one in _each(settings)]
        taught, reported, whole = sets, sets[:0], sets[0].part
        if settings["report"]:
            others = len(data_sets.composed("report", settings["report"]))
            taught, reported = sets[:-others], sets[-others:]
            check_apart(taught, reported)
            whole = joined(*([one.part for one in some] for some in (taught, reported)))
        with watch("learning"):
            options = {"checkpoints": _checkpoints(settings, varied.scorer, whole, sets), "track": console.track}
            data = varied, whole.judge, whole.match_set, whole.candidates
            comparison = compare(*data, how, **options)
        heading = _heading(settings, whole, taught, reported)
        text = f"{heading}\n\n{comparisons.text(comparison)}"
        left_out = ("dataset", "store", "out", "checkpoints", "multirun", "command")
        several = {"data_sets": [*map(_about, taught)], "reported_sets": [*map(_about, reported)]}
        several = several if reported else _about(sets[0])
        results = {
            **several, **comparisons.results(comparison),
            "settings": {name: value for name, value in settings.items() if name not in left_out},
            "seconds": watch.seconds, "versions": versions(),
        }  # fmt: skip

        def write(new: Path) -> None:
            runs.write_table(new, comparisons.table(comparison), heading)
            runs.write_json(new / "results.json", results)
            made = {"command": settings.get("command"), "commit": runs.commit(Path()), **results}
            del made["rows"], made["queries"], made["seconds"]
            comparisons.write_weights(new / "weights", comparison, made)
            write_text(new / "summary.txt", f"{text}\n")

        figures = comparisons.figures(comparison)
        described = {one.part.name: one.described for one in reported} if reported else sets[0].described
        run_folder.leave(folder, settings, described, text=text, write=write, figures=figures)


def _each(settings: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """The settings of each data set: those to learn on, then those to report on."""
    if not settings["report"]:
        yield settings
        return
    others = [one for name in ("also", "report") if settings[name] for one in data_sets.composed(name, settings[name])]
    for dataset in (settings["dataset"], *others):
        yield settings | {"dataset": dataset, "split": None}


def _prepared(settings: dict[str, Any], watch: Stopwatch) -> Prepared:
    if len(sizes := settings["features"].get("patch_sizes", [])) > 1:
        raise SettingsError(f"features.patch_sizes={sizes}: expected one size, since learning knows one scale")
    tools, images = stages.begun(settings, watch)
    judge = truth.judge(settings, images.dataset)
    matches, candidates = stages.matched(settings, tools, images, watch)
    if isinstance(matches, Scales):
        raise ValueError("expected features of one scale, since learning knows one")
    recipe = stages.recipe(tools, images, candidates.mask.shape[1])
    part = Part(data_sets.label(settings["dataset"]), judge, matches, candidates)
    return Prepared(part, images, recipe, truth.description(settings, images.dataset))


def check_apart(teach: list[Prepared], report: list[Prepared]) -> None:
    """Refuse to report on images that were learned on, and queries that would count twice."""
    for one, other in itertools.product(teach, report):
        sides = itertools.product(other.images.contents.values(), one.images.contents.values())
        if same := sum(bool(rows) for pair in sides for rows in own_rows(*pair)):
            raise SettingsError(f"report={other.part.name}: expected other images than those of {one.part.name}, "
                                f"which is learned on; {same} are the same")  # fmt: skip
    for one, other in (pair for sets in (teach, report) for pair in itertools.combinations(sets, 2)):
        if same := sum(map(bool, own_rows(*(each.images.contents["query"] for each in (other, one))))):
            raise SettingsError(f"{other.part.name}: expected other queries than those of {one.part.name}; {same} are "
                                "the same, and would count twice")  # fmt: skip
    for one, other in itertools.combinations(report, 2):
        if any(own_rows(*(each.images.contents["database"] for each in (other, one)))):
            console.tell(f"warning: {one.part.name} and {other.part.name} are of one map, but their queries are taken "
                         "for independent, so that intervals are too narrow and p too low")  # fmt: skip


def _about(one: Prepared) -> dict[str, Any]:
    return {
        "dataset": one.images.dataset.name, "ground_truth": one.described,
        "data_fingerprint": one.images.fingerprints, "reading": one.images.reading,
    }  # fmt: skip


def _options(settings: dict[str, Any]) -> Options:
    names = ("ties", "steps", "every", "patience", "batch", "learning_rate", "hidden", "seed")
    return Options(
        c=own_c(settings), filter_score=settings["fusion"]["filter_score"], loss=LOSSES[settings["loss"]],
        inputs=_INPUTS[settings["inputs"]], **{name: settings[name] for name in names},
    )  # fmt: skip


def _checkpoints(settings: dict[str, Any], scorer: Scorer, whole: Part, sets: list[Prepared]) -> Checkpoints | None:
    """Where the trainings are kept, and what identifies them."""
    root = settings["checkpoints"] or settings["store"]
    if root is None:
        return None
    names = ("loss", "every", "patience", "batch", "learning_rate", "hidden", "inputs", "seed")
    recipe = {
        "matches": [one.recipe for one in sets], "scorer": recipe_of(scorer),
        "tolerances": settings["recall"], **{name: settings[name] for name in names},
        "filter_score": settings["fusion"]["filter_score"], "positives": whole.judge.fingerprint,
        "reported": dict(whole.judge.reported_sets),
        "versions": {name: versions()[name] for name in ("mfvpr", "jax", "numpy")},
    }  # fmt: skip
    own = "" if settings["checkpoints"] else f"{settings['dataset']['name']}_learning-{fingerprint(recipe)}"
    return Checkpoints(build.expanded(root) / own, recipe)


def _heading(settings: dict[str, Any], whole: Part, taught: list[Prepared], reported: list[Prepared]) -> str:
    what = f"{settings['scorer']['method']} score, {settings['features']['name']} features"
    right = truth.in_words(*(one.described for one in reported or taught))
    if reported:
        learned, told = (", ".join(one.part.name for one in sets) for sets in (taught, reported))
        return f"{learned}: {what}; what was learned here is reported on {told}; {right}"
    queries = sum(len(half.report) for half in whole.judge.halves)
    return (
        f"{whole.name}: {what}; each of {queries} queries is reported on by what was learned on the other half of the "
        f"path; {right}"
    )
