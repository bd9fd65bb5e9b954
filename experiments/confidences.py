"""The confidence of answers: the file that says it, and how the one that a run leaves was made."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from experiments import build, truth
from experiments.console import tell
from experiments.settings import SettingsError
from experiments.stages import Images, num_candidates
from mfvpr.datasets.truth import middle
from mfvpr.evaluation import Confidence, read_confidences
from mfvpr.report.evaluations import Judged
from mfvpr.utils.versions import versions

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


def check(given: Given | None, headline: str, settings: Mapping[str, Any], images: Images) -> Given | None:
    """What of a file says something of this run; a file that does not know the system that decides is refused.

    A line says that one of these very images flatters, what was otherwise where it was fitted, and which other systems
    are left out because of that.
    """
    if given is None:
        return None
    if not given.systems:
        raise SettingsError(f"confidence={given.path}: expected p of systems, got none: the run that left it could fit "
                            "none, as where there is but one candidate")  # fmt: skip
    if headline not in given.systems:
        raise SettingsError(f"confidence={given.path}: expected one of the system that decides, {headline}, got "
                            f"{', '.join(given.systems)}; make it with the same scorer, final and fusion")  # fmt: skip
    before, now = map(_of_queries, (given.made.get("data_fingerprint"), images.fingerprints))
    if before & now:
        tell(f"warning: confidence={given.path} was fitted on these very images, so that it flatters")
    if not any(given.systems[headline].weights):
        tell(f"warning: confidence={given.path} cannot tell right answers from wrong ones: p is the same for all")
    other = {name: _otherwise(given, name, settings, images) for name in given.systems}
    if other[headline]:
        tell(f"warning: confidence={given.path} was fitted with other settings of {', '.join(other[headline])}: p may "
             "mean nothing here")  # fmt: skip
    known = {name: one for name, one in given.systems.items() if {*other[name]} <= {*other[headline]}}
    if left := [name for name in given.systems if name not in known]:
        tell(f"confidence={given.path}: nothing is said of {', '.join(left)}, which had other settings there")
    return given._replace(systems=known)


def _otherwise(given: Given, system: str, settings: Mapping[str, Any], images: Images) -> list[str]:
    """The settings that what was fitted depends on, and that were others."""
    current = {**settings, "scorer": build.described(settings["scorer"])}
    before, now = (_of_system(one, system) for one in (given.made.get("settings"), current))
    names = [name for name in _NAMES if name != "candidates" and before.get(name) != now[name]]
    counted = given.made.get("candidates") == num_candidates(settings, images)
    within = right_within(settings, images)
    return [
        *names,
        *([] if counted else ["candidates (as many as there were)"]),
        *([] if within in (None, given.made.get("right_within")) else ["recall (what counts as right)"]),
    ]


def other_settings(made: Mapping[str, Any], system: str, own: Mapping[str, Any]) -> list[str]:
    """The settings of a map that its answers depend on, and that were others where a confidence was fitted."""
    before = _of_system(made.get("settings"), system)
    now = _of_system({**own, "scorer": build.described(own["scorer"])}, system)
    groups = [name for name in _NAMES if name in now and name != "candidates" and before.get(name) != now[name]]
    return groups + (["candidates"] if made.get("candidates") != own["candidates"] else [])


def right_within(settings: Mapping[str, Any], images: Images) -> list[Any] | None:
    """What counts as right, and its unit; None without ground truth."""
    right = images.dataset.sequences[0].truth
    if right is None:
        return None
    return [middle(truth.thresholds(settings, right)), right.unit]


def _of_queries(fingerprints: Any) -> set[str]:
    """Of the folders with queries, whatever their names; many may share a database."""
    sides = fingerprints.items() if isinstance(fingerprints, Mapping) else ()
    return {folder for side, folder in sides if side != "database" and isinstance(folder, str)}


def _of_system(settings: Any, system: str) -> dict[str, Any]:
    """The settings that its scores depend on, of several scorers those that take part; files by what they hold."""
    scorers = settings.get("scorer") if isinstance(settings, Mapping) else None
    if not isinstance(scorers, Mapping) or not isinstance(scorers.get("method", ""), str):
        return {}
    members = system.split(" + ")
    parts = {name: own for name, own in build.by_scorer(scorers).items() if name in members}
    files = {name for name, own in parts.items() if isinstance(own, Mapping) and "weight_content" in own}
    return {**settings, "scorer": {name: {**own, "weight": None} if name in files else own
                                   for name, own in parts.items()}}  # fmt: skip


def made(settings: Mapping[str, Any], images: Images, judged: Judged) -> dict[str, Any]:
    """How the confidence of a run was made."""
    return {
        "dataset": images.dataset.name,
        "data_fingerprint": images.fingerprints,
        "queries": sum(len(sequence.images) for sequence in judged.sequences),
        "right_within": right_within(settings, images),
        "candidates": num_candidates(settings, images),
        "ground_truth": truth.description(settings, images.dataset),
        "settings": {name: settings[name] for name in _NAMES} | {"scorer": build.described(settings["scorer"])},
        "command": settings.get("command"),
        "versions": versions(),
    }
