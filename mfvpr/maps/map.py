"""The map itself: what it is made with, what is added to it, and what it is asked."""

import json
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from mfvpr.confidence import Confidence
from mfvpr.data.arrays import read_arrays, write_arrays
from mfvpr.data.datasets import ImageFolder
from mfvpr.errors import InputError
from mfvpr.features import Aggregation, Extractor
from mfvpr.features.vlad import Vlad, VladFitting
from mfvpr.fingerprints import fingerprint, recipe_of
from mfvpr.maps.answers import Alternative, Answer, pair_of
from mfvpr.maps.describing import Describing, Image, local_features
from mfvpr.maps.resident import Resident
from mfvpr.maps.vectors import Vectors
from mfvpr.matchers import NEIGHBORS, Matcher, match_pairs
from mfvpr.pipeline import pair_shifts
from mfvpr.progress import Track, untracked
from mfvpr.reranking import BIN_STEP, score_candidates
from mfvpr.results import Ranked
from mfvpr.scoring import HistogramOfShifts, Scorer
from mfvpr.scoring.parameters import fit
from mfvpr.sources import FeatureSet, stacked
from mfvpr.stores.maps import Entry, MapRows
from mfvpr.types import Features, Matches

_VOCABULARY = "vocabulary.npz"
_NO_VOCABULARY = "{}: this map has no vocabulary yet; learn it from some images first (`learn`)"


class Map:
    """Images with their places in a folder, which is asked with one image at a time.

        known = Map("map", Sift(), VladFitting())
        known.build(images, places)
        known.localize("query.jpg").place

    Any number of processes ask the same folder, while one adds to it: they see whole rows only.
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
        """The map in a folder, which is made when the first image is added.

        Args:
            folder: of the map.
            extractor: takes local features, of one scale.
            describer: gives global descriptors: the same extractor, another one, an aggregation of the local features,
                or `VladFitting`, whose vocabulary is learned once (`learn`, or `build`) and kept in the folder.
            scorer: None = the histogram of shifts.
            matcher: of a pair.
            candidates: that are matched, those whose descriptors are most similar.
            confidence: gives p(right), as an evaluation with the same settings left it; None = no p.
            threshold: of p, below which there is no place.
            memory: GB that features may take on the device; None = a third of what is free.

        Raises:
            InputError: features of several scales, a threshold without a confidence, or a folder with a map that was
                made with something else.
        """
        if len(extractor.scales) != 1:
            raise InputError(f"{type(extractor).__name__}: a map takes local features of one scale, "
                             f"got {len(extractor.scales)}")  # fmt: skip
        if candidates < 1:
            raise InputError(f"candidates={candidates}: expected at least 1")
        if threshold is not None and confidence is None:
            raise InputError(f"threshold={threshold}: expected a confidence as well, which gives p(right)")
        self.folder, self.extractor, self.matcher, self.candidates = Path(folder), extractor, matcher, candidates
        self.scorer: Scorer = HistogramOfShifts() if scorer is None else scorer
        self.confidence, self.threshold = confidence, threshold
        self._fitting = describer if isinstance(describer, VladFitting) else None
        self._vectors, self._entries, self._made = Vectors(), {}, None
        self._resident_options = {"candidates": candidates, "memory": memory}
        if not isinstance(describer, VladFitting):
            self._use(describer)
        self.refresh()

    def __len__(self) -> int:
        """Images that are known."""
        return len(self._entries)

    @property
    def describing(self) -> Describing:
        """What describes images.

        Raises:
            InputError: the map has no vocabulary yet.
        """
        if self._made is None:
            raise InputError(_NO_VOCABULARY.format(self.folder))
        return self._made.describing

    @property
    def names(self) -> list[str]:
        """Of the images, in the order of their rows."""
        return [self._entries[row].name for row in sorted(self._entries)]

    def refresh(self) -> int:
        """Look for what others have added; how many there are.

        Raises:
            InputError: it was made with something else, or is damaged.
        """
        before = len(self)
        if self._made is None and (self.folder / _VOCABULARY).exists():
            self._use(self._vocabulary())
        for row, entry in self._made.rows.new() if self._made else ():
            self._vectors.put(row, entry.vector)
            self._entries[row] = entry._replace(vector=None)
        return len(self) - before

    def learn(self, images: ImageFolder, *, track: Track = untracked) -> None:
        """Learn the vocabulary from some images, unless the map has one.

        Raises:
            InputError: images cannot be read, or have too few features.
        """
        if self._made is not None or self._fitting is None:
            return
        features = FeatureSet.of([*local_features(images, self.extractor, track)], unit_length=False)
        learned = self._fitting.fit(features)
        self.folder.mkdir(parents=True, exist_ok=True)
        arrays = {"centers": learned.centers, "power": np.array(learned.power)}
        write_arrays(self.folder / _VOCABULARY, arrays, self._vocabulary_of())
        self._use(self._vocabulary())

    def build(self, images: ImageFolder, places: Sequence[Any] | None = None, *, track: Track = untracked) -> int:
        """Add images that are not there yet, by their names; how many were added.

        Args:
            images: of which the vocabulary is learned as well, where there is none.
            places: of each, JSON values; None = the names.
            track: progress.

        Raises:
            InputError: an image cannot be read, another process adds, or the disk is full: what was added stays.
        """
        places = images.names if places is None else places
        if len(places) != len(images):
            raise InputError(f"expected a place of each of {len(images)} images, got {len(places)}")
        for name, place in zip(images.names, places, strict=True):
            _check_place(name, place)
        self.learn(images, track=track)
        with self._adding() as made:
            known = {*self.names}
            missing = [row for row, name in enumerate(images.names) if name not in known]
            for batch in made.describing.folder(images, missing, track):
                made.rows.add([
                    (features, Entry(images.names[row], places[row], vector))
                    for row, (features, vector) in batch.items()
                ])  # fmt: skip
        self.refresh()
        return len(missing)

    def add(self, image: Image, place: Any, *, name: str | None = None) -> None:
        """Add one image.

        Args:
            image: a file, or `[H, W, 3]` uint8 RGB.
            place: where it was taken, any JSON value.
            name: None = the file's; an array needs one.

        Raises:
            InputError: as `build`; a name that is there; or a map whose vocabulary is not learned.
        """
        name = str(image) if name is None and not isinstance(image, np.ndarray) else name
        if name is None:
            raise InputError("name: expected one for an image that is no file")
        features, vector = self.describing.image(image)
        self.add_described([Entry(name, place, vector)], [features])

    def add_described(self, entries: Sequence[Entry], features: Sequence[Features]) -> None:
        """Add images that are described already, as `describing` does it.

        Args:
            entries: names, places and descriptors.
            features: local ones, as a store gives them back.

        Raises:
            InputError: as `add`.
        """
        if len(entries) != len(features):
            raise InputError(f"expected features of each of {len(entries)} images, got {len(features)}")
        with self._adding() as made:
            known = {*self.names}
            for name, place, _ in entries:
                _check_place(name, place)
                if name in known:
                    raise InputError(f"{name}: the map has an image of this name; choose another")
                known.add(name)
            made.rows.add([*zip(features, entries, strict=True)])
        self.refresh()

    def localize(self, image: Image, *, recent: int = 0) -> Answer:
        """Where an image was taken.

        Args:
            image: a file, or `[H, W, 3]` uint8 RGB.
            recent: so many of the newest rows are left out: of a drive that is being added, the same place.

        Raises:
            InputError: the map is empty, or the image cannot be read.
        """
        self.refresh()
        if not len(self) or self._made is None:
            raise InputError(f"{self.folder}: expected a map with images, got an empty one; add some")
        features, vector = self._made.describing.image(image)
        total = max(self._entries) + 1
        rows, similarity = self._vectors.nearest(vector, self.candidates, before=total - recent)
        if not len(rows):
            return Answer(None, (), 0.0, None, None, None, None)
        matches = self._matched(self._made.resident, features, rows, total)
        scores = np.asarray(score_candidates(self.scorer, matches))[: len(rows)]
        order = np.argsort(-np.where(np.isnan(scores), -np.inf, scores), kind="stable")
        ranked, filtered = Ranked(rows[order][None], scores[order][None]), Ranked(rows[None], similarity[None])
        p = None if self.confidence is None else float(self.confidence(ranked, filtered)[0])
        p = None if p is None or math.isnan(p) else p  # of a score that is not finite nothing is known
        refused = self.threshold is not None and not (p is not None and p >= self.threshold)
        found = tuple(self._alternative(int(rows[one]), float(scores[one])) for one in order)
        place = None if refused else found[0].place
        return Answer(place, found, found[0].score, p, *self._shift(matches, int(order[0])))

    def _alternative(self, row: int, score: float) -> Alternative:
        return Alternative(row, self._entries[row].name, self._entries[row].place, score)

    def _matched(self, resident: Resident, features: Features, rows: np.ndarray, total: int) -> Matches:
        """Matches `[C, K, ...]` with all candidates; those that there are not have none."""
        arrays, slots = resident.hold(rows.tolist(), features, total)
        query = stacked([features], resident.capacity, total=1)
        pairs = np.zeros((self.candidates, 2), np.int32)
        pairs[: len(slots), 1] = slots
        return match_pairs(query, arrays, pairs, np.int32(len(slots)), self.matcher)

    def _shift(self, matches: Matches, best: int) -> tuple[Any, Any, Any]:
        """Shift, interval and scale of a candidate."""
        if not isinstance(self.scorer, HistogramOfShifts):
            return None, None, None
        one = jax.tree.map(lambda leaf: leaf[best : best + 1], matches)
        fitted = fit(self.scorer, one.image_size0, one.image_size1, multiple=BIN_STEP)
        shift, interval, scale = (np.asarray(values)[0] for values in pair_shifts(fitted, one))
        ends = pair_of(interval[0]), pair_of(interval[1])
        return pair_of(shift), ends if None not in ends else None, float(scale) if np.isfinite(scale) else None

    @contextmanager
    def _adding(self) -> Iterator["_Made"]:
        """What rows are made with, while nobody else adds any; what others added is known."""
        made = self._made
        if made is None:
            raise InputError(_NO_VOCABULARY.format(self.folder))
        with made.rows.adding():
            self.refresh()
            yield made

    def _use(self, describer: Extractor | Aggregation) -> None:
        describing = Describing(self.extractor, describer)
        rows = MapRows(self.folder, describing.recipe)
        typical = self.extractor.scales[0].typical_count
        self._made = _Made(describing, rows, Resident(rows, typical=typical, **self._resident_options))

    def _vocabulary(self) -> Vlad:
        kept = read_arrays(self.folder / _VOCABULARY, self._vocabulary_of())
        return Vlad(kept["centers"], float(kept["power"]))

    def _vocabulary_of(self) -> str:
        """What the vocabulary is of: another's is refused."""
        return fingerprint({"extractor": recipe_of(self.extractor), "vocabulary": recipe_of(self._fitting)})


def _check_place(name: str, place: Any) -> None:
    """None would be no place; what JSON cannot say cannot be kept."""
    try:
        if place is None:
            raise ValueError("None")
        json.dumps(place, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: expected a place that JSON can say, and not null, got {error}") from None


class _Made(NamedTuple):
    """What needs a describer: how images are described, the rows on disk, and those on the device."""

    describing: Describing
    rows: MapRows
    resident: Resident
