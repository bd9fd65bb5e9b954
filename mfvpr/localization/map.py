"""`Map`: localize one image in a folder of images whose places are known."""

import json
import math
import os
import shutil
import threading
import warnings
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from mfvpr.core.types import Features, Shortlist
from mfvpr.datasets.datasets import GroundTruth, ImageFolder, image_folder
from mfvpr.datasets.datasets import folder as folder_dataset
from mfvpr.evaluation.calibration import fit_on_drive
from mfvpr.evaluation.confidence import REFUSALS, Confidence, confidence_from_json
from mfvpr.evaluation.dataset_ranking import Reason
from mfvpr.evaluation.evidence import LEAST_STRENGTH, evidence_scores, reason_against, reason_against_image
from mfvpr.evaluation.rankings import Ranked, rank_by_scores
from mfvpr.evaluation.system import System, noise_images
from mfvpr.features.extractor import Extractor
from mfvpr.features.feature_set import SHARE, check_features, strength
from mfvpr.features.vlad import Vlad, VladFitting
from mfvpr.localization import map_settings, query_steps
from mfvpr.localization.predictions import Alternative, Localization, Prediction
from mfvpr.localization.query_steps import Described, Describing, Image
from mfvpr.localization.route import Route
from mfvpr.retrieval.retriever import in_turns, scores_of_turns
from mfvpr.retrieval.standardization import GrowingDatabase, Moments, Rule
from mfvpr.storage.cache_files import pack_arrays, unpack_arrays
from mfvpr.storage.feature_cache import FeatureCache
from mfvpr.storage.maps import Entry, MapFile, check_entry
from mfvpr.utils.compiled_programs import keep_compiled_programs
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import whole
from mfvpr.utils.files import canonical_name
from mfvpr.utils.numerics import free_host_bytes
from mfvpr.utils.runtime import DEFAULT_RUNTIME, Runtime

_FIRST_ROWS = 1024  # of global descriptors; twice as many whenever they are full
_ROWS = whole(0, 10**9)  # an argument that is a number of rows


class Map:
    """A folder of images with known places, in which one image at a time is localized.

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
            InputError: a system that a map cannot use, or another one than that of the folder's map; a threshold
                without a confidence; a new map of a system whose image size follows the images (use `create`).
        """
        self.system = map_settings.fit_to_map(Path(folder), system, None, runtime.log)
        self.extractor, self._describers = map_settings.describers_of(self.system)
        self.folder, self.candidates = Path(folder).absolute(), int(self.system.pipeline.candidates)
        self._runtime, self._file, self._lock = runtime, MapFile(self.folder), threading.RLock()
        self._parts = map_settings.parts_of(self.system)
        self._is_checked = False  # whether the file is known to have these parts
        fitted = (each for each in self._describers if isinstance(each, VladFitting))
        self._fitting = next(fitted, None)  # of a vocabulary
        described = [each for each in self._describers if isinstance(each, Extractor)]
        self._describing = None if self._fitting else Describing(self.extractor, described)
        self._images, self._row_of_name = list[tuple[str, Any]](), dict[str, int]()  # (name, place)
        self._counts, self._strengths = list[int](), [0.0]  # of keypoints, and sums of strengths of the first rows
        self._vectors = np.zeros((0, 0), np.float32)  # `[rows and some more, D]`; NaN of an image without features
        self._rules = [getattr(each.search, "standardize", "none") for each in map_settings.retrievals_of(self.system)]
        self._standardized = [GrowingDatabase() for _ in self._rules]
        dimension = self.extractor.scales[0].dimension
        sizes = [
            each.num_words * dimension if isinstance(each, VladFitting) else each.vector_size
            for each in self._describers
        ]
        self._slices = [slice(end - size, end) for size, end in zip(sizes, np.cumsum(sizes), strict=True)]
        self._features = OrderedDict[int, Features]()  # of the recently used rows
        self._free_bytes = SHARE * free_host_bytes() if runtime.memory is None else 1e9 * runtime.memory
        self._noise_scores: dict[int, float] = {}  # by the number of rows
        self._typical = self.extractor.scales[0].typical_count
        self._matcher: Any = self.system.pipeline.matcher  # one that JAX compiles, see `describers_of`
        self._final = self.system.final_scores[self.system.headline]  # the score that decides
        self.refresh()
        if confidence is None and (part := self._file.part("confidence")):
            content = json.loads(part)
            if content["system"] != map_settings.system_fingerprint(self.system):
                expected = "the confidence of this map's system, got that of another system or version"
                raise InputError(f"{folder}: expected {expected}; calibrate again")
            confidence = confidence_from_json(content["confidence"])
        if threshold is not None and (confidence is None or not 0 <= threshold <= 1):
            expected = "a number from 0 to 1, and a confidence as well, which gives probabilities; calibrate the map"
            raise InputError(f"threshold={threshold}: expected {expected}")
        self.confidence, self.threshold = confidence, threshold
        keep_compiled_programs()

    @classmethod
    def open(cls, folder: Path | str, *, threshold: float | None = None, runtime: Runtime = DEFAULT_RUNTIME) -> "Map":
        """Open a map that `create` or `mfvpr map build` made, with its system and confidence.

        An InputError if there is no map, or one with a system of your own: use `Map(folder, system)`.
        """
        return cls(folder, map_settings.read_system(Path(folder)), threshold=threshold, runtime=runtime)

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
        known = cls(folder, map_settings.fit_to_map(Path(folder), system, images, warn), runtime=runtime)
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
        masks: Path | str | None = None,
        cache: FeatureCache | None = None,
        route: bool = False,
    ) -> Confidence:
        """Fit the confidence on a drive, and keep it in the folder of the map.

        It holds for drives like this one. Correct is a prediction within 2 frames, or 25 m. Each query counts once more
        without the images of its place, as one of a place that the map does not show. `database` is a folder of images
        along a path, preferably another than that of the map, `queries` one of a drive along this path; for
        `ground_truth` and `masks`, see `mfvpr.datasets.folder`. The cache keeps features. If the retrieval standardizes
        descriptors, it holds either with a `route` or for images without one. It replaces an earlier one.
        """
        self._warn_of_mask(masks)
        dataset = folder_dataset(database, queries, ground_truth=ground_truth, masks=masks)
        self.confidence, data = fit_on_drive(dataset, self.system, cache, self._rule_of(route))
        if (of_system := map_settings.system_fingerprint(self.system)) is None:
            warnings.warn("a part of the system names no `recipe`: the confidence is not kept on disk", stacklevel=2)
        else:
            counts = {"queries": len(data.correct), "correct": int(data.correct.sum())}
            counts |= {"absent_queries": data.num_absent}
            content = {"system": of_system, "of": str(queries), "masks": masks is not None, **counts}
            with self._file.lock():
                self._write({"confidence": json.dumps(content | {"confidence": vars(self.confidence)}).encode()})
        return self.confidence

    def localize(
        self,
        image: Image,
        *,
        recent: int = 0,
        route: Route | None = None,
        among: Iterable[int] | None = None,
        near: tuple[Sequence[float], float] | None = None,
        mask: Path | str | None = None,
    ) -> Prediction:
        """Find where an image, a file or `[H, W, 3]` RGB, was taken; see `localize_with_evidence`."""
        return self.localize_with_evidence(
            image, recent=recent, route=route, among=among, near=near, mask=mask
        ).prediction

    def localize_with_evidence(
        self,
        image: Image,
        *,
        recent: int = 0,
        before: int | None = None,
        route: Route | None = None,
        among: Iterable[int] | None = None,
        near: tuple[Sequence[float], float] | None = None,
        mask: Path | str | None = None,
    ) -> Localization:
        """Find where an image was taken, and return its features and matches as well.

        There is no place, and `reason` says why, for a query without enough evidence, such as a black, blurred or noisy
        image (`mfvpr.evaluation.evidence`), without candidates, or with a confidence below the threshold.

        Args:
            image: a file, or its bytes; or `[H, W, 3]` RGB or `[H, W]` gray in any form that `np.asarray` converts,
                uint8, uint16, or floats from 0 to 1.
            recent: number of newest rows to leave out: while a drive is added, they show the same place.
            before: rows from this one on are left out as well, as if the map ended there; None = no such limit.
            route: of the drive that the image is the next one of; the prediction is then `located` on it.
            among: rows that may be candidates; None = all. There is no confidence, which needs all rivals.
            near: (place, radius): only images within this distance of a place may be candidates, where places are lists
                of numbers, such as positions in meters. There is no confidence.
            mask: image file that is black where pixels are ignored, such as on the robot's own hood.

        Raises:
            InputError: the map is empty, the image or the mask cannot be read, `recent`, `before` or one of `among` is
                no number of rows, places are no lists of as many numbers as that of `near`, `route` is no `Route`, or
                as `require_confidence` says.
        """
        if not isinstance(route, Route | None):
            raise InputError(f"route: expected Route(), the same for all images of a drive, got {route!r}")
        self.require_confidence(route is not None)
        is_limited = among is not None or near is not None
        if is_limited and self.threshold is not None:
            expected = "candidates of the whole map, since a confidence says nothing about fewer"
            raise InputError(f"threshold={self.threshold}: expected {expected}, got among= or near=; leave one out")
        _ROWS.check("recent", recent)
        _ROWS.check("before", 0 if before is None else before)
        with self._lock:
            self._refresh_images()
            pixels, total = query_steps.load(image), len(self)
            end = max(0, (total if before is None else min(int(before), total)) - int(recent))
            allowed = self.there[:end] if near is None else self._near(near)[:end]
            if among is not None:
                if not isinstance(among, Iterable):
                    raise InputError(f"among={among}: expected rows, such as [3, 4]")
                rows = [*among]
                for row in rows:
                    whole(0, total - 1).check("among", row)
                allowed &= np.isin(np.arange(end), rows)
            self._warn_of_mask(mask)
            described, resized = self.describing.pixels(pixels, mask)
            reason = reason_against_image(resized)
            if route is not None and self._rule_of(True) == "running" and reason is None:
                route.see(described[1])
            localized = self._localize(described, allowed, pixels.shape[1::-1], reason, route)
            if is_limited:
                localized = localized._replace(prediction=replace(localized.prediction, confidence=None))
            if route is None:
                return localized
            refusals = REFUSALS if self.confidence is None else self.confidence.refusals
            located = route(localized.prediction, self.there[:end], refusals)
            prediction = replace(localized.prediction, located=located)
            if located is not None and located.row is None:
                prediction = prediction.without_place("off the map")
            return localized._replace(prediction=prediction)

    def _warn_of_mask(self, mask: Any) -> None:
        """Warn of an image that has a mask where those of the map have none, or the other way round."""
        part = self._file.part("masks")  # None if the images were added one by one
        if part is not None and json.loads(part) != (mask is not None):
            expected, got = ("no mask", "one") if mask is not None else ("a mask", "none")
            warnings.warn(f"{self.folder}: expected {expected}, as with the images of the map, got {got}", stacklevel=4)

    def calibration(self) -> dict[str, Any]:
        """What the confidence was fitted on: `of` a folder, numbers of `queries` and `correct` ones; {} without one."""
        return json.loads(self._file.part("confidence") or b"{}")

    def require_confidence(self, route: bool) -> None:
        """Raise an InputError if the confidence was fitted on candidates that images with, or without, a route lack."""
        rule, fitted = self._rule_of(route), self.confidence and self.confidence.standardize
        if rule and fitted not in (None, rule):
            mend = "with route=True (mfvpr map calibrate --route)" if route else "without route=True"
            got = f"{fitted}; calibrate {mend}"
            raise InputError(f"confidence: expected one that was fitted with standardize={rule}, got {got}")

    def _near(self, near: tuple[Sequence[float], float]) -> Bool[np.ndarray, " rows"]:
        """Rows whose places are within a distance of a place."""
        try:
            place, radius = near
            center = np.asarray(place, np.float64)
            if center.ndim != 1 or not np.isfinite(center).all() or not radius >= 0:
                raise ValueError
        except (TypeError, ValueError):
            expected = "(place, radius), such as ([12.5, 40.0], 25.0), with a radius of at least 0"
            raise InputError(f"near={near}: expected {expected}") from None
        places = [each for _, each in self._images]
        try:
            distances = np.linalg.norm(np.array(places, np.float64).reshape(-1, len(center)) - center, axis=1)
            if len(distances) == len(places) and np.isfinite(distances).all():
                return distances <= radius
        except (TypeError, ValueError):
            pass
        row = next((row for row, each in enumerate(places) if np.shape(each) != center.shape), 0)
        expected, got = f"a map with places of {len(center)} numbers", f"{places[row]!r} of {self.names[row]}"
        raise InputError(f"near={near}: expected {expected}, got {got}")

    def warm_up(self) -> None:
        """Compile what `localize` needs for images like those of the map; an InputError for an empty map."""
        with self._lock:
            self._refresh_images()
            self.describing.image(noise_images()[0])
            # A row of each size; it is its own best candidate, so nothing is left out.
            rows = {query_steps.padded_size(count, self._typical): row for row, count in enumerate(self._counts)}
            images = self._read_features([*rows.values()])
            for row, features in zip(rows.values(), images, strict=True):
                query_steps.match_and_score(features, images, self._matcher, self.system.scorers, self._typical)
                self._localize((features, self._vectors[row]), self.there, self.extractor.image_size, None)

    def _refresh_images(self) -> None:
        self.refresh()
        if not len(self):
            raise InputError(f"{self.folder}: expected a map with images, got an empty one; add some")

    def _rule_of(self, route: bool) -> Rule | None:
        """Rule by which descriptors are standardized with or without a route; None = they are not."""
        rules = {*self._rules} - {"none"}
        if not rules:
            return None
        return "running" if route and rules != {"database"} else "database"

    def _retrieve(
        self, vector: np.ndarray, among: Bool[np.ndarray, " rows"], route: Route | None
    ) -> tuple[Int[np.ndarray, " candidates"], Float[np.ndarray, " candidates"]]:
        """Candidates of a query among rows, and their similarities; of two retrievals in turns."""
        retrieved = []
        for part, rule, standardized in zip(self._slices, self._rules, self._standardized, strict=True):
            vectors, query = self._vectors[: len(among), part], vector[part]
            if rule != "none" and len(among):
                seen = None if route is None or rule == "database" else route.seen
                drive = seen and Moments(seen.count, seen.mean[part], seen.square[part])
                [query], vectors = standardized.standardize(vectors, query[None], drive)
            retrieved.append(query_steps.nearest(vectors, query, self.candidates, among))
        if len(retrieved) == 1:
            return retrieved[0]
        rows = in_turns([rows for rows, _ in retrieved], self.candidates)
        return rows, scores_of_turns(self.candidates)[: len(rows)]

    def _localize(
        self,
        described: Described,
        among: Bool[np.ndarray, " rows"],
        size: tuple[int, int],
        reason: Reason | None,
        route: Route | None = None,
    ) -> Localization:
        """Localize a described image of (width, height) px among rows of the map, if no reason is against it."""
        (features, vector), end = described, len(among)
        if end and strength(features) < LEAST_STRENGTH * self._strengths[end] / end:
            reason = "too few features"
        rows, similarities = self._retrieve(vector, among, route)
        if reason is None and not len(rows):
            reason = "no candidates"
        if reason is not None:
            return Localization(Prediction(reason=reason, image_width=size[0]), described, None)
        candidates = self._read_features(rows.tolist())
        matches, scores = query_steps.match_and_score(
            features, candidates, self._matcher, self.system.scorers, self._typical
        )
        ranking = self._rank(rows, similarities, scores)
        best = matches[int(np.flatnonzero(rows == ranking.rows[0, 0])[0])]
        if reason := reason_against(best.mask.sum(), evidence_scores(best)[0], self._noise_score(end)):
            return Localization(Prediction(reason=reason, image_width=size[0]), described, None)
        p = math.nan if self.confidence is None else float(self.confidence(ranking)[0])
        alternatives = tuple(
            Alternative(row, *self._images[row], score=score)
            for row, score in zip(ranking.rows[0].tolist(), ranking.scores[0].tolist(), strict=True)
        )
        top, shift = alternatives[0], query_steps.shift_of(self.system.scorers.values(), best, size)
        confidence = None if math.isnan(p) else p  # without a finite score
        prediction = Prediction(top.place, alternatives, top.score, confidence, *shift, image_width=size[0])
        if self.threshold is not None and not p >= self.threshold:
            prediction = prediction.without_place("low confidence")
        return Localization(prediction, described, jax.tree.map(lambda leaf: leaf[0], best))

    def _noise_score(self, end: int, *, store: bool = False) -> float:
        """The best score of noise images; while a map grows, it changes when the number of rows has doubled.

        With `store`, while the lock is held, other processes need not compute it.
        """
        end = 1 << max(0, end.bit_length() - 1)
        part = f"noise score of {end} rows"
        if end not in self._noise_scores and (stored := self._file.part(part)):
            self._noise_scores[end] = float(stored)
        if end not in self._noise_scores:
            scores = [0.0]
            for image in noise_images(self.extractor.image_size):
                features, vector = self.describing.image(image)
                rows, _ = self._retrieve(vector, np.ones(end, bool), None)
                candidates = self._read_features(rows.tolist())
                pairs, _ = query_steps.match_and_score(features, candidates, self._matcher, {}, self._typical)
                scores += [float(evidence_scores(pair)[0]) for pair in pairs]
            self._noise_scores[end] = float(np.max(scores))
            if store:
                self._write({part: str(self._noise_scores[end]).encode()})
        return self._noise_scores[end]

    def _rank(self, rows: np.ndarray, similarities: np.ndarray, scores: Mapping[str, np.ndarray]) -> Ranked:
        """The ranking that decides; it compiles once, for `candidates` rows."""
        pad = lambda values, fill: np.pad(values, (0, self.candidates - len(values)), constant_values=fill)[None]  # noqa: E731
        shortlist = Shortlist(pad(rows, -1), pad(similarities, 0), pad(np.ones(len(rows), bool), False))
        padded_scores = {name: pad(values, np.nan) for name, values in scores.items()}
        [ranking] = rank_by_scores(shortlist, padded_scores, [self._final], self.system.ties).values()
        return Ranked(ranking.rows[:, : len(rows)], ranking.scores[:, : len(rows)])

    def __repr__(self) -> str:
        about = "" if self.confidence is None else ", calibrated"
        return f"Map({str(self.folder)!r}, {len(self)} images{about})"

    def __len__(self) -> int:
        """Number of images."""
        return len(self._images)

    @property
    def describing(self) -> Describing:
        """The extractor and the describer of the images; raises `InputError` if the map has no vocabulary yet."""
        if self._describing is None:
            raise InputError(f"{self.folder}: this map has no vocabulary yet; `learn` it from some images first")
        return self._describing

    @property
    def names(self) -> list[str]:
        """Names of the images, in the order of their rows."""
        return [*self._row_of_name]

    @property
    def there(self) -> Bool[np.ndarray, " rows"]:
        """Which rows have an image: all."""
        return np.ones(len(self), bool)

    def row(self, name: str) -> int | None:
        """Row of an image; None = the map has no image of this name."""
        return self._row_of_name.get(name)

    def place(self, row: int) -> Any:
        """Place of the image in a row."""
        return self._images[row][1]

    def refresh(self) -> int:
        """Read and count the images that were added since; an InputError for other settings, or a damaged map."""
        with self._lock:
            before = len(self)
            for part, now in () if self._is_checked else self._parts.items():
                stored = json.loads(self._file.part(part) or b"{}")
                if differing := " and ".join(name for name in stored if stored[name] != now.get(name)):
                    fix = "Use what it was made with (`mfvpr map info`), or name another folder"
                    raise InputError(f"{self.folder}: this map was made with other {differing}. {fix}.")
                self._is_checked = bool(stored)  # the last part is in every map
            if self._describing is None and (content := self._file.part("vocabulary")) is not None:
                arrays = unpack_arrays(content)
                vlad = Vlad(arrays["centers"], float(arrays["power"]))
                described = [each if isinstance(each, Extractor) else vlad for each in self._describers]
                self._describing = Describing(self.extractor, described)
            for entry, count, strength_sum in self._file.entries(before):
                if len(self) == len(self._vectors):
                    more = np.zeros((max(_FIRST_ROWS, len(self)), len(entry.vector)), np.float32)
                    self._vectors = np.concatenate([self._vectors.reshape(-1, len(entry.vector)), more])
                for part in self._slices:
                    self._vectors[len(self), part] = entry.vector[part] if entry.vector[part].any() else np.nan
                self._row_of_name[entry.name] = len(self)
                self._images.append((entry.name, entry.place))
                self._counts.append(count)
                self._strengths.append(self._strengths[-1] + strength_sum)
            return len(self) - before

    def learn(self, images: ImageFolder, *, cache: FeatureCache | None = None) -> None:
        """Learn the vocabulary from some images, unless the map has one; arguments and errors are those of `build`."""
        with self._lock:
            if self._describing is None:
                with self._learned(images, cache):
                    pass

    def build(
        self, images: ImageFolder, places: Sequence[Any] | None = None, *, cache: FeatureCache | None = None
    ) -> int:
        """Add the images whose names the map does not have yet; return how many were added.

        Args:
            images: to add. If the map needs a vocabulary and has none, it is learned from them first.
            places: of each image, JSON values; None = the names.
            cache: keeps the features, so that images that it knows are not described again. Without one, the folder
                takes twice the space until all images are added.

        Raises:
            InputError: an image cannot be read, another process adds, or the disk is full: what was added stays.
        """
        with self._lock:
            places = images.names if places is None else places
            if len(places) != len(images):
                raise InputError(f"expected a place of each of {len(images)} images, got {len(places)}")
            place_of = dict(zip(images.names, places, strict=True))
            for name, place in place_of.items():
                check_entry(name, place)
            self.refresh()
            if {*images.names} <= {*self._row_of_name}:  # also in a map that can only be read
                return 0
            with self._learned(images, cache) as cache:
                if not len(self):
                    self._write({"masks": json.dumps(images.masks is not None).encode()})
                before, names = len(self), tuple(name for name in images.names if name not in self._row_of_name)
                for batch in self.describing.folder(replace(images, names=names), cache):
                    entries = [Entry(names[row], place_of[names[row]], vector) for row, (_, vector) in batch.items()]
                    self._add(entries, [features for features, _ in batch.values()])
                self._noise_score(len(self), store=True)
                return len(self) - before

    def add(self, image: Image, place: Any, *, name: str | None = None, mask: Path | str | None = None) -> None:
        """Add an image and its place, any JSON value; an array needs a name, that of a file is its absolute path.

        For `mask`, see `localize_with_evidence`. Errors are those of `build`; also for a name that the map has, and for
        a map without its vocabulary.
        """
        with self._lock:
            if name is None:
                if not isinstance(image, str | os.PathLike):
                    raise InputError("name: expected one for an image that is no file")
                name = canonical_name(Path(image))
            self._warn_of_mask(mask)
            features, vector = self.describing.pixels(query_steps.load(image), mask)[0]
            self.add_described([Entry(name, place, vector)], [features])

    def add_described(self, entries: Sequence[Entry], features: Sequence[Features]) -> None:
        """Add images with features and global descriptors that `describing` has computed; errors are those of `add`."""
        with self._lock:
            for name, place, _ in entries:
                check_entry(name, place)
            self.describing  # noqa: B018  # raises without a vocabulary
            with self._file.lock():
                self.refresh()
                self._add(entries, features)

    def _add(self, entries: Sequence[Entry], features: Sequence[Features]) -> None:
        """Check and add images within the lock."""
        new_names, dimension = set[str](), self.extractor.scales[0].dimension
        length = self._vectors.shape[1] or np.size(entries[0].vector)
        for (name, _, vector), local in zip(entries, features, strict=True):
            values = np.asarray(vector)
            if values.shape != (length,) or values.dtype.kind not in "fiu" or not np.isfinite(values).all():
                got = f"{list(values.shape)} {values.dtype}"
                raise InputError(f"{name}: expected a descriptor [{length}] of finite numbers, got {got}")
            check_features(local, f"{name}: features", unit_length=False)
            if (got := np.shape(local.descriptors)[-1]) != dimension:
                raise InputError(f"{name}: expected features of {dimension} dimensions, got {got}")
            if name in self._row_of_name or name in new_names:
                raise InputError(f"{name}: the map has an image of this name; choose another")
            new_names.add(name)
        self._write({}, [*zip(features, entries, strict=True)])

    def _write(self, parts: dict[str, bytes], images: Sequence[tuple[Features, Entry]] = ()) -> None:
        """Write parts and images, and settings first if the map is new; the lock is held."""
        self.refresh()  # another process may have made the map meanwhile, with other settings
        new = {} if self._is_checked else {name: json.dumps(part).encode() for name, part in self._parts.items()}
        self._file.write(new | parts, images)
        self.refresh()

    @contextmanager
    def _learned(self, images: ImageFolder, cache: FeatureCache | None) -> Iterator[FeatureCache]:
        """Hold the lock, learn the vocabulary if it is missing, and yield a cache with its features."""
        temporary = self.folder / ".features"  # stays if the process is interrupted: the next one goes on with it
        with self._file.lock():
            self.refresh()
            cache = cache or FeatureCache(temporary, runtime=self._runtime)
            if self._describing is None and self._fitting is not None:
                vocabulary = self._fitting.fit(cache.local(images, self.extractor)[0])
                arrays = {"centers": vocabulary.centers, "power": np.array(vocabulary.power)}
                self._write({"vocabulary": pack_arrays(arrays)})
            yield cache
            shutil.rmtree(temporary, ignore_errors=True)

    def _read_features(self, rows: Sequence[int]) -> list[Features]:
        """Features `[n, ...]` of distinct rows, in their order, NumPy; the least recently used ones make room."""
        bytes_of = lambda features: sum(leaf.nbytes for leaf in jax.tree.leaves(features))  # noqa: E731
        for row, features in self._file.features([row for row in rows if row not in self._features]):
            self._features[row] = features
            self._free_bytes -= bytes_of(features)
        for row in rows:
            self._features.move_to_end(row)
        read = [self._features[row] for row in rows]
        while self._free_bytes < 0:
            self._free_bytes += bytes_of(self._features.popitem(last=False)[1])
        return read
