"""Learn scores on one half of the path, or on some data sets, and compare them with hand-set and searched ones."""

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from mfvpr.baselines import SCORERS
from mfvpr.baselines.learned_weight import ABSOLUTE, RELATIVE
from mfvpr.cli import console, run_folder
from mfvpr.cli.command_line import compose_data_sets
from mfvpr.cli.inputs import cache_of, prepare, truth_in_words, with_image_size
from mfvpr.cli.schema import Learn
from mfvpr.cli.sweeping import axes_of, retrieval_weight
from mfvpr.core import Scorer
from mfvpr.datasets.contents import Contents, fingerprints, own_rows, readings
from mfvpr.evaluation.protocol import Split
from mfvpr.matchers import Scales
from mfvpr.report import comparisons, runs
from mfvpr.report.run_files import matched_content
from mfvpr.systems.choices import without
from mfvpr.tuning.learning.comparison import compare
from mfvpr.tuning.learning.models import LOSSES, Options
from mfvpr.tuning.learning.splits import Part, join_data_sets
from mfvpr.tuning.learning.training import Checkpoints
from mfvpr.tuning.sweeps import Axes
from mfvpr.tuning.sweeps.setting_search import can_learn
from mfvpr.utils import Stopwatch, recipe_of
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import to_values
from mfvpr.utils.files import expand_user, write_text
from mfvpr.utils.fingerprints import fingerprint
from mfvpr.utils.versions import versions

_INPUTS = {"relative": RELATIVE, "absolute": ABSOLUTE}


class Prepared(NamedTuple):
    """A data set with its matches, and what they were made from."""

    part: Part
    contents: Mapping[str, Contents]  # of the image files, by side
    recipe: dict[str, Any]
    about: dict[str, Any]  # in results


def learn(settings: Learn) -> None:
    """Learn, search, compare on queries that were not learned on, fill the run folder."""
    settings = with_image_size(settings)
    with run_folder.claim(settings.out, settings.dataset["name"]) as folder:
        axes, options, watch = _axes(settings), _options(settings), Stopwatch()
        split = None if settings.report else settings.split
        teach = [_prepare(choice, split, watch) for choice in _settings_by_data_set(settings)]
        report, data = [], teach[0].part
        if settings.report:
            number = len(settings.report)
            teach, report = teach[:-number], teach[-number:]
            require_disjoint(teach, report)
            data = join_data_sets([data_set.part for data_set in teach], [data_set.part for data_set in report])
        with watch("learning"):
            checkpoints = _checkpoints(settings, axes.scorer, data, teach + report)
            matched, runtime = (data.protocol, data.match_set, data.candidates), cache_of(settings).runtime
            comparison = compare(axes, *matched, options, checkpoints=checkpoints, runtime=runtime)
        heading = _heading(settings, data, teach, report)
        text = f"{heading}\n\n{comparisons.comparison_text(comparison)}"
        left_out = ("dataset", "cache", "out", "checkpoints", "cluster", "compiled")
        about = {"data_sets": [each.about for each in teach], "reported_sets": [each.about for each in report]}
        results = {
            **(about if report else teach[0].about),
            **comparisons.comparison_json(comparison),
            "settings": without(to_values(settings), *left_out),
            "seconds": watch.seconds,
            "versions": versions(),
        }

        def write(new: Path) -> None:
            runs.write_table(new, comparisons.comparison_table(comparison), heading)
            runs.write_json(new / "results.json", results)
            origin = {"command": settings.command, "commit": runs.commit(Path()), **results}
            del origin["rows"], origin["queries"], origin["seconds"]
            comparisons.write_weights(new / "weights", comparison, origin)
            write_text(new / "summary.txt", f"{text}\n")

        figures = comparisons.comparison_figures(comparison)
        by_name = {data_set.part.name: data_set.about["ground_truth"] for data_set in report}
        ground_truth = by_name if report else teach[0].about["ground_truth"]
        run_folder.write_results(folder, settings, ground_truth, text=text, write=write, figures=figures)


def _settings_by_data_set(settings: Learn) -> Iterator[Learn]:
    """Settings of each data set: those to learn on, then those to report on."""
    if not settings.report:
        yield settings
        return
    more = compose_data_sets("also", settings.also or []), compose_data_sets("report", settings.report)
    for dataset in (settings.dataset, *itertools.chain(*more)):
        yield replace(settings, dataset=dataset, also=None, report=None)


def _prepare(settings: Learn, split: Split | None, watch: Stopwatch) -> Prepared:
    if len(sizes := settings.features.get("patch_sizes", [])) > 1:
        raise InputError(f"features.patch_sizes={sizes}: expected one size, since learning knows one scale")
    inputs = prepare(settings, watch)
    protocol = inputs.protocol(split)
    matches, candidates = inputs.match(watch)
    assert not isinstance(matches, Scales)
    part = Part(label(settings.dataset), protocol, matches, candidates)
    about = {
        "dataset": inputs.dataset.name,
        "ground_truth": inputs.ground_truth,
        "data_fingerprint": fingerprints(inputs.contents),
        "reading": readings(inputs.contents),
    }
    return Prepared(part, inputs.contents, inputs.matches_recipe(), about)


def label(settings: Mapping[str, Any]) -> str:
    """Name of a data set; streets of different seeds get different names."""
    return f"{settings['name']} {settings['seed']}" if "seed" in settings else settings["name"]


def require_disjoint(teach: list[Prepared], report: list[Prepared]) -> None:
    """Raise a InputError for reports on images that were learned on, and for queries that would count twice."""
    for first, second in itertools.product(teach, report):
        sides = itertools.product(second.contents.values(), first.contents.values())
        if same := sum(bool(rows) for pair in sides for rows in own_rows(*pair)):
            raise InputError(f"report={second.part.name}: expected other images than those of {first.part.name}, "
                                f"which is learned on; {same} are the same")  # fmt: skip
    for first, second in (*itertools.combinations(teach, 2), *itertools.combinations(report, 2)):
        if same := sum(map(bool, own_rows(second.contents["query"], first.contents["query"]))):
            raise InputError(f"{second.part.name}: expected other queries than those of {first.part.name}; {same} "
                                "are the same, and would count twice")  # fmt: skip
    for first, second in itertools.combinations(report, 2):
        if any(own_rows(second.contents["database"], first.contents["database"])):
            console.tell(f"warning: {first.part.name} and {second.part.name} are of one map, but their queries are "
                         "taken for independent, so that intervals are too narrow and p too low")  # fmt: skip


def _axes(settings: Learn) -> Axes:
    """The axes that learning searches for comparison, if the scorer can be learned."""
    method, known = settings.scorer.get("method"), [name for name, scorer in SCORERS.items() if can_learn(scorer)]
    if method not in known:
        raise InputError(f"scorer={method or 'several'}: expected one to learn, of {', '.join(known)}")
    if settings.split is None:
        raise InputError("split=null: expected first_half, second_half or both, to report on other queries than those "
                         "of learning")  # fmt: skip
    return axes_of(settings)


def _options(settings: Learn) -> Options:
    names = ("ties", "steps", "every", "patience", "batch", "learning_rate", "hidden", "seed")
    return Options(
        c=retrieval_weight(settings),
        retrieval_score=settings.fusion.retrieval_score,
        loss=LOSSES[settings.loss],
        inputs=_INPUTS[settings.inputs],
        **{name: getattr(settings, name) for name in names},
    )


def _checkpoints(settings: Learn, scorer: Scorer, data: Part, sets: list[Prepared]) -> Checkpoints | None:
    """Folder and recipe of the checkpoints; None without a folder."""
    root = settings.checkpoints or settings.cache
    if root is None:
        return None
    names = ("loss", "every", "patience", "batch", "learning_rate", "hidden", "inputs", "seed")
    recipe = {
        "matches": [data_set.recipe for data_set in sets],
        "scorer": recipe_of(scorer),
        "tolerances": to_values(settings.recall),
        **{name: getattr(settings, name) for name in names},
        "retrieval_score": settings.fusion.retrieval_score,
        "positives": data.protocol.fingerprint,
        "reported": dict(data.protocol.reported_sets),
        "versions": {name: versions()[name] for name in ("mfvpr", "jax", "numpy")},
    }
    name = "" if settings.checkpoints else f"{settings.dataset['name']}_learning-{fingerprint(recipe)}"
    return Checkpoints(expand_user(root) / name, recipe)


def _heading(settings: Learn, data: Part, teach: list[Prepared], report: list[Prepared]) -> str:
    matched = matched_content({"matching": settings.matching, "features": settings.features})
    system = f"{settings.scorer['method']} score, {matched}"
    ground_truth = truth_in_words(*(data_set.about["ground_truth"] for data_set in report or teach))
    if report:
        teach_names, report_names = (", ".join(data_set.part.name for data_set in sets) for sets in (teach, report))
        return f"{teach_names}: {system}; what was learned here is reported on {report_names}; {ground_truth}"
    queries = sum(len(half.report) for half in data.protocol.halves)
    return (
        f"{data.name}: {system}; each of {queries} queries is reported on by what was learned on the other half of the "
        f"path; {ground_truth}"
    )
