"""The map itself: what it is made with, what is added to it, and what it is asked."""

import itertools
import math
import operator
import shutil
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import wraps
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np

from mfvpr.datasets.datasets import ImageFolder
from mfvpr.evaluation.calibration import Confidence
from mfvpr.features.extractor import Aggregation, Extractor
from mfvpr.features.feature_set import FeatureSet, stacked
from mfvpr.features.vlad import Vlad, VladFitting
from mfvpr.localization.answers import Alternative, Answer, Asked, refusal
from mfvpr.localization.describing import Described, Describing, Image, is_file, local_features
from mfvpr.localization.evidence import LEAST_MATCHES, LEAST_STRENGTH, MapStrength, strength
from mfvpr.localization.matching import scored
from mfvpr.localization.resident import Resident
from mfvpr.localization.shifts import shift_of
from mfvpr.localization.vectors import Vectors
from mfvpr.matching.matcher import NEIGHBORS, Matcher
from mfvpr.reranking.results import Ranked
from mfvpr.scoring.histogram import HistogramOfShifts
from mfvpr.scoring.scorer import Scorer
from mfvpr.storage.disk import told
from mfvpr.storage.features import FeatureStore, open_store
from mfvpr.storage.maps import (
    MAP,
    Entry,
    MapRows,
    check_name,
    check_place,
    file_stamp,
    has_rows,
    hold_map,
    is_map_settled,
    settle_map,
)
from mfvpr.types import Features, Matches
from mfvpr.utils.arrays import read_arrays, write_arrays
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import canonical_name, clipped
from mfvpr.utils.fingerprints import fingerprint, recipe_of
from mfvpr.utils.progress import Track, untracked

_VOCABULARY = "vocabulary.npz"
_LEARNING = "learning"  # the folder of features that a vocabulary is being learned from
_NO_VOCABULARY = "{}: this map has no vocabulary yet; learn it from some images first (`learn`)"

Method = TypeVar("Method", bound=Callable[..., Any])


def _exclusive(method: Method) -> Method:
    """A method of `Map` that one thread at a time runs."""

    @wraps(method)
    def run(self: "Map", *arguments: Any, **options: Any) -> Any:
        with self._lock:
            return method(self, *arguments, **options)

    return run  # pyright: ignore[reportReturnType]  # of the same arguments


class Map:
    """Images with their places in a folder, which is asked with one image at a time.

        known = Map("map", Sift(), VladFitting())
        known.build(images, places)
        known.localize("query.jpg").place

    Any number of processes ask the same folder, while one adds to it: they see whole rows only. Any number of threads
    use the same `Map`, which serves one at a time; open another one to ask while `build` runs.
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
        candidates = _whole_number("candidates", candidates, least=1)
        if threshold is not None and confidence is None:
            raise InputError(f"threshold={threshold}: expected a confidence as well, which gives p(right)")
        self.folder = Path(folder).absolute()  # the working directory may change
        self.extractor, self.matcher, self.candidates = extractor, matcher, candidates
        self.scorer: Scorer = HistogramOfShifts() if scorer is None else scorer
        self.confidence, self.threshold = confidence, threshold
        self._fitting = describer if isinstance(describer, VladFitting) else None
        self._vectors, self._entries, self._rows, self._made = Vectors(), {}, {}, None
        self._resident_options = {"candidates": candidates, "memory": memory}
        self._settings = {"extractor": recipe_of(extractor), "describer": recipe_of(describer)}
        self._vocabulary_stamp = None  # of the file that was read
        self._is_settled = False  # whether they are known to be those of the folder
        self._lock = threading.RLock()
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
    @_exclusive
    def names(self) -> list[str]:
        """Of the images, in the order of their rows."""
        return [self._entries[row].name for row in sorted(self._entries)]

    @property
    @_exclusive
    def there(self) -> np.ndarray:
        """`[rows]` bool, which rows have an image: a process that was killed may have left some out."""
        found = np.zeros(self._vectors.total, bool)
        found[np.fromiter(self._entries, int, len(self))] = True
        return found

    def row(self, name: str) -> int | None:
        """Of an image; None = the map has none of this name."""
        return self._rows.get(name)

    def place(self, row: int) -> Any:
        """Of a row that has an image."""
        return self._entries[row].place

    @_exclusive
    def refresh(self) -> int:
        """Look for what others have added; how many there are.

        Raises:
            InputError: it was made with something else, is damaged, or was replaced since it was opened.
        """
        before = len(self)
        self._is_settled = self._is_settled or is_map_settled(self.folder, self._settings)
        if self._made is None:
            expects_vocabulary = has_rows(self.folder)  # looked at first: another process may be making the map
            if (self.folder / _VOCABULARY).exists():
                self._use(self._vocabulary())
            elif expects_vocabulary:
                raise InputError(f"{self.folder / _VOCABULARY}: expected the vocabulary of the rows, got none. Put it "
                                 "back.")  # fmt: skip
        elif self._fitting is not None and file_stamp(self.folder / _VOCABULARY) != self._vocabulary_stamp:
            raise InputError(f"{self.folder / _VOCABULARY}: expected the file that the map was opened with, got one "
                             "that replaced it, or none. Open the map again.")  # fmt: skip
        for row, entry in self._made.rows.new() if self._made else ():
            self._vectors.put(row, entry.vector)
            self._entries[row] = entry._replace(vector=None)
            self._rows[entry.name] = row
        return len(self) - before

    @_exclusive
    def learn(self, images: ImageFolder, *, track: Track = untracked) -> None:
        """Learn the vocabulary from some images, unless the map has one.

        Raises:
            InputError: images cannot be read, or have too few features, or another process adds.
        """
        if self._made is None:
            with hold_map(self.folder), self._learning(images, track):
                pass

    @_exclusive
    def build(self, images: ImageFolder, places: Sequence[Any] | None = None, *, track: Track = untracked) -> int:
        """Add images that are not there yet, by their names; how many were added.

        Args:
            images: of which the vocabulary is learned as well, where there is none; meanwhile the folder takes twice
                the space.
            places: of each, JSON values; None = the names.
            track: progress.

        Raises:
            InputError: an image cannot be read, another process adds, or the disk is full: what was added stays.
        """
        places = images.names if places is None else places
        if len(places) != len(images):
            raise InputError(f"expected a place of each of {len(images)} images, got {len(places)}")
        for name, place in zip(images.names, places, strict=True):
            check_name(name)
            check_place(name, place)
        with hold_map(self.folder), self._learning(images, track) as features, self._adding() as made:
            missing = [row for row, name in enumerate(images.names) if name not in self._rows]
            if features is None:
                batches = made.describing.folder(images, missing, track)
            else:
                batches = _aggregated(made.describing.describer, features, missing, self.extractor.batch_size)
            for batch in batches:
                made.rows.add([
                    (features, Entry(images.names[row], places[row], vector))
                    for row, (features, vector) in batch.items()
                ])  # fmt: skip
        self.refresh()
        return len(missing)

    @_exclusive
    def add(self, image: Image, place: Any, *, name: str | None = None) -> None:
        """Add one image.

        Args:
            image: as of `ask`.
            place: where it was taken, any JSON value.
            name: text; None = the file's absolute path, see `canonical_name`; an array needs one.

        Raises:
            InputError: as `build`; a name that is there; or a map whose vocabulary is not learned.
        """
        name = canonical_name(image) if name is None and is_file(image) else name
        if name is None:
            raise InputError("name: expected one for an image that is no file")
        features, vector = self.describing.image(image)
        self.add_described([Entry(name, place, vector)], [features])

    @_exclusive
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
        for name, place, _ in entries:
            check_name(name)
            check_place(name, place)
        with hold_map(self.folder), self._adding() as made:
            new, length = set[str](), self._vectors.length
            for name, _, vector in entries:
                length = np.size(vector) if length is None else length
                if np.shape(vector) != (length,):
                    raise InputError(f"{name}: expected a descriptor [{length}], got {list(np.shape(vector))}. Take it "
                                     "from `describing` of this map.")  # fmt: skip
                if name in self._rows or name in new:
                    raise InputError(f"{name}: the map has an image of this name; choose another")
                new.add(name)
            made.rows.add([*zip(features, entries, strict=True)])
        self.refresh()

    def localize(self, image: Image, *, recent: int = 0) -> Answer:
        """Where an image was taken; see `ask`."""
        return self.ask(image, recent=recent).answer

    @_exclusive
    def ask(self, image: Image, *, recent: int = 0, before: int | None = None) -> Asked:
        """Where an image was taken, and what that was found with.

        There is no place, and `reason` says why, for a query with too few features or matches
        (`mfvpr.localization.evidence`), without candidates, or with p(right) below the threshold.

        Args:
            image: a file, or `[H, W, 3]` uint8 RGB in any form that `np.asarray` converts.
            recent: so many of the newest rows are left out: of a drive that is being added, the same place.
            before: rows from this on are left out as well, as if the map ended there; None = none.

        Raises:
            InputError: the map is empty, the image cannot be read, or `recent` or `before` is no number of rows.
        """
        recent = _whole_number("recent", recent)
        before = None if before is None else _whole_number("before", before)
        self.refresh()
        if not len(self) or self._made is None:
            raise InputError(f"{self.folder}: expected a map with images, got an empty one; add some")
        features, vector = described = self._made.describing.image(image)
        total = self._vectors.total
        end = max(0, (total if before is None else min(before, total)) - recent)
        if strength(features) < LEAST_STRENGTH * self._made.strength(end):
            return refusal("too few features", described)
        rows, similarity = self._vectors.nearest(vector, self.candidates, before=end)
        if not len(rows):
            return refusal("no candidates", described)
        matches, scores = self._scored(self._made.resident, features, rows)
        order = np.argsort(-np.where(np.isnan(scores), -np.inf, scores), kind="stable")
        best = jax.tree.map(lambda leaf: leaf[order[0] : order[0] + 1], matches)
        if best.mask.sum() < LEAST_MATCHES:
            return refusal("too few matches", described)
        ranked, filtered = Ranked(rows[order][None], scores[order][None]), Ranked(rows[None], similarity[None])
        p = None if self.confidence is None else float(self.confidence(ranked, filtered)[0])
        p = None if p is None or math.isnan(p) else p  # of a score that is not finite nothing is known
        is_unsure = self.threshold is not None and not (p is not None and p >= self.threshold)
        found = tuple(Alternative(row, self._entries[row].name, self._entries[row].place, float(score))
                      for row, score in zip(rows[order].tolist(), scores[order], strict=True))  # fmt: skip
        answer = Answer(found[0].place, found, found[0].score, p, *shift_of(self.scorer, best))
        if is_unsure:
            answer = replace(answer, place=None, shift=None, shift_interval=None, scale=None, reason="low confidence")
        return Asked(answer, described, jax.tree.map(lambda leaf: leaf[0], best))

    def _scored(self, resident: Resident, features: Features, rows: np.ndarray) -> tuple[Matches, np.ndarray]:
        """Matches `[C, K, ...]` with all candidates, and the scores of those that there are."""
        arrays, slots = resident.hold(rows.tolist(), features, self._vectors.total)
        query = stacked([features], resident.capacity, total=1)
        matches, scores = scored(query, arrays, slots, self.candidates, self.matcher, self.scorer)
        return matches, scores[: len(rows)]

    @contextmanager
    def _learning(self, images: ImageFolder, track: Track) -> Iterator[FeatureStore | None]:
        """Learn the vocabulary, within `hold_map`; the images' features while they are there, None = it was learned."""
        self.refresh()
        if self._made is not None or self._fitting is None:
            yield None
            return
        folder = self.folder / _LEARNING
        shutil.rmtree(folder, ignore_errors=True)  # left by a process that was killed
        try:
            with open_store(folder, self._settings, num_images=len(images)) as store:
                features = enumerate(local_features(images, self.extractor, track))
                while batch := dict(itertools.islice(features, self.extractor.batch_size)):
                    store.write(batch)
            vocabulary = self._fitting.fit(FeatureSet(store, {}))
            settle_map(self.folder, self._settings)
            with told(self.folder, MAP.content):
                arrays = {"centers": vocabulary.centers, "power": np.array(vocabulary.power)}
                write_arrays(self.folder / _VOCABULARY, arrays, self._vocabulary_of())
            self._use(self._vocabulary())
            yield store
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    @contextmanager
    def _adding(self) -> Iterator["_Made"]:
        """What rows are made with, while nobody else adds any; what others added is known."""
        made = self._made
        if made is None:
            raise InputError(_NO_VOCABULARY.format(self.folder))
        self.refresh()  # first: nothing of this map goes into one that replaced it
        settle_map(self.folder, self._settings)
        with made.rows.adding():
            self.refresh()
            yield made

    def _use(self, describer: Extractor | Aggregation) -> None:
        describing = Describing(self.extractor, describer)
        rows = MapRows(self.folder, self._settings if self._fitting is None else describing.recipe)
        typical = self.extractor.scales[0].typical_count
        resident = Resident(rows, typical=typical, **self._resident_options)
        self._made = _Made(describing, rows, resident, MapStrength(rows))

    def _vocabulary(self) -> Vlad:
        path = self.folder / _VOCABULARY
        self._vocabulary_stamp = file_stamp(path)  # first: a file that replaces this one is noticed
        try:
            arrays = read_arrays(path, self._vocabulary_of())
        except InputError:
            raise InputError(
                f"{path}: expected the vocabulary that {self._fitting} learned from features of "
                f"{type(self.extractor).__name__} with these settings, got another or a damaged one. Use the extractor "
                "and the settings that the map was made with, or put a copy of the file back."
            ) from None
        return Vlad(arrays["centers"], float(arrays["power"]))

    def _vocabulary_of(self) -> str:
        """What the vocabulary is of: another's is refused."""
        return fingerprint({"extractor": self._settings["extractor"], "vocabulary": self._settings["describer"]})


def _whole_number(name: str, value: Any, least: int = 0) -> int:
    """An argument, which may be one of NumPy's numbers."""
    try:
        if (number := operator.index(value)) >= least:
            return number
    except TypeError:
        pass
    got = clipped(" ".join(repr(value).split()), 80)
    raise InputError(f"{name}: expected a whole number from {least}, got {got}. Use an `int`.")


def _aggregated(
    aggregation: Any, features: FeatureStore, rows: Sequence[int], size: int
) -> Iterator[dict[int, Described]]:
    """Features of some rows and their descriptors, by row, so many rows at a time."""
    for start in range(0, len(rows), size):
        images = dict(features.read(rows[start : start + size]))
        yield dict(zip(images, zip(images.values(), aggregation([*images.values()]), strict=True), strict=True))


class _Made(NamedTuple):
    """Parts of a map that need a describer: the description, rows on disk, rows on the device, and their strength."""

    describing: Describing
    rows: MapRows
    resident: Resident
    strength: MapStrength
