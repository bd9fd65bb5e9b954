"""The confidence of answers: the file that says it, and how the one that a run leaves was made."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from experiments import build, truth
from experiments.console import tell
from experiments.prepare import Images
from experiments.settings import SettingsError
from mfvpr.confidence import Confidence, read_confidences
from mfvpr.report import runs
from mfvpr.report.evaluations import Judged

_NAMES = ("features", "retrieval", "scorer", "matching", "candidates", "fusion", "previous_queries", "cohort")


class Given(NamedTuple):
    """What the settings name: the confidence of each system, and how they were made."""

    path: str
    systems: Mapping[str, Confidence]
    made: Mapping[str, Any]


def read(settings: Mapping[str, Any]) -> Given | None:
    """The file that the settings name, before anything slow; None = none."""
    path = settings["confidence"]
    return None if path is None else Given(path, *read_confidences(build.expanded(path)))


def check(given: Given | None, headline: str, settings: Mapping[str, Any], images: Images) -> None:
    """Refuse a file that does not know the system that decides; say that one of these very images flatters, and what
    the system had otherwise where it was fitted."""
    if given is None:
        return
    if headline not in given.systems:
        raise SettingsError(f"confidence={given.path}: expected one of the system that decides, {headline}, got "
                            f"{', '.join(given.systems)}; make it with the same scorer, final and fusion")  # fmt: skip
    if given.made.get("data_fingerprint") == images.fingerprints:
        tell(f"warning: confidence={given.path} was fitted on these very images, so that it flatters")
    before, now = (_of_system(one, headline) for one in (given.made.get("settings"), settings))
    if other := [name for name in _NAMES if before.get(name) != now[name]]:
        tell(f"warning: confidence={given.path} was fitted with other settings of {', '.join(other)}: p may mean "
             "nothing here")  # fmt: skip


def _of_system(settings: Any, system: str) -> dict[str, Any]:
    """The settings that its scores depend on, of several scorers those that take part."""
    if not isinstance(settings, Mapping) or not isinstance(settings.get("scorer"), Mapping):
        return {}
    scorers, members = build.by_scorer(settings["scorer"]), system.split(" + ")
    return {**settings, "scorer": {name: own for name, own in scorers.items() if name in members}}


def made(settings: Mapping[str, Any], images: Images, judged: Judged) -> dict[str, Any]:
    """How the confidence of a run was made."""
    return {
        "dataset": images.dataset.name,
        "data_fingerprint": images.fingerprints,
        "queries": sum(len(sequence.images) for sequence in judged.sequences),
        "right_within": judged.threshold if judged.thresholds else None,
        "ground_truth": truth.described(settings, images.dataset),
        "settings": {name: settings[name] for name in _NAMES},
        "command": settings.get("command"),
        "versions": runs.versions(),
    }
