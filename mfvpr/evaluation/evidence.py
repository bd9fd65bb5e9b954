"""The least evidence for a prediction: enough keypoints, enough matches, and a better score than noise has.

A confidence compares the scores of one query with each other, so a black image can look certain. The tests here are
absolute: brightness of an image at neighboring points, its detection scores, and the score of its best candidate by a
histogram of shifts weighted by ratio, compared with images of random pixels. They do not refuse images of places that
the database does not show.
"""

import tempfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from mfvpr.core.batch import score_candidates
from mfvpr.core.histogram import HistogramOfShifts
from mfvpr.core.types import Matches
from mfvpr.core.weights import RatioWeight
from mfvpr.datasets.datasets import ImageFolder, QuerySequence, image_folder
from mfvpr.datasets.image_reading import resize
from mfvpr.evaluation import stages
from mfvpr.evaluation.dataset_ranking import RankedDataset, Reason, match_sequence
from mfvpr.evaluation.rankings import Matched
from mfvpr.evaluation.system import Pipeline, noise_images
from mfvpr.features.extractor import Source
from mfvpr.features.feature_set import strength
from mfvpr.retrieval.retriever import Retrieval
from mfvpr.storage.feature_cache import FeatureCache

# Of brightness at an 80th of the image's side, chosen on synthetic streets: noise has at most 0.19, streets have from
# 0.64 to 0.94, and streets that are blurred over 8 % of the width at least 0.97.
_LEAST_CORRELATION, _MOST_CORRELATION = 0.3, 0.97
# Round numbers, chosen with a park path, a corridor and synthetic streets in view: they are no independent test.
_MOST_WHITE = 0.6  # share of the image
LEAST_STRENGTH = 0.05  # of the mean strength of the database images
LEAST_MATCHES = 8  # of a query with its best candidate
LEAST_SCORE = 1.2  # times the best score of noise images
_SAMPLE = 32  # database images that say how strong images are
_SCORER = HistogramOfShifts(weight=RatioWeight())


def reason_against_image(pixels: UInt8[np.ndarray, "height width 3"]) -> Reason | None:
    """Why a query, at the size of the extractor, cannot be used; None = it may be."""
    brightness = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
    if np.mean(brightness >= 250) > _MOST_WHITE:
        return "overexposed"
    brightness = brightness.astype(np.float32)
    rows, columns = (max(1, round(side / 80)) for side in brightness.shape)
    pairs = (brightness[rows:], brightness[:-rows]), (brightness[:, columns:], brightness[:, :-columns])
    correlations = []
    for first, second in pairs:
        first, second = ((values - values.mean()).ravel() for values in (first, second))
        variances = np.vdot(first, first) * np.vdot(second, second)
        correlations.append(np.vdot(first, second) / np.sqrt(variances) if variances else np.nan)  # NaN: it is plain
    if np.less(correlations, _LEAST_CORRELATION).all():
        return "no better than noise"
    return "blurred" if np.greater(correlations, _MOST_CORRELATION).all() else None


def evidence_scores(pairs: Matches) -> Float[np.ndarray, " pairs"]:
    """Scores of the matches `[P, K]` of pairs; NaN if they have no ratio."""
    return np.full(len(pairs.mask), np.nan) if pairs.ratio is None else np.asarray(score_candidates(_SCORER, pairs))


def reason_against(matches: float, score: float, noise: float) -> Reason | None:
    """Why the matches with the best candidate are too little evidence; None = they are enough.

    `score` is the candidate's, `noise` the best score of noise images; NaN = not known.
    """
    if matches < LEAST_MATCHES:
        return "too few matches"
    return "no better than noise" if score < LEAST_SCORE * noise else None


def evidence_against(ranked: RankedDataset, cache: FeatureCache) -> list[list[Reason | None]]:
    """Why there is too little evidence for each query's prediction by the ranking that decides, by sequence, or None.

    Scores are known for matches with a ratio, of a single scale, and a retrieval by global descriptors.
    """
    database, pipeline = ranked.dataset.database, ranked.system.pipeline
    sample, extractor = range(0, len(database), -(-len(database) // _SAMPLE)), pipeline.extractor
    least = LEAST_STRENGTH * np.mean(_strengths(database, pipeline, cache, sample))
    noise, reasons = _noise_score(ranked, cache), list[list[Reason | None]]()
    for matched, ranking in zip(ranked.matched, ranked.systems[ranked.system.headline], strict=True):
        images = matched.sequence.images
        is_weak = _strengths(images, pipeline, cache, range(len(images))) < least
        pairs = np.arange(len(images)), np.argmax(matched.candidates.indices == ranking.rows[:, :1], axis=1)
        counts = np.sum([match_set.counts[pairs] for match_set in matched.matches], axis=0)
        of_sequence: list[Reason | None] = []
        for row, (weak, count, score) in enumerate(zip(is_weak, counts, _scores(matched)[pairs], strict=True)):
            reason = reason_against(count, score, noise)
            if row not in matched.bad_queries and not isinstance(extractor, Source):
                image = resize(images.read(row), extractor.image_size, extractor.interpolation)
                reason = reason_against_image(image) or reason
            of_sequence.append("too few features" if weak else reason)
        reasons.append(of_sequence)
    return reasons


def _strengths(images: ImageFolder, pipeline: Pipeline, cache: FeatureCache, rows: range) -> Float[np.ndarray, " rows"]:
    """Strengths of images, of all scales; 0 if an image cannot be read, NaN if images are matched without features."""
    if pipeline.image_source is not None:
        return np.full(len(rows), np.nan)
    strengths = dict.fromkeys(rows, 0.0)
    for scale in cache.local(images, pipeline.extractor, rows):
        for row, features in scale.read(rows):
            strengths[row] += strength(features)
    return np.array([*strengths.values()])


def _scores(matched: Matched) -> Float[np.ndarray, "queries candidates"]:
    """Scores of candidates; NaN if they are not known."""
    match_set, candidates = matched.matches[0], matched.candidates
    if len(matched.matches) > 1 or match_set.matches[0].ratio is None:
        return np.full(candidates.mask.shape, np.nan)
    return stages.score({"evidence": _SCORER}, match_set, candidates)["evidence"]


def _noise_score(ranked: RankedDataset, cache: FeatureCache) -> float:
    """The best score of noise images in the database; NaN if it is not known."""
    pipeline = ranked.system.pipeline
    if isinstance(pipeline.extractor, Source) or not isinstance(pipeline.retriever, Retrieval):
        return float("nan")
    with tempfile.TemporaryDirectory() as folder:
        for number, image in enumerate(noise_images(pipeline.extractor.image_size)):
            Image.fromarray(image).save(Path(folder) / f"{number}.png")
        sequence = QuerySequence("noise", image_folder(folder), None)
        dataset = replace(ranked.dataset, sequences=(sequence,))
        matched = match_sequence(dataset, sequence, pipeline, cache=cache)
        return float(np.max(_scores(matched), where=matched.candidates.mask, initial=0))
