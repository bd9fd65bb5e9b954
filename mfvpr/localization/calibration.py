"""The confidence of a map: fitted on a drive whose places are known, and kept in the folder of the map."""

import warnings
from pathlib import Path

from mfvpr.datasets.datasets import Dataset
from mfvpr.datasets.truth import middle
from mfvpr.evaluation.calibration import (
    Confidence,
    confidence_inputs,
    fit_confidence,
    read_confidences,
    write_confidences,
)
from mfvpr.evaluation.evaluation import rank_dataset
from mfvpr.evaluation.system import System
from mfvpr.reranking.results import RETRIEVAL
from mfvpr.storage.feature_cache import FeatureCache
from mfvpr.utils.errors import InputError
from mfvpr.utils.fingerprints import fingerprint, recipe_of

_FILE = "confidence.json"


def fit_on_drive(dataset: Dataset, system: System, cache: FeatureCache | None) -> Confidence:
    """Evaluate a system on a data set, and fit the confidence of the ranking that decides."""
    sequence = dataset.only
    if sequence.truth is None:
        raise InputError(f"{dataset.name}: expected a ground truth, which says what is correct, got none")
    result = rank_dataset(dataset, system, cache=cache)
    threshold = middle(sequence.truth.thresholds())
    [ranked], [by_retrieval] = result.systems[system.headline], result.systems[RETRIEVAL]
    [positives] = result.positives(threshold)
    is_correct = positives.contains(ranked.rows)[:, 0]
    confidence = fit_confidence(confidence_inputs(ranked, by_retrieval), is_correct)
    if not any(confidence.weights):
        warnings.warn(f"{sequence.images.root}: scores do not tell correct predictions ({is_correct.sum()} of "
                      f"{len(is_correct)}) from incorrect ones, so that every image gets the same confidence, also one "
                      "of another place; calibrate on a longer drive, which leaves the map", stacklevel=3)  # fmt: skip
    return confidence


def write_confidence(folder: Path, system: System, confidence: Confidence) -> None:
    """Keep the confidence of the ranking that decides in the folder of a map."""
    write_confidences(folder / _FILE, {system.headline: confidence}, {"system": _fingerprint(system)})


def read_confidence(folder: Path, system: System) -> Confidence | None:
    """The confidence of a map, None if it was never calibrated; an InputError if it is of another system."""
    if not (folder / _FILE).exists():
        return None
    confidences, origin = read_confidences(folder / _FILE)
    if system.headline not in confidences or origin.get("system") != _fingerprint(system):
        raise InputError(f"{folder / _FILE}: expected the confidence of this map's system, got that of another one; "
                         "remove the file, then calibrate again")  # fmt: skip
    return confidences[system.headline]


def _fingerprint(system: System) -> str | None:
    """A hash of everything that scores depend on; None if a part has no recipe."""
    pipeline = system.pipeline
    parts = (pipeline.extractor, pipeline.retriever, pipeline.matcher, pipeline.candidates, dict(system.scorers))
    try:
        return fingerprint(recipe_of([*parts, dict(system.fused), system.ties, system.headline]))
    except TypeError:
        return None
