"""The confidence file of a run: read and check an earlier one, and describe the origin of a new one."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from mfvpr.cli import truth
from mfvpr.cli.console import tell
from mfvpr.cli.stages import Images
from mfvpr.datasets.truth import middle
from mfvpr.evaluation import Confidence, read_confidences
from mfvpr.evaluation.sequence_matching import num_candidates
from mfvpr.report.evaluations import EvaluationReport
from mfvpr.systems import assembly
from mfvpr.systems.settings import SettingsError
from mfvpr.utils.files import expand_user
from mfvpr.utils.versions import versions

# Confidences depend on these settings.
_NAMES = ("features", "retrieval", "scorer", "matching", "candidates", "fusion", "previous_queries", "cohort")


class ConfidenceFile(NamedTuple):
    """The confidence of each system, and the run that it was fitted on."""

    path: str
    systems: Mapping[str, Confidence]
    origin: Mapping[str, Any]


def read_file(settings: Mapping[str, Any]) -> ConfidenceFile | None:
    """Read the file that the settings name; None if there is none."""
    path = settings["confidence"]
    return None if path is None else ConfidenceFile(path, *read_confidences(expand_user(path)))


def check_confidence(
    file: ConfidenceFile | None, headline: str, settings: Mapping[str, Any], images: Images
) -> ConfidenceFile | None:
    """Keep the systems of a file whose settings fit this run at least as well as those of the headline system.

    Warns if the file was fitted on the same images, or with other settings. The headline system must be in the file.
    """
    if file is None:
        return None
    if not file.systems:
        raise SettingsError(f"confidence={file.path}: expected confidences of systems, got none: its run could fit "
                            "none, as where there is but one candidate")  # fmt: skip
    if headline not in file.systems:
        raise SettingsError(f"confidence={file.path}: expected one of the system that decides, {headline}, got "
                            f"{', '.join(file.systems)}; make it with the same scorer, final and fusion")  # fmt: skip
    before, now = map(_query_fingerprints, (file.origin.get("data_fingerprint"), images.fingerprints))
    if before & now:
        tell(f"warning: confidence={file.path} was fitted on these very images, so that it flatters")
    if not any(file.systems[headline].weights):
        tell(f"warning: confidence={file.path} has the same confidence for all predictions, correct or incorrect")
    recall = [] if _threshold(settings, images) in (None, file.origin.get("correct_within")) else ["recall"]
    candidates = num_candidates(settings["candidates"], images.dataset.database)
    other = {name: other_settings(file.origin, name, settings, candidates) + recall for name in file.systems}
    if other[headline]:
        tell(f"warning: confidence={file.path} was fitted with other settings of {', '.join(other[headline])}: "
             "it may mean nothing here")  # fmt: skip
    usable = {name: system for name, system in file.systems.items() if {*other[name]} <= {*other[headline]}}
    if unusable := [name for name in file.systems if name not in usable]:
        tell(f"confidence={file.path}: nothing is said of {', '.join(unusable)}, which had other settings there")
    return file._replace(systems=usable)


def other_settings(origin: Mapping[str, Any], system: str, settings: Mapping[str, Any], candidates: int) -> list[str]:
    """The settings of a run or of a map that were others when a confidence was fitted."""
    before = _system_settings(origin.get("settings"), system)
    now = _system_settings({**settings, "scorer": assembly.describe_settings(settings["scorer"])}, system)
    names = [name for name in _NAMES if name in now and name != "candidates" and before.get(name) != now[name]]
    return names + ["candidates"] * (origin.get("candidates") != candidates)


def _threshold(settings: Mapping[str, Any], images: Images) -> list[Any] | None:
    """The middle threshold of a correct prediction, and its unit; None without ground truth."""
    ground_truth = images.dataset.sequences[0].truth
    if ground_truth is None:
        return None
    return [middle(truth.thresholds(settings, ground_truth)), ground_truth.unit]


def _query_fingerprints(fingerprints: Any) -> set[str]:
    """Fingerprints of the folders with queries; a database may be that of many runs."""
    sides = fingerprints.items() if isinstance(fingerprints, Mapping) else ()
    return {folder for side, folder in sides if side != "database" and isinstance(folder, str)}


def _system_settings(settings: Any, system: str) -> dict[str, Any]:
    """The settings that a system's scores depend on; files of match weights are compared by content, not by name."""
    scorers = settings.get("scorer") if isinstance(settings, Mapping) else None
    if not isinstance(scorers, Mapping) or not isinstance(scorers.get("method", ""), str):
        return {}
    members = system.split(" + ")
    parts = {name: values for name, values in assembly.by_scorer(scorers).items() if name in members}
    for name, values in parts.items():
        if isinstance(values, Mapping) and "weight_content" in values:
            parts[name] = {**values, "weight": None}
    return {**settings, "scorer": parts}


def provenance(settings: Mapping[str, Any], images: Images, evaluation: EvaluationReport) -> dict[str, Any]:
    """The data and settings that the confidence of a run was fitted with, for its file."""
    return {
        "dataset": images.dataset.name,
        "data_fingerprint": images.fingerprints,
        "queries": sum(len(sequence.images) for sequence in evaluation.sequences),
        "correct_within": _threshold(settings, images),
        "candidates": num_candidates(settings["candidates"], images.dataset.database),
        "ground_truth": truth.describe(settings, images.dataset),
        "settings": {name: settings[name] for name in _NAMES}
        | {"scorer": assembly.describe_settings(settings["scorer"])},
        "command": settings.get("command"),
        "versions": versions(),
    }
