"""`Map`: localize one image in a folder of images whose places are known."""

import math
import operator
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from mfvpr.evaluation.calibration import Confidence
from mfvpr.evaluation.system import System
from mfvpr.features.extractor import Extractor, Source
from mfvpr.features.vlad import VladFitting
from mfvpr.localization.describing import Image
from mfvpr.localization.evidence import LEAST_MATCHES, LEAST_STRENGTH, strength
from mfvpr.localization.images import MapImages, exclusive
from mfvpr.localization.matching import match_and_score, shift_of
from mfvpr.localization.predictions import Alternative, Localization, Prediction, refusal
from mfvpr.reranking.fusion import rank_by_scores
from mfvpr.reranking.results import RETRIEVAL, Ranked
from mfvpr.retrieval.retriever import Retrieval
from mfvpr.retrieval.search import ExactSearch
from mfvpr.types import Shortlist
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import clip_middle
from mfvpr.utils.fingerprints import recipe_of
from mfvpr.utils.runtime import DEFAULT_RUNTIME, Runtime


class Map(MapImages):
    """Images with their places in a folder, in which one image at a time is localized.

        sift = Sift()
        pipeline = Pipeline(sift, Retrieval(Aggregated(sift, VladFitting())))
        known = Map("map", System(pipeline, {"histogram": HistogramOfShifts()}))
        known.build(images, places)
        known.localize("query.jpg").place

    Any number of processes read the same folder while one adds to it; they see complete rows only. Any number of
    threads use the same `Map`, which serves one at a time; open another one to localize while `build` runs.
    """

    def __init__(
        self,
        folder: Path | str,
        system: System,
        *,
        confidence: Confidence | None = None,
        threshold: float | None = None,
        runtime: Runtime = DEFAULT_RUNTIME,
    ) -> None:
        """Open the map in a folder, which is made when the first image is added.

        Args:
            folder: of the map.
            system: extracts local features of one scale, and retrieves candidates by global descriptors: of an
                extractor, or aggregated from the local features by a vocabulary, which is learned once (`learn`, or
                `build`) and stored in the folder. The ranking that decides may combine scores.
            confidence: gives the probability that the top prediction is correct, as an evaluation with the same system
                wrote it; None = no probability.
            threshold: of the confidence, below which there is no place.
            runtime: memory that features may take on the device.

        Raises:
            InputError: a system that a map cannot use, a threshold without a confidence, or a folder with a map that
                was made with another system.
        """
        if threshold is not None and confidence is None:
            raise InputError(f"threshold={threshold}: expected a confidence as well, which gives probabilities")
        extractor, describer, candidates = _extractor(system), _describer(system), system.pipeline.candidates
        self.system, self.confidence, self.threshold = system, confidence, threshold
        super().__init__(folder, extractor, describer, candidates=int(candidates), memory=runtime.memory)

    def localize(self, image: Image, *, recent: int = 0) -> Prediction:
        """Find where an image was taken; see `localize_with_evidence`."""
        return self.localize_with_evidence(image, recent=recent).prediction

    @exclusive
    def localize_with_evidence(self, image: Image, *, recent: int = 0, before: int | None = None) -> Localization:
        """Find where an image was taken, and return its features and matches as well.

        There is no place, and `reason` says why, for a query with too few features or matches
        (`mfvpr.localization.evidence`), without candidates, or with a confidence below the threshold.

        Args:
            image: a file, or `[H, W, 3]` uint8 RGB in any form that `np.asarray` converts.
            recent: number of newest rows to leave out: while a drive is added, they show the same place.
            before: rows from this one on are left out as well, as if the map ended there; None = no such limit.

        Raises:
            InputError: the map is empty, the image cannot be read, or `recent` or `before` is no number of rows.
        """
        recent = _whole_number("recent", recent)
        before = None if before is None else _whole_number("before", before)
        self.refresh()
        if not len(self) or self._described is None:
            raise InputError(f"{self.folder}: expected a map with images, got an empty one; add some")
        features, vector = description = self._described.describing.image(image)
        total = self._vectors.total
        end = max(0, (total if before is None else min(before, total)) - recent)
        if strength(features) < LEAST_STRENGTH * self._described.strength(end):
            return refusal("too few features", description)
        rows, similarities = self._vectors.nearest(vector, self.candidates, before=end)
        if not len(rows):
            return refusal("no candidates", description)
        arrays, slots = self._described.resident.hold(rows.tolist(), features, total)
        matcher, scorers = self.system.pipeline.matcher, self.system.scorers
        matches, scores = match_and_score(features, arrays, slots, self.candidates, matcher, scorers)
        ranking, by_retrieval = self._rank(rows, similarities, scores)
        [place] = np.flatnonzero(rows == ranking.rows[0, 0])
        best = jax.tree.map(lambda leaf: leaf[place : place + 1], matches)
        if best.mask.sum() < LEAST_MATCHES:
            return refusal("too few matches", description)
        p = self._probability(ranking, by_retrieval)
        alternatives = tuple(
            Alternative(row, self._entries[row].name, self._entries[row].place, score)
            for row, score in zip(ranking.rows[0].tolist(), ranking.scores[0].tolist(), strict=True)
        )
        prediction = Prediction(
            alternatives[0].place, alternatives, alternatives[0].score, p, *shift_of(scorers.values(), best)
        )
        if self.threshold is not None and not (p is not None and p >= self.threshold):
            prediction = replace(
                prediction, place=None, shift=None, shift_interval=None, scale=None, reason="low confidence"
            )
        return Localization(prediction, description, jax.tree.map(lambda leaf: leaf[0], best))

    def _rank(
        self, rows: np.ndarray, similarities: np.ndarray, scores: Mapping[str, np.ndarray]
    ) -> tuple[Ranked, Ranked]:
        """The ranking that decides, and that of the retrieval; both compile once, for `candidates` rows."""
        pad = lambda values, fill: np.pad(values, (0, self.candidates - len(values)), constant_values=fill)[None]  # noqa: E731
        shortlist = Shortlist(pad(rows, -1), pad(similarities, 0), pad(np.ones(len(rows), bool), False))
        padded_scores = {name: pad(values, np.nan) for name, values in scores.items()}
        final_scores, ties = self.system.final_scores.values(), self.system.ties
        rankings = rank_by_scores(shortlist, padded_scores, final_scores, ties)
        cut = lambda ranking: Ranked(ranking.rows[:, : len(rows)], ranking.scores[:, : len(rows)])  # noqa: E731
        return cut(rankings[self.system.headline]), cut(rankings[RETRIEVAL])

    def _probability(self, ranking: Ranked, retrieval: Ranked) -> float | None:
        """Probability that the top prediction is correct; None without a confidence or a finite score."""
        p = math.nan if self.confidence is None else float(self.confidence(ranking, retrieval)[0])
        return None if math.isnan(p) else p


def _whole_number(name: str, value: Any, least: int = 0) -> int:
    """An argument as int; NumPy's whole numbers are allowed."""
    try:
        if (number := operator.index(value)) >= least:
            return number
    except TypeError:
        pass
    got = clip_middle(" ".join(repr(value).split()), 80)
    raise InputError(f"{name}: expected a whole number from {least}, got {got}. Use an `int`.")


def _extractor(system: System) -> Extractor:
    """The extractor of a system; an InputError if a map cannot use it."""
    extractor, candidates = system.pipeline.extractor, system.pipeline.candidates
    if isinstance(extractor, Source):
        name = type(extractor).__name__
        raise InputError(f"{name}: a map extracts features of images itself; expected an extractor")
    if len(extractor.scales) != 1:
        raise InputError(f"{type(extractor).__name__}: a map takes local features of one scale, "
                         f"got {len(extractor.scales)}")  # fmt: skip
    if candidates == "all":
        raise InputError("candidates='all': expected a number, which a map matches whatever it holds")
    if system.cohort is not None or system.correlated:
        raise InputError("a map ranks single images: expected a system without cohort and frame correlation")
    return extractor


def _describer(system: System) -> Extractor | VladFitting:
    """The extractor of global descriptors, or the fitting of the vocabulary; an InputError if a map cannot use it."""
    retriever = system.pipeline.retriever
    if not isinstance(retriever, Retrieval) or not isinstance(retriever.search, ExactSearch):
        name = type(retriever).__name__
        raise InputError(f"{name}: a map retrieves by global descriptors without whitening; expected Retrieval(...)")
    if isinstance(describer := retriever.describer, Extractor):
        return describer
    is_same = recipe_of(describer.extractor) == recipe_of(system.pipeline.extractor)
    if not is_same or not isinstance(describer.fitting, VladFitting):
        raise InputError("a map aggregates its local features: expected Aggregated(extractor, VladFitting(...)) of the "
                         "same extractor")  # fmt: skip
    return describer.fitting
