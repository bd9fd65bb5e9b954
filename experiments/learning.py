"""The stages of learning: what is learned on one half of the path, beside what is set by hand, on the other half."""

from pathlib import Path
from typing import Any

from experiments import build, console, prepare, run_folder, truth
from experiments.axes import learnable, own_c
from mfvpr.data.files import write_text
from mfvpr.evaluation import Judge
from mfvpr.evaluations import Stopwatch
from mfvpr.fingerprints import fingerprint
from mfvpr.learning.comparison import Checkpoints, Options, compare
from mfvpr.learning.losses import LOSSES
from mfvpr.report import comparisons, runs


def learn(settings: dict[str, Any]) -> None:
    """Matches -> learned, searched and hand-set scores on the half that none of them saw -> table, figures, files."""
    with run_folder.claimed(settings) as folder:
        varied, how = learnable(settings), _options(settings)
        watch = Stopwatch()
        tools, images = prepare.begun(settings, watch)
        judge = truth.judge(settings, images.dataset)
        matches, candidates = prepare.matched(settings, tools, images, watch)
        checkpoints = _checkpoints(settings, prepare.recipe(tools, images, candidates.mask.shape[1]), judge)
        with watch("learning"):
            options = {"checkpoints": checkpoints, "track": console.track}
            comparison = compare(varied, judge, matches, candidates, how, **options)
        heading, described = _heading(settings, images, judge), truth.described(settings, images.dataset)
        text = f"{heading}\n\n{comparisons.text(comparison)}"
        left_out = ("dataset", "store", "out", "checkpoints", "multirun", "command")
        results = {
            "dataset": images.dataset.name, "ground_truth": described,
            "data_fingerprint": images.fingerprints, "reading": images.reading, **comparisons.results(comparison),
            "settings": {name: value for name, value in settings.items() if name not in left_out},
            "seconds": watch.seconds, "versions": runs.versions(),
        }  # fmt: skip

        def write(new: Path) -> None:
            runs.write_table(new, comparisons.table(comparison), heading)
            runs.write_json(new / "results.json", results)
            comparisons.write_weights(new / "weights", comparison)
            write_text(new / "summary.txt", f"{text}\n")

        figures = comparisons.figures(comparison)
        run_folder.leave(folder, settings, described, text=text, write=write, figures=figures)


def _options(settings: dict[str, Any]) -> Options:
    names = ("ties", "steps", "every", "patience", "batch", "learning_rate", "hidden", "seed")
    return Options(
        c=own_c(settings), filter_score=settings["fusion"]["filter_score"], loss=LOSSES[settings["loss"]],
        **{name: settings[name] for name in names},
    )  # fmt: skip


def _checkpoints(settings: dict[str, Any], matches: dict[str, Any], judge: Judge) -> Checkpoints | None:
    """Where the trainings are kept, and what identifies them."""
    root = settings["checkpoints"] or settings["store"]
    if root is None:
        return None
    names = ("scorer", "loss", "every", "patience", "batch", "learning_rate", "hidden", "seed")
    recipe = {
        "matches": matches,
        "tolerances": settings["recall"], **{name: settings[name] for name in names},
        "filter_score": settings["fusion"]["filter_score"], "positives": judge.fingerprint,
        "versions": {name: runs.versions()[name] for name in ("mfvpr", "jax", "numpy")},
    }  # fmt: skip
    own = "" if settings["checkpoints"] else f"{settings['dataset']['name']}_learning-{fingerprint(recipe)}"
    return Checkpoints(build.expanded(root) / own, recipe)


def _heading(settings: dict[str, Any], images: prepare.Images, judge: Judge) -> str:
    reported = sum(len(half.report) for half in judge.halves)
    return (
        f"{images.dataset.name}: {settings['scorer']['method']} score, {settings['features']['name']} features; each "
        f"of {reported} queries is reported on by what was learned on the other half of the path; "
        f"{truth.in_words(settings, images.dataset)}"
    )
