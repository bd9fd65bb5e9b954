"""The confidence of a map: fitted on a drive whose places are known, and kept in the file of the map."""

import json
import warnings
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Bool

from mfvpr.datasets.datasets import Dataset
from mfvpr.datasets.ground_truth import middle
from mfvpr.evaluation.confidence import (
    REFUSALS,
    CalibrationData,
    Confidence,
    absent_rankings,
    calibration_data,
    confidence_from_json,
)
from mfvpr.evaluation.dataset_ranking import rank_dataset
from mfvpr.evaluation.evidence import evidence_against
from mfvpr.evaluation.rankings import RETRIEVAL, Ranked
from mfvpr.evaluation.system import System
from mfvpr.storage.feature_cache import FeatureCache
from mfvpr.storage.maps import MapFile
from mfvpr.utils.errors import InputError
from mfvpr.utils.fingerprints import fingerprint, recipe_of

_USUAL = 10  # images with the shares of `REFUSALS`, that are added to those of a drive
_LEAST_RANGE = 0.02  # of the confidence over a drive that tells correct from incorrect predictions


def data_of_drive(
    dataset: Dataset, system: System, cache: FeatureCache | None
) -> tuple[CalibrationData, tuple[float, float]]:
    """Evaluate a system on a data set: what the confidence of the ranking that decides is fitted on.

    Also the shares of images without enough evidence, see `Confidence.refusals`.
    """
    truth, cache = dataset.only.truth, cache or FeatureCache()
    if truth is None:
        raise InputError(f"{dataset.name}: expected a ground truth, which says what is correct, got none")
    result, threshold = rank_dataset(dataset, system, cache=cache), middle(truth.thresholds())
    [ranked], [by_retrieval] = result.systems[system.headline], result.systems[RETRIEVAL]
    absent, _ = absent_rankings(ranked, by_retrieval, truth, threshold)

    def refused(rankings: Ranked) -> Bool[np.ndarray, " queries"]:
        [reasons] = evidence_against(replace(result, systems={system.headline: [rankings]}), cache)
        return np.array([reason is not None for reason in reasons])

    shown, has_absent = truth.positives(threshold).counts > 0, absent.rows[:, 0] >= 0
    of_queries = refused(ranked)
    parts = of_queries[shown], np.concatenate([of_queries[~shown], refused(absent)[has_absent]])
    shares = [
        (np.sum(part) + _USUAL * usual) / (len(part) + _USUAL) for part, usual in zip(parts, REFUSALS, strict=True)
    ]
    return calibration_data(ranked, by_retrieval, truth, threshold), (float(shares[0]), float(shares[1]))


def fit_on_drive(dataset: Dataset, system: System, cache: FeatureCache | None) -> tuple[Confidence, CalibrationData]:
    """Fit the confidence of the ranking that decides on a data set; also what it was fitted on.

    Each query counts twice: as it is, and without the images of its place, see `calibration_data`.
    """
    data, refusals = data_of_drive(dataset, system, cache)
    root, fix = dataset.queries.root, "calibrate on a longer drive"
    if not data.num_absent:
        reason = "without the images of a query's place there are no candidates, so that places that the map does not"
        warnings.warn(f"{root}: {reason} show get too high a confidence; {fix}", stacklevel=3)
    confidence = replace(data.fit(), refusals=refusals)
    probabilities = confidence.probability(data.present)
    if np.ptp(probabilities[np.isfinite(probabilities)]) < _LEAST_RANGE:
        correct = f"correct predictions ({data.correct.sum()} of {len(data.correct)})"
        reason = f"scores do not tell {correct} from incorrect ones, so that every image gets the same confidence"
        warnings.warn(f"{root}: {reason}; {fix}", stacklevel=3)
    return confidence, data


def write_confidence(
    file: MapFile, parts: Mapping[str, bytes], system: System, confidence: Confidence, data: CalibrationData
) -> None:
    """Keep the confidence of the ranking that decides in a map, whose other `parts` are written first."""
    of_system = _fingerprint(system)
    if of_system is None:
        warnings.warn("a part of the system names no `recipe`: the confidence is not kept on disk", stacklevel=3)
        return
    content = {"system": of_system, "queries": len(data.correct), "absent_queries": data.num_absent}
    content["confidence"] = vars(confidence)
    file.write({**parts, "confidence": json.dumps(content).encode()})


def read_confidence(file: MapFile, system: System) -> Confidence | None:
    """The confidence of a map, None if it was never calibrated; an InputError if it is of another system."""
    if (part := file.part("confidence")) is None:
        return None
    content = json.loads(part)
    if content["system"] != _fingerprint(system):
        got = "that of another system or version; calibrate again"
        raise InputError(f"{file.folder}: expected the confidence of this map's system, got {got}")
    return confidence_from_json(content["confidence"])


def _fingerprint(system: System) -> str | None:
    """A hash of everything that scores depend on; None if a part has no recipe."""
    pipeline = system.pipeline
    parts = (pipeline.extractor, pipeline.retriever, pipeline.matcher, pipeline.candidates, dict(system.scorers))
    try:
        return fingerprint(recipe_of([*parts, dict(system.fused), system.ties, system.headline]))
    except TypeError:
        return None
