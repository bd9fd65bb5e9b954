"""The confidence file of an earlier run: read it, and check that it fits this one."""

from collections.abc import Collection, Mapping
from typing import Any, NamedTuple

from mfvpr.cli.console import tell
from mfvpr.cli.inputs import Inputs
from mfvpr.datasets.contents import fingerprints
from mfvpr.datasets.ground_truth import middle
from mfvpr.evaluation import Confidence, System, read_confidences
from mfvpr.evaluation.sequence_matching import num_candidates
from mfvpr.systems import assembly
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import expand_user

# Confidences depend on these settings.
_NAMES = ("features", "retrieval", "scorer", "matching", "candidates", "fusion", "previous_queries")


class ConfidenceFile(NamedTuple):
    """The confidence of each system, and the run that it was fitted on."""

    path: str
    systems: Mapping[str, Confidence]
    origin: Mapping[str, Any]


def read_file(path: str) -> ConfidenceFile:
    """Read a file of confidences."""
    return ConfidenceFile(path, *read_confidences(expand_user(path)))


def warn_of_absent_places(file: ConfidenceFile) -> None:
    """Warn if the file was fitted on places only that the database shows."""
    if not file.origin.get("absent_queries"):
        tell(f"warning: confidence={file.path} was fitted without absent places, so that it is too high for them; "
             "evaluate again on a path that is long enough to leave out the images of a query's place")  # fmt: skip


def check_confidence(file: ConfidenceFile, system: System, inputs: Inputs) -> ConfidenceFile:
    """Keep the final scores of a file whose settings fit this run at least as well as those of the one that decides.

    Warns if the file was fitted on the same images, or with other settings. The score that decides must be in the file.
    """
    headline, settings = system.headline, system.settings or {}
    if not file.systems:
        raise InputError(f"confidence={file.path}: expected confidences of systems, got none: its run could fit "
                            "none, as where there is but one candidate")  # fmt: skip
    if headline not in file.systems:
        raise InputError(f"confidence={file.path}: expected one of the system that decides, {headline}, got "
                            f"{', '.join(file.systems)}; make it with the same scorer, final and fusion")  # fmt: skip
    before, now = map(_query_fingerprints, (file.origin.get("data_fingerprint"), fingerprints(inputs.contents)))
    if before & now:
        tell(f"warning: confidence={file.path} was fitted on these very images, so that it flatters")
    warn_of_absent_places(file)
    if not any(file.systems[headline].weights):
        tell(f"warning: confidence={file.path} has the same confidence for all predictions, correct or incorrect")
    threshold = inputs.thresholds and [middle(inputs.thresholds), inputs.ground_truth["unit"]]
    recall = ["recall"] if threshold and threshold != file.origin.get("correct_within") else []
    candidates = num_candidates(system.pipeline.candidates, inputs.dataset.database)
    scores = system.final_scores
    other = {name: other_settings(file.origin, scores[name].scorers, settings, candidates) + recall
             for name in file.systems if name in scores}  # fmt: skip
    if other[headline]:
        tell(f"warning: confidence={file.path} was fitted with other settings of {', '.join(other[headline])}: "
             "it may mean nothing here")  # fmt: skip
    usable = {name: file.systems[name] for name in other if {*other[name]} <= {*other[headline]}}
    if unusable := [name for name in other if name not in usable]:
        tell(f"confidence={file.path}: nothing is said of {', '.join(unusable)}, which had other settings there")
    return file._replace(systems=usable)


def other_settings(
    origin: Mapping[str, Any], scorers: Collection[str], settings: Mapping[str, Any], candidates: int
) -> list[str]:
    """The settings of a run or of a map that were others when the confidence of these scorers was fitted."""
    before = _settings_of(scorers, origin.get("settings"))
    now = _settings_of(scorers, {**settings, "scorer": assembly.describe_settings(settings["scorer"])})
    names = [name for name in _NAMES if name in now and name != "candidates" and before.get(name) != now[name]]
    return names + ["candidates"] * (origin.get("candidates") != candidates)


def _query_fingerprints(by_side: Any) -> set[str]:
    """Fingerprints of the folders with queries; a database may be that of many runs."""
    sides = by_side.items() if isinstance(by_side, Mapping) else ()
    return {folder for side, folder in sides if side != "database" and isinstance(folder, str)}


def _settings_of(names: Collection[str], settings: Any) -> dict[str, Any]:
    """The settings that scores depend on; files of match weights are compared by content, not by name."""
    scorers = settings.get("scorer") if isinstance(settings, Mapping) else None
    if not isinstance(scorers, Mapping) or not isinstance(scorers.get("method", ""), str):
        return {}
    parts = {name: values for name, values in assembly.by_scorer(scorers).items() if name in names}
    for name, values in parts.items():
        if isinstance(values, Mapping) and "weight_content" in values:
            parts[name] = {**values, "weight": None}
    return {**settings, "scorer": parts}


def scoring_settings(settings: Mapping[str, Any]) -> dict[str, Any]:
    """The settings that confidences depend on, for the file of those that are fitted."""
    return {name: settings[name] for name in _NAMES} | {"scorer": assembly.describe_settings(settings["scorer"])}
