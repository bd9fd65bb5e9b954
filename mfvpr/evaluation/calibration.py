"""Data that a confidence is fitted on: rankings with known places, and the same queries as images of absent places."""

import warnings
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mfvpr.datasets.datasets import Dataset
from mfvpr.datasets.ground_truth import Truth, middle
from mfvpr.evaluation.confidence import REFUSALS, Confidence, confidence_inputs, fit_confidence
from mfvpr.evaluation.dataset_ranking import rank_dataset
from mfvpr.evaluation.evidence import evidence_against
from mfvpr.evaluation.rankings import Ranked
from mfvpr.evaluation.system import System
from mfvpr.retrieval.retriever import with_standardization
from mfvpr.retrieval.standardization import Rule
from mfvpr.storage.feature_cache import FeatureCache
from mfvpr.utils.errors import InputError

AROUND = 5  # times the distance of a correct prediction: nearer images show the place, or are not known to be elsewhere
_USUAL = 10  # images with the shares of `REFUSALS`, that are added to those of a drive
_LEAST_RANGE = 0.02  # of the confidence over a drive that tells correct from incorrect predictions


class CalibrationData(NamedTuple):
    """Inputs of a confidence of Q queries, for places that the database shows and for absent places."""

    present: Float[np.ndarray, "queries inputs"]  # of the queries as they are, see `confidence_inputs`
    absent: Float[np.ndarray, "queries inputs"]  # without the images of their place; NaN if no candidate is left
    correct: Bool[np.ndarray, " queries"]  # top predictions of the queries as they are

    @property
    def num_absent(self) -> int:
        """Number of queries that count once more, as images of an absent place."""
        return int(np.isfinite(self.absent).all(axis=1).sum())

    def take(self, queries: Int[np.ndarray, " _"]) -> "CalibrationData":
        """The data of some queries."""
        return CalibrationData(*(values[queries] for values in self))

    def fit(self) -> Confidence:
        """Fit a confidence on present and absent places; an `InputError` if no query has usable inputs."""
        correct = np.append(self.correct, np.zeros(len(self.absent), bool))
        return fit_confidence(np.concatenate([self.present, self.absent]), correct)


def calibration_data(ranked: Ranked, truth: Truth, threshold: float) -> CalibrationData:
    """Count each query as it is, and once more as an image of an absent place, see `absent_ranking`.

    confidence = calibration_data(ranked, truth, 2).fit()  # correct within 2 frames
    """
    absent = confidence_inputs(absent_ranking(ranked, truth, threshold))
    correct = truth.positives(threshold).contains(ranked.rows)[:, 0]
    return CalibrationData(confidence_inputs(ranked), absent, correct)


def absent_ranking(ranked: Ranked, truth: Truth, threshold: float) -> Ranked:
    """The ranking without the images of each query's place, as if the database did not show it.

    Images within five times the threshold are left out, and the other candidates keep their scores. A query without
    images to leave out has no candidates: it shows an absent place as it is.
    """
    place = truth.shows_place(AROUND * max(threshold, 1))
    return ranked.without(place.contains(ranked.rows) | (place.counts == 0)[:, None])


def fit_on_drive(
    dataset: Dataset, system: System, cache: FeatureCache | None, rule: Rule | None = None
) -> tuple[Confidence, CalibrationData]:
    """Fit the confidence of the ranking that decides on a data set; also what it was fitted on.

    Each query counts twice: as it is, and without the images of its place, see `calibration_data`. The
    `rule`, if there is one, replaces those of the retrieval's standardization but `none` and `database`.
    """
    truth, root, cache = dataset.only.truth, dataset.queries.root, cache or FeatureCache()
    if truth is None:
        raise InputError(f"{dataset.name}: expected a ground truth, which says what is correct, got none")
    if rule is not None:
        change: Any = lambda each: each if each in ("none", "database") else rule  # noqa: E731
        pipeline = replace(system.pipeline, retriever=with_standardization(system.pipeline.retriever, change))
        system = replace(system, pipeline=pipeline)
    result, threshold = rank_dataset(dataset, system, cache=cache), middle(truth.thresholds())
    [ranked] = result.systems[system.headline]
    absent = absent_ranking(ranked, truth, threshold)
    refused = []  # of the queries as they are, and without the images of their place
    for rankings in (ranked, absent):
        [reasons] = evidence_against(replace(result, systems={system.headline: [rankings]}), cache)
        refused.append(np.array([reason is not None for reason in reasons]))
    shown, has_absent = truth.positives(threshold).counts > 0, absent.rows[:, 0] >= 0
    on, off = refused[0][shown], np.concatenate([refused[0][~shown], refused[1][has_absent]])
    usual_on, usual_off = _USUAL * np.array(REFUSALS)
    refusals = (on.sum() + usual_on) / (len(on) + _USUAL), (off.sum() + usual_off) / (len(off) + _USUAL)
    data = calibration_data(ranked, truth, threshold)
    confidence = replace(data.fit(), refusals=(float(refusals[0]), float(refusals[1])), standardize=rule)
    probabilities, reasons = confidence.probability(data.present), list[str]()
    if not data.num_absent:
        reason = "without the images of a query's place there are no candidates, so that places that the map does not"
        reasons.append(f"{reason} show get too high a confidence")
    if np.ptp(probabilities[np.isfinite(probabilities)]) < _LEAST_RANGE:
        reason = f"scores do not tell correct predictions ({data.correct.sum()} of {len(data.correct)}) from incorrect"
        reasons.append(f"{reason} ones, so that every image gets the same confidence")
    for reason in reasons:
        warnings.warn(f"{root}: {reason}; calibrate on a longer drive", stacklevel=3)
    return confidence, data
