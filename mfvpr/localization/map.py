"""`Map`: localize one image in a folder of images whose places are known."""

import math
import operator
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from mfvpr.evaluation.calibration import Confidence
from mfvpr.features.extractor import Aggregation, Extractor
from mfvpr.features.vlad import VladFitting
from mfvpr.localization.describing import Image
from mfvpr.localization.evidence import LEAST_MATCHES, LEAST_STRENGTH, strength
from mfvpr.localization.images import MapImages, exclusive
from mfvpr.localization.matching import match_and_score, shift_of
from mfvpr.localization.predictions import Alternative, Localization, Prediction, refusal
from mfvpr.matching.matcher import NEIGHBORS, Matcher
from mfvpr.reranking.results import Ranked
from mfvpr.scoring.histogram import HistogramOfShifts
from mfvpr.scoring.scorer import Scorer
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import clip_middle


class Map(MapImages):
    """Images with their places in a folder, in which one image at a time is localized.

        known = Map("map", Sift(), VladFitting())
        known.build(images, places)
        known.localize("query.jpg").place

    Any number of processes read the same folder while one adds to it; they see complete rows only. Any number of
    threads use the same `Map`, which serves one at a time; open another one to localize while `build` runs.
    """

    def __init__(
        self,
        folder: Path | str,
        extractor: Extractor,
        describer: Extractor | Aggregation | VladFitting,
        *,
        scorer: Scorer | None = None,
        matcher: Matcher = NEIGHBORS,
        candidates: int = 50,
        confidence: Confidence | None = None,
        threshold: float | None = None,
        memory: float | None = None,
    ) -> None:
        """Open the map in a folder, which is made when the first image is added.

        Args:
            folder: of the map.
            extractor: takes local features, of one scale.
            describer: gives global descriptors: the same extractor, another one, an aggregation of the local features,
                or `VladFitting`, whose vocabulary is learned once (`learn`, or `build`) and stored in the folder.
            scorer: None = the histogram of shifts.
            matcher: of a pair.
            candidates: number of images that are matched, those with the most similar descriptors.
            confidence: gives the probability p that the top prediction is correct, as an evaluation with the same
                settings wrote it; None = no p.
            threshold: of p, below which there is no place.
            memory: GB that features may take on the device; None = a third of what is free.

        Raises:
            InputError: features of several scales, a threshold without a confidence, or a folder with a map that was
                made with other settings.
        """
        if len(extractor.scales) != 1:
            raise InputError(f"{type(extractor).__name__}: a map takes local features of one scale, "
                             f"got {len(extractor.scales)}")  # fmt: skip
        candidates = _whole_number("candidates", candidates, least=1)
        if threshold is not None and confidence is None:
            raise InputError(f"threshold={threshold}: expected a confidence as well, which gives p")
        self.scorer: Scorer = HistogramOfShifts() if scorer is None else scorer
        self.matcher, self.confidence, self.threshold = matcher, confidence, threshold
        super().__init__(folder, extractor, describer, candidates=candidates, memory=memory)

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
        matches, scores = match_and_score(features, arrays, slots, self.candidates, self.matcher, self.scorer)
        order = np.argsort(-np.where(np.isnan(scores), -np.inf, scores), kind="stable")
        best = jax.tree.map(lambda leaf: leaf[order[0] : order[0] + 1], matches)
        if best.mask.sum() < LEAST_MATCHES:
            return refusal("too few matches", description)
        ranking = Ranked(rows[order][None], scores[order][None])
        p = self._probability(ranking, Ranked(rows[None], similarities[None]))
        alternatives = tuple(
            Alternative(row, self._entries[row].name, self._entries[row].place, score)
            for row, score in zip(rows[order].tolist(), scores[order].tolist(), strict=True)
        )
        prediction = Prediction(
            alternatives[0].place, alternatives, alternatives[0].score, p, *shift_of(self.scorer, best)
        )
        if self.threshold is not None and not (p is not None and p >= self.threshold):
            prediction = replace(
                prediction, place=None, shift=None, shift_interval=None, scale=None, reason="low confidence"
            )
        return Localization(prediction, description, jax.tree.map(lambda leaf: leaf[0], best))

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
