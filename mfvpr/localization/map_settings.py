"""Parts of a map's file beside its images: settings, and the confidence that is fitted on a drive."""

import json
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool

from mfvpr.datasets.datasets import Dataset, ImageFolder
from mfvpr.datasets.ground_truth import middle
from mfvpr.evaluation.confidence import (
    REFUSALS,
    CalibrationData,
    Confidence,
    absent_ranking,
    calibration_data,
    confidence_from_json,
)
from mfvpr.evaluation.dataset_ranking import rank_dataset
from mfvpr.evaluation.evidence import evidence_against
from mfvpr.evaluation.rankings import Ranked
from mfvpr.evaluation.system import Note, System
from mfvpr.storage.feature_cache import FeatureCache
from mfvpr.storage.maps import MapFile
from mfvpr.systems import assembly
from mfvpr.systems.assembly import SystemSettings
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import from_values
from mfvpr.utils.fingerprints import fingerprint, recipe_of

_ABOUT = 1.5  # relative difference of numbers of pixels: sides are rounded
_KEPT = ("features", "retrieval", "matching", "scorer", "candidates", "fusion", "final", "ties")
_USUAL = 10  # images with the shares of `REFUSALS`, that are added to those of a drive
_LEAST_RANGE = 0.02  # of the confidence over a drive that tells correct from incorrect predictions


def kept_settings(settings: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of a system that a map keeps."""
    return json.loads(json.dumps({name: settings[name] for name in _KEPT}))  # tuples become lists


def read_settings(folder: Path) -> dict[str, Any]:
    """The settings of the map in a folder; an InputError without one, or for a system that no settings describe."""
    content = MapFile(Path(folder)).part("system")
    if content is None:
        fix = "Make one with `mfvpr map build` or `Map.create`"
        open_map = "open a map of a system of your own with `Map(folder, system)`"
        raise InputError(f"{folder}: expected a folder with a map, got none. {fix}, or {open_map}.")
    settings = json.loads(content)
    try:
        from_values(SystemSettings, settings)
    except InputError as error:
        raise InputError(f"{folder}: {error}") from None
    return settings


def read_system(folder: Path) -> System:
    """The system that a map was made with; raises as `read_settings`, or if weights are missing."""
    settings = read_settings(folder)
    try:
        return assembly.system(from_values(SystemSettings, settings))
    except InputError as error:
        raise InputError(f"{folder}: {error}") from None


def check_settings(file: MapFile, system: System) -> None:
    """Raise `InputError` if a map has other settings."""
    content = None if system.settings is None else file.part("system")
    if system.settings is not None and content is not None:
        before, now = json.loads(content), kept_settings(system.settings)
        if differing := " and ".join(name for name in now if before.get(name) != now[name]):
            fix = "Name another folder, or use what it was made with (`mfvpr map info`)"
            raise InputError(f"{file.folder}: this map was made with other {differing}. {fix}.")


def fit_to_map(folder: Path, system: System, images: ImageFolder | None, note: Note) -> System:
    """The system at the image size of the map in a folder; in a new one, at that of the images, see `System`.

    Raises `InputError` if a new map has no images to take the shape from, or as `read_settings`.
    """
    if system.pipeline.pixels is None:
        return system
    if system.settings is not None and MapFile(Path(folder)).part("system") is not None:
        width, height = read_settings(folder)["features"]["image_size"]
        if not 1 / _ABOUT < width * height / system.pipeline.pixels < _ABOUT:
            got = f"{system.pipeline.pixels} pixels. Use features.image_size=[{width},{height}]"
            raise InputError(f"{folder}: this map was made with images of {width} x {height} px, got {got}.")
        return system.with_image_size((width, height))
    if images is None:
        fix = "Use `Map.create`, or a system with features.image_size=[WIDTH,HEIGHT]"
        raise InputError(f"image_size: expected the images of a new map, whose shape decides, got none. {fix}.")
    return system.fit_image_size([images], note)


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
    [ranked] = result.systems[system.headline]
    absent = absent_ranking(ranked, truth, threshold)

    def refused(rankings: Ranked) -> Bool[np.ndarray, " queries"]:
        [reasons] = evidence_against(replace(result, systems={system.headline: [rankings]}), cache)
        return np.array([reason is not None for reason in reasons])

    shown, has_absent = truth.positives(threshold).counts > 0, absent.rows[:, 0] >= 0
    of_queries = refused(ranked)
    parts = of_queries[shown], np.concatenate([of_queries[~shown], refused(absent)[has_absent]])
    shares = [
        (np.sum(part) + _USUAL * usual) / (len(part) + _USUAL) for part, usual in zip(parts, REFUSALS, strict=True)
    ]
    return calibration_data(ranked, truth, threshold), (float(shares[0]), float(shares[1]))


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
    try:
        if content["system"] == _fingerprint(system):
            return confidence_from_json(content["confidence"])
    except (LookupError, TypeError):  # of another version
        pass
    got = "that of another system or version; calibrate again"
    raise InputError(f"{file.folder}: expected the confidence of this map's system, got {got}")


def _fingerprint(system: System) -> str | None:
    """A hash of everything that scores depend on; None if a part has no recipe."""
    pipeline = system.pipeline
    parts = (pipeline.extractor, pipeline.retriever, pipeline.matcher, pipeline.candidates, dict(system.scorers))
    try:
        return fingerprint(recipe_of([*parts, dict(system.fused), system.ties, system.headline]))
    except TypeError:
        return None
