"""`Map`: localize one image in a folder of images whose places are known."""

import json
import math
import warnings
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from mfvpr.core.batch import BIN_STEP, score_candidates
from mfvpr.core.histogram import HistogramOfShifts
from mfvpr.core.scorer import Scorer, fit_capacities, require_scores
from mfvpr.core.types import Features, Matches, Shortlist
from mfvpr.datasets.datasets import Dataset, GroundTruth, ImageFolder, image_folder
from mfvpr.datasets.datasets import folder as folder_dataset
from mfvpr.datasets.ground_truth import middle
from mfvpr.evaluation.confidence import (
    REFUSALS,
    CalibrationData,
    Confidence,
    absent_ranking,
    calibration_data,
    confidence_from_json,
)
from mfvpr.evaluation.dataset_ranking import Reason, rank_dataset
from mfvpr.evaluation.evidence import (
    LEAST_STRENGTH,
    evidence_against,
    evidence_scores,
    reason_against,
    reason_against_image,
)
from mfvpr.evaluation.rankings import Ranked, rank_by_scores
from mfvpr.evaluation.stages import pair_shifts, require_finite
from mfvpr.evaluation.system import System, noise_images
from mfvpr.features.feature_set import STEP, stack_features, strength
from mfvpr.localization.map_images import Described, Image, MapImages, exclusive, fit_to_map, load, read_system
from mfvpr.localization.predictions import Alternative, Localization, Prediction
from mfvpr.localization.route import Route
from mfvpr.matchers.matcher import Matcher, match_pairs
from mfvpr.storage.feature_cache import FeatureCache
from mfvpr.utils.compiled_programs import keep_compiled_programs
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import whole
from mfvpr.utils.fingerprints import fingerprint, recipe_of
from mfvpr.utils.numerics import available_cpus, knows_own_context, round_up
from mfvpr.utils.runtime import DEFAULT_RUNTIME, Runtime, ordered_map

Point = tuple[float, float]

_PAIRS_AT_ONCE = 8  # a scorer takes the time of so many, also for a single image of a rare size
_LEAST_SLOTS = 256  # of an image
_USUAL = 10  # images with the shares of `REFUSALS`, that are added to those of a drive
_LEAST_RANGE = 0.02  # of the confidence over a drive that tells correct from incorrect predictions
_ROWS = whole(0, 10**9)  # an argument that is a number of rows


class Map(MapImages):
    """Images with their places in a folder, in which one image at a time is localized.

        street = Map.create("map", "day/", mfvpr.load_system("steering"))
        street.calibrate("day/", "night/", ground_truth="order")
        street.localize("query.jpg").place
        street = Map.open("map")  # later, and in other processes

    Any number of processes read the same folder while one adds to it; they see complete rows only. Any number of
    threads use the same `Map`, which serves one at a time; open another one to localize while `build` runs. Compiled
    programs stay on disk, see `mfvpr.utils.compiled_programs`: the next process starts fast.
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
                extractor, or aggregated by a vocabulary, which is learned once (`learn`, or `build`) and stored.
            confidence: gives the probability that the top prediction is correct; None = that of `calibrate`, or none.
            threshold: of the confidence, below which there is no place.
            runtime: memory that features may take, progress, and messages.

        Raises:
            InputError: a system that a map cannot use, a threshold without a confidence, a folder with a map that was
                made with another system, or a new map of a system whose image size follows the images (`create`).
        """
        super().__init__(Path(folder), fit_to_map(Path(folder), system, None, runtime.log), runtime)
        if confidence is None and (part := self._file.part("confidence")):
            content = json.loads(part)
            if content["system"] != _fingerprint(self.system):
                expected = "the confidence of this map's system, got that of another system or version"
                raise InputError(f"{folder}: expected {expected}; calibrate again")
            confidence = confidence_from_json(content["confidence"])
        if threshold is not None and (confidence is None or not 0 <= threshold <= 1):
            expected = "a number from 0 to 1, and a confidence as well, which gives probabilities; calibrate the map"
            raise InputError(f"threshold={threshold}: expected {expected}")
        self.confidence, self.threshold = confidence, threshold
        self._noise_scores: dict[int, float] = {}  # by the number of rows
        self._typical = self.extractor.scales[0].typical_count
        self._matcher: Any = self.system.pipeline.matcher  # one that JAX compiles, see `describers_of`
        keep_compiled_programs()

    @classmethod
    def open(cls, folder: Path | str, *, threshold: float | None = None, runtime: Runtime = DEFAULT_RUNTIME) -> "Map":
        """Open a map that `create` or `mfvpr map build` made, with the system and the confidence in its folder.

        An `InputError` says that there is no map, or one with a system of your own: `Map(folder, system)` opens it.
        """
        return cls(folder, read_system(Path(folder)), threshold=threshold, runtime=runtime)

    @classmethod
    def create(
        cls,
        folder: Path | str,
        images: ImageFolder | Path | str,
        system: System,
        *,
        places: Sequence[Any] | None = None,
        cache: FeatureCache | None = None,
        runtime: Runtime = DEFAULT_RUNTIME,
    ) -> "Map":
        """Make a map of the images of a folder, or add those that it lacks; see `build` for the arguments."""
        images = images if isinstance(images, ImageFolder) else image_folder(images)
        warn = lambda line: runtime.log(f"warning: {line}")  # noqa: E731
        known = cls(folder, fit_to_map(Path(folder), system, images, warn), runtime=runtime)
        if same := len({*known.names} & {*images.names}):
            fix = "make another map if their content is new"
            runtime.log(f"{folder}: has {same} of {len(images)} images already, by their names, and keeps them; {fix}")
        known.build(images, places, cache=cache)
        return known

    def calibrate(
        self,
        database: Path | str,
        queries: Path | str,
        *,
        ground_truth: GroundTruth | str = "order",
        cache: FeatureCache | None = None,
    ) -> Confidence:
        """Fit the confidence on a drive, and keep it in the folder of the map.

        It holds for drives like this one. Correct is a prediction within 2 frames, or 25 m. Each query counts once more
        without the images of its place, as one of a place that the map does not show.

        Args:
            database: folder of images along a path, preferably another than that of the map.
            queries: folder of images of the drive along this path.
            ground_truth: see `mfvpr.datasets.folder`.
            cache: keeps features.
        """
        dataset = folder_dataset(database, queries, ground_truth=ground_truth)
        self.confidence, data = fit_on_drive(dataset, self.system, cache)
        if (of_system := _fingerprint(self.system)) is None:
            warnings.warn("a part of the system names no `recipe`: the confidence is not kept on disk", stacklevel=2)
        else:
            content = {"system": of_system, "queries": len(data.correct), "absent_queries": data.num_absent}
            with self._file.lock():
                self._write({"confidence": json.dumps(content | {"confidence": vars(self.confidence)}).encode()})
        return self.confidence

    def localize(self, image: Image, *, recent: int = 0, route: Route | None = None) -> Prediction:
        """Find where an image, a file or `[H, W, 3]` uint8 RGB, was taken; see `localize_with_evidence`."""
        return self.localize_with_evidence(image, recent=recent, route=route).prediction

    @exclusive
    def localize_with_evidence(
        self, image: Image, *, recent: int = 0, before: int | None = None, route: Route | None = None
    ) -> Localization:
        """Find where an image was taken, and return its features and matches as well.

        There is no place, and `reason` says why, for a query without enough evidence, such as a black, blurred or noisy
        image (`mfvpr.evaluation.evidence`), without candidates, or with a confidence below the threshold.

        Args:
            image: a file, or `[H, W, 3]` uint8 RGB in any form that `np.asarray` converts.
            recent: number of newest rows to leave out: while a drive is added, they show the same place.
            before: rows from this one on are left out as well, as if the map ended there; None = no such limit.
            route: of the drive that the image is the next one of; the prediction is then `located` on it.

        Raises:
            InputError: the map is empty, the image cannot be read, `recent` or `before` is no number of rows, or
                `route` is no `Route`.
        """
        if not isinstance(route, Route | None):
            raise InputError(f"route: expected Route(), the same for all images of a drive, got {route!r}")
        _ROWS.check("recent", recent)
        (_ROWS | None).check("before", before)
        self._refresh_images()
        pixels, total = load(image), len(self)
        described, resized = self.describing.pixels(pixels)
        end = max(0, (total if before is None else min(int(before), total)) - int(recent))
        localized = self._localize(described, end, pixels.shape[1::-1], reason_against_image(resized))
        if route is None:
            return localized
        refusals = REFUSALS if self.confidence is None else self.confidence.refusals
        located = route(localized.prediction, self.there[:end], refusals)
        prediction = replace(localized.prediction, located=located)
        if located is not None and located.row is None:
            prediction = prediction.without_place("off the map")
        return localized._replace(prediction=prediction)

    @exclusive
    def warm_up(self) -> None:
        """Compile what `localize` needs for images with as many keypoints as those of the map, which stays as it is.

        An empty map raises an `InputError`.
        """
        self._refresh_images()
        self.describing.image(noise_images()[0])
        rows = {padded_size(count, self._typical): row for row, count in enumerate(self._counts)}  # one of each size
        images = self._read_features([*rows.values()])
        for row, features in zip(rows.values(), images, strict=True):  # its own best candidate: nothing is left out
            match_and_score(features, images, self._matcher, self.system.scorers, self._typical)
            self._localize((features, self._vectors[row]), len(self), self.extractor.image_size, None)

    def _refresh_images(self) -> None:
        self.refresh()
        if not len(self):
            raise InputError(f"{self.folder}: expected a map with images, got an empty one; add some")

    def _localize(self, described: Described, end: int, size: tuple[int, int], reason: Reason | None) -> Localization:
        """Localize a described image of (width, height) px among the rows before `end`, if no reason is against it."""
        features, vector = described
        if end and strength(features) < LEAST_STRENGTH * self._strengths[end] / end:
            reason = "too few features"
        rows, similarities = self._vectors.nearest(vector, self.candidates, before=end)
        if reason is None and not len(rows):
            reason = "no candidates"
        if reason is not None:
            return Localization(Prediction(reason=reason, image_width=size[0]), described, None)
        candidates = self._read_features(rows.tolist())
        matches, scores = match_and_score(features, candidates, self._matcher, self.system.scorers, self._typical)
        ranking = self._rank(rows, similarities, scores)
        best = matches[int(np.flatnonzero(rows == ranking.rows[0, 0])[0])]
        if reason := reason_against(best.mask.sum(), evidence_scores(best)[0], self._noise_score(end)):
            return Localization(Prediction(reason=reason, image_width=size[0]), described, None)
        p = math.nan if self.confidence is None else float(self.confidence(ranking)[0])
        alternatives = tuple(
            Alternative(row, self._names[row], self._places[row], score)
            for row, score in zip(ranking.rows[0].tolist(), ranking.scores[0].tolist(), strict=True)
        )
        top, shift = alternatives[0], shift_of(self.system.scorers.values(), best, size)
        confidence = None if math.isnan(p) else p  # without a finite score
        prediction = Prediction(top.place, alternatives, top.score, confidence, *shift, image_width=size[0])
        if self.threshold is not None and not p >= self.threshold:
            prediction = prediction.without_place("low confidence")
        return Localization(prediction, described, jax.tree.map(lambda leaf: leaf[0], best))

    def _noise_score(self, end: int) -> float:
        """The best score of noise images; while a map grows, it changes when the number of rows has doubled."""
        end = 1 << max(0, end.bit_length() - 1)
        if end not in self._noise_scores:
            scores = [0.0]
            for image in noise_images(self.extractor.image_size):
                features, vector = self.describing.image(image)
                rows, _ = self._vectors.nearest(vector, self.candidates, before=end)
                candidates = self._read_features(rows.tolist())
                pairs, _ = match_and_score(features, candidates, self._matcher, {}, self._typical)
                scores += [float(evidence_scores(pair)[0]) for pair in pairs]
            self._noise_scores[end] = float(np.max(scores))
        return self._noise_scores[end]

    def _rank(self, rows: np.ndarray, similarities: np.ndarray, scores: Mapping[str, np.ndarray]) -> Ranked:
        """The ranking that decides; it compiles once, for `candidates` rows."""
        pad = lambda values, fill: np.pad(values, (0, self.candidates - len(values)), constant_values=fill)[None]  # noqa: E731
        shortlist = Shortlist(pad(rows, -1), pad(similarities, 0), pad(np.ones(len(rows), bool), False))
        padded_scores = {name: pad(values, np.nan) for name, values in scores.items()}
        final = self.system.final_scores[self.system.headline]
        [ranking] = rank_by_scores(shortlist, padded_scores, [final], self.system.ties).values()
        return Ranked(ranking.rows[:, : len(rows)], ranking.scores[:, : len(rows)])


def match_and_score(
    query: Features, candidates: Sequence[Features], matcher: Matcher, scorers: Mapping[str, Scorer], typical: int
) -> tuple[list[Matches], dict[str, Float[np.ndarray, " candidates"]]]:
    """Matches `[1, K, ...]` of an unpadded query with each candidate, and scores by name.

    Images are padded to one of a few sizes by their own numbers of keypoints, so that no pair's result and time depend
    on the other pairs. Each core takes a few pairs at a time, since the steps after a pair's product keep one core
    busy. `typical` is a usual number of keypoints, or the detector's limit. An InputError if no score is finite.
    """
    padded_query = stack_features([query], padded_size(len(query.mask), typical), total=1)
    by_size = defaultdict[int, list[int]](list)
    for place, candidate in enumerate(candidates):
        by_size[padded_size(len(candidate.mask), typical)].append(place)
    parts = [
        (size, places[start : start + _PAIRS_AT_ONCE])
        for size, places in sorted(by_size.items(), reverse=True)
        for start in range(0, len(places), _PAIRS_AT_ONCE)
    ]

    def match_part(part: tuple[int, list[int]]) -> tuple[Matches, dict[str, np.ndarray]]:
        size, places = part
        images = stack_features([candidates[place] for place in places], size, total=_PAIRS_AT_ONCE)
        pairs = np.stack([np.zeros(_PAIRS_AT_ONCE, np.int32), np.arange(_PAIRS_AT_ONCE, dtype=np.int32)], axis=1)
        matches = match_pairs(padded_query, images, pairs, np.int32(len(places)), matcher)
        scores = {name: score_candidates(scorer, matches) for name, scorer in scorers.items()}
        for name, values in scores.items():
            require_scores(type(scorers[name]).__name__, values, _PAIRS_AT_ONCE)
        return jax.device_get((matches, {name: values.astype(np.float32) for name, values in scores.items()}))

    workers = min(available_cpus(), len(parts))
    map_parts = partial(ordered_map, workers=workers) if workers > 1 and knows_own_context() else map
    matches, scores = {}, {name: np.zeros(len(candidates), np.float32) for name in scorers}
    for (_, places), (of_part, scores_of_part) in zip(parts, map_parts(match_part, parts), strict=True):
        for number, place in enumerate(places):
            matches[place] = jax.tree.map(lambda leaf: leaf[number : number + 1], of_part)  # noqa: B023
        for name, values in scores_of_part.items():
            scores[name][places] = values[: len(places)]
    for name, values in scores.items():
        require_finite(name, values)
    return [matches[place] for place in range(len(candidates))], scores


def padded_size(count: int, typical: int) -> int:
    """Slots for an image: `typical` rounded up, or a power of 2 from 256 on: few sizes, so few programs."""
    size, typical = 1 << (max(count, _LEAST_SLOTS) - 1).bit_length(), round_up(typical, STEP)
    return min(size, typical) if typical >= count else size


def shift_of(
    scorers: Iterable[Scorer], pair: Matches, size: tuple[int, int]
) -> tuple[Point | None, tuple[Point, Point] | None]:
    """`shift` and `shift_interval` of a `Prediction` by the first histogram of shifts, from one pair.

    Shifts of the resized images become px of the query image, whose size is (width, height).
    """
    scorer = next((scorer for scorer in scorers if isinstance(scorer, HistogramOfShifts)), None)
    if scorer is None:
        return None, None
    histogram = fit_capacities(scorer, pair.image_size0, pair.image_size1, multiple=BIN_STEP)
    shift, interval = (np.asarray(values)[0] for values in pair_shifts(histogram, pair))
    stretch = np.divide(size, np.asarray(pair.image_size0)[0])
    shift, interval = stretch * shift, stretch * interval
    point, low, high = ((float(x), float(y)) if np.isfinite(x + y) else None for x, y in (shift, *interval))
    return point, (low, high) if low and high else None


def fit_on_drive(dataset: Dataset, system: System, cache: FeatureCache | None) -> tuple[Confidence, CalibrationData]:
    """Fit the confidence of the ranking that decides on a data set; also what it was fitted on.

    Each query counts twice: as it is, and without the images of its place, see `calibration_data`.
    """
    truth, root, cache = dataset.only.truth, dataset.queries.root, cache or FeatureCache()
    if truth is None:
        raise InputError(f"{dataset.name}: expected a ground truth, which says what is correct, got none")
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
    confidence = replace(data.fit(), refusals=(float(refusals[0]), float(refusals[1])))
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


def _fingerprint(system: System) -> str | None:
    """A hash of everything that scores depend on; None if a part has no recipe."""
    pipeline = system.pipeline
    parts = (pipeline.extractor, pipeline.retriever, pipeline.matcher, pipeline.candidates, dict(system.scorers))
    try:
        return fingerprint(recipe_of([*parts, dict(system.fused), system.ties, system.headline]))
    except TypeError:
        return None
