"""Learn scores on one half of the path, or on some data sets, and compare them with hand-set and searched ones."""

import itertools
from collections.abc import Mapping
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

from mfvpr.baselines import SCORERS
from mfvpr.baselines.learned_weight import ABSOLUTE, RELATIVE
from mfvpr.cli import jobs
from mfvpr.cli.command_line import compose_data_sets
from mfvpr.cli.console import warn
from mfvpr.cli.jobs import Inputs, prepare, score_in_words, truth_in_words
from mfvpr.cli.schema import Learn
from mfvpr.cli.sweeping import axes_of
from mfvpr.datasets.contents import identical_rows
from mfvpr.evaluation.dataset_ranking import matches_recipe
from mfvpr.matchers import Scales
from mfvpr.report import runs, searches
from mfvpr.systems.assembly import without
from mfvpr.tuning.learning.models import LOSSES, Options, compare
from mfvpr.tuning.learning.splits import Part, join_data_sets
from mfvpr.tuning.learning.training import Checkpoints
from mfvpr.tuning.sweeps import Axes, can_learn
from mfvpr.utils import Stopwatch, recipe_of
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import to_values
from mfvpr.utils.files import expand_user, write_text
from mfvpr.utils.fingerprints import versions

_TRAINING = ("every", "patience", "batch", "learning_rate", "hidden", "seed")
_INPUTS = {"relative": RELATIVE, "absolute": ABSOLUTE}


class Prepared(NamedTuple):
    """A data set with its matches, and what they were made from."""

    part: Part
    inputs: Inputs[Learn]


def learn(settings: Learn) -> None:
    """Learn, search, compare on queries that were not learned on, fill the run folder."""
    with jobs.claim(settings.out, settings.dataset["name"]) as folder:
        known = [name for name, scorer in SCORERS.items() if can_learn(scorer)]
        if (method := settings.scorer.get("method")) not in known:
            raise InputError(f"scorer={method or 'several'}: expected one to learn, of {', '.join(known)}")
        if len(sizes := settings.features.get("patch_sizes", [])) > 1:
            raise InputError(f"features.patch_sizes={sizes}: expected one size, since learning knows one scale")
        axes, watch = axes_of(settings), Stopwatch()
        also, reported = compose_data_sets(settings.also or []), compose_data_sets(settings.report or [])
        teach = [_prepare(settings, settings.dataset, bool(reported), watch)]
        settings = teach[0].inputs.settings
        teach += [_prepare(settings, dataset, bool(reported), watch) for dataset in also]
        report, data = [_prepare(settings, dataset, True, watch) for dataset in reported], teach[0].part
        if report:
            require_disjoint(teach, report)
            data = join_data_sets([each.part for each in teach], [each.part for each in report])
        c = settings.fusion.c
        options = Options(
            c=None if isinstance(c, str) else float(c),
            retrieval_score=settings.fusion.retrieval_score,
            loss=LOSSES[settings.loss],
            inputs=_INPUTS[settings.inputs],
            **{name: getattr(settings, name) for name in (*_TRAINING, "ties", "steps")},
        )
        with watch("learning"):
            checkpoints = _checkpoints(settings, axes, data, teach + report)
            matched, runtime = (data.protocol, data.match_set, data.candidates), teach[0].inputs.cache.runtime
            comparison = compare(axes, *matched, options, checkpoints=checkpoints, runtime=runtime)
        words = f"{sum(len(half.report) for half in data.protocol.halves)} queries of the other half of the path"
        words = ", ".join(each.part.name for each in report) or words
        names = ", ".join(each.part.name for each in teach)
        truths = (each.inputs.ground_truth for each in report or teach)
        heading = (
            f"{names}: {score_in_words(settings)}, learned here and reported on {words}; {truth_in_words(*truths)}"
        )
        text = f"{heading}\n\n{searches.comparison_text(comparison)}"
        left_out = ("dataset", "cache", "out", "checkpoints", "cluster", "compiled")
        about, ground_truth = teach[0].inputs.about, teach[0].inputs.ground_truth
        if report:
            data_sets, reported_sets = ([each.inputs.about for each in sets] for sets in (teach, report))
            about = {"data_sets": data_sets, "reported_sets": reported_sets}
            ground_truth = {each.part.name: each.inputs.ground_truth for each in report}
        results = {
            **about,
            **searches.comparison_json(comparison),
            "settings": without(to_values(settings), *left_out),
            "seconds": watch.seconds,
            "versions": versions(),
        }

        def write(new: Path) -> None:
            runs.write_table(new, searches.comparison_table(comparison), heading)
            runs.write_json(new / "results.json", results)
            origin = {"command": settings.command, "commit": runs.commit(Path())}
            origin |= without(results, "rows", "queries", "seconds")
            searches.write_weights(new / "weights", comparison, origin)
            write_text(new / "summary.txt", f"{text}\n")

        figures = searches.comparison_figures(comparison)
        jobs.write_results(folder, settings, ground_truth, text=text, write=write, figures=figures)


def _prepare(settings: Learn, dataset: Mapping[str, Any], is_whole: bool, watch: Stopwatch) -> Prepared:
    """A data set of which all queries, or one half at a time, are learned or reported on."""
    inputs = prepare(replace(settings, dataset=dataset), watch)
    protocol = inputs.protocol(None if is_whole else settings.split)
    matches, candidates = inputs.match()
    assert not isinstance(matches, Scales)
    return Prepared(Part(label(dataset), protocol, matches, candidates), inputs)


def label(settings: Mapping[str, Any]) -> str:
    """Name of a data set; streets of different seeds get different names."""
    return f"{settings['name']} {settings['seed']}" if "seed" in settings else settings["name"]


def require_disjoint(teach: list[Prepared], report: list[Prepared]) -> None:
    """Raise an InputError for reports on images that were learned on, and for queries that would count twice."""
    for first, second in itertools.product(teach, report):
        sides = itertools.product(second.inputs.contents.values(), first.inputs.contents.values())
        if same := sum(bool(rows) for pair in sides for rows in identical_rows(*pair)):
            raise InputError(f"report={second.part.name}: expected no images of {first.part.name}; {same} are the same")
    for first, second in (*itertools.combinations(teach, 2), *itertools.combinations(report, 2)):
        if same := sum(map(bool, identical_rows(second.inputs.contents["query"], first.inputs.contents["query"]))):
            raise InputError(f"{second.part.name}: expected no queries of {first.part.name}; {same} would count twice")
    for first, second in itertools.combinations(report, 2):
        if any(identical_rows(second.inputs.contents["database"], first.inputs.contents["database"])):
            warn(f"{first.part.name} and {second.part.name} are of one map: intervals and p are too small")


def _checkpoints(settings: Learn, axes: Axes, data: Part, sets: list[Prepared]) -> Checkpoints | None:
    """Folder and recipe of the checkpoints; None without a folder."""
    root = settings.checkpoints or settings.cache
    if root is None:
        return None
    recipe = {
        "matches": [matches_recipe(of.dataset, of.dataset.only, of.pipeline, of.cache) for _, of in sets],
        "scorer": recipe_of(axes.scorer),
        "tolerances": to_values(settings.recall),
        **{name: getattr(settings, name) for name in (*_TRAINING, "loss", "inputs")},
        "retrieval_score": settings.fusion.retrieval_score,
        "positives": recipe_of([*data.protocol.positives]),
        "reported": dict(data.protocol.reported_sets),
        "versions": {**{name: versions()[name] for name in ("mfvpr", "jax", "numpy")}, "optax": version("optax")},
    }
    return Checkpoints(expand_user(root), recipe)
