"""The confidence of a map: fitted on a drive whose places are known, and kept in the folder of the map."""

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from mfvpr.datasets.datasets import Dataset
from mfvpr.datasets.truth import middle
from mfvpr.evaluation.calibration import fit_confidence, read_confidences, write_confidences
from mfvpr.evaluation.evaluation import rank_dataset
from mfvpr.evaluation.system import System
from mfvpr.reranking.confidence import Confidence, confidence_inputs
from mfvpr.reranking.results import RETRIEVAL
from mfvpr.storage.feature_cache import FeatureCache
from mfvpr.utils.errors import InputError
from mfvpr.utils.fingerprints import fingerprint, recipe_of

_FILE = "confidence.json"
_LEAST_RANGE = 0.02  # of the confidence over a drive that tells correct from incorrect predictions
_AROUND = 5  # times the distance of a correct prediction: what is nearer shows the place, or is not known to be another


def fit_on_drive(dataset: Dataset, system: System, cache: FeatureCache | None) -> Confidence:
    """Evaluate a system on a data set, and fit the confidence of the ranking that decides.

    Each query counts twice: as it is, and without the images of its place, as an image of a place that the map does not
    show. Nothing that is predicted then is correct.
    """
    sequence = dataset.only
    if sequence.truth is None:
        raise InputError(f"{dataset.name}: expected a ground truth, which says what is correct, got none")
    threshold = middle(sequence.truth.thresholds())
    around = sequence.truth.positives(_AROUND * threshold)
    absent = replace(dataset, sequences=(replace(sequence, truth=None, excluded=around),))
    values, are_correct = [], []
    for each in (dataset, absent):
        inputs, rows = inputs_of(each, system, cache)
        values.append(inputs)
        are_correct.append(sequence.truth.positives(threshold).contains(rows)[:, 0] & (each is dataset))
    if not np.isfinite(values[1]).any():
        warnings.warn(f"{sequence.images.root}: without the images of a query's place there are no candidates, so that "
                      "places that the map does not show get too high a confidence; calibrate on a longer drive",
                      stacklevel=3)  # fmt: skip
    confidence = fit_confidence(np.concatenate(values), np.concatenate(are_correct))
    probabilities = confidence.probability(values[0])
    if np.ptp(probabilities[np.isfinite(probabilities)]) < _LEAST_RANGE:
        warnings.warn(f"{sequence.images.root}: scores do not tell correct predictions ({are_correct[0].sum()} of "
                      f"{len(sequence.images)}) from incorrect ones, so that every image gets the same confidence; "
                      "calibrate on a longer drive", stacklevel=3)  # fmt: skip
    return confidence


def inputs_of(
    dataset: Dataset, system: System, cache: FeatureCache | None
) -> tuple[Float[np.ndarray, "queries inputs"], Int[np.ndarray, "queries candidates"]]:
    """Inputs of the confidence of the ranking that decides, and its database rows."""
    result = rank_dataset(dataset, system, cache=cache)
    [ranked], [by_retrieval] = result.systems[system.headline], result.systems[RETRIEVAL]
    return confidence_inputs(ranked, by_retrieval), ranked.rows


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
