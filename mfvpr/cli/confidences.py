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


def confidence_of(
    file: ConfidenceFile, name: str, scorers: Collection[str], settings: Mapping[str, Any], candidates: int
) -> Confidence:
    """The confidence of a final score; warns if it was fitted without absent places, or with other settings."""
    if name not in file.systems:
        raise InputError(
            f"confidence={file.path}: expected the confidence of {name}, which decides, got "
            f"{', '.join(file.systems) or 'none'}; evaluate with the same scorer, final and fusion"
        )
    if not file.origin.get("absent_queries"):
        tell(f"warning: confidence={file.path} was fitted without absent places, so that it is too high for them; "
             "evaluate again on a path that is long enough to leave out the images of a query's place")  # fmt: skip
    if other := other_settings(file.origin, scorers, settings, candidates):
        words = ", ".join(other)
        tell(f"warning: confidence={file.path} was fitted with other settings of {words}: it may mean nothing here")
    return file.systems[name]


def check_confidence(file: ConfidenceFile, system: System, inputs: Inputs) -> ConfidenceFile:
    """Keep the final scores of a file whose settings fit this run at least as well as those of the one that decides.

    Warns if the file was fitted on the same images, or with other settings. The score that decides must be in the file.
    """
    headline, settings, scores = system.headline, system.settings or {}, system.final_scores
    candidates = num_candidates(system.pipeline.candidates, inputs.dataset.database)
    confidence = confidence_of(file, headline, scores[headline].scorers, settings, candidates)
    if _query_fingerprints(file.origin.get("data_fingerprint")) & _query_fingerprints(fingerprints(inputs.contents)):
        tell(f"warning: confidence={file.path} was fitted on these very images, so that it flatters")
    if not any(confidence.weights):
        tell(f"warning: confidence={file.path} has the same confidence for all predictions, correct or incorrect")
    threshold = inputs.thresholds and [middle(inputs.thresholds), inputs.ground_truth["unit"]]
    if threshold and threshold != file.origin.get("correct_within"):
        tell(f"warning: confidence={file.path} was fitted with other settings of recall: it may mean nothing here")
    other = {
        name: {*other_settings(file.origin, scores[name].scorers, settings, candidates)}
        for name in file.systems
        if name in scores
    }
    return file._replace(systems={name: file.systems[name] for name in other if other[name] <= other[headline]})


def other_settings(
    origin: Mapping[str, Any], scorers: Collection[str], settings: Mapping[str, Any], candidates: int
) -> list[str]:
    """The settings of a run or of a map that were others when the confidence of these scorers was fitted."""
    before = _settings_of(scorers, origin.get("settings"))
    now = _settings_of(scorers, {**settings, "scorer": assembly.describe_settings(settings["scorer"])})
    names = [name for name in _NAMES if name in now and name != "candidates" and before.get(name) != now[name]]
    return names + ["candidates"] * (origin.get("candidates") != candidates)


def _query_fingerprints(by_side: Mapping[str, str] | None) -> set[str]:
    """Fingerprints of the folders with queries; a database may be that of many runs."""
    return {folder for side, folder in (by_side or {}).items() if side != "database"}


def _settings_of(names: Collection[str], settings: Mapping[str, Any] | None) -> dict[str, Any]:
    """The settings that scores depend on; files of match weights are compared by content, not by name."""
    scorers = assembly.by_scorer((settings or {}).get("scorer", {}))
    parts = {name: values for name, values in scorers.items() if name in names}
    for name, values in parts.items():
        if "weight_content" in values:
            parts[name] = {**values, "weight": None}
    return {**(settings or {}), "scorer": parts}


def scoring_settings(settings: Mapping[str, Any]) -> dict[str, Any]:
    """The settings that confidences depend on, for the file of those that are fitted."""
    return {name: settings[name] for name in _NAMES} | {"scorer": assembly.describe_settings(settings["scorer"])}
