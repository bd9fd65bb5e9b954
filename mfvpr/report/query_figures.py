"""Figures of single images: of queries of an evaluation, and of an image that a map localized."""

from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import UInt8

from mfvpr.core.histogram import HistogramOfShifts
from mfvpr.datasets.ground_truth import threshold_words
from mfvpr.datasets.image_reading import read_image, resize
from mfvpr.evaluation.stages import explain
from mfvpr.localization.map import Map
from mfvpr.localization.predictions import Localization
from mfvpr.report.evaluations import EvaluationReport
from mfvpr.report.figures import ABOUT, Candidate, histogram_figure, pixel_aspect_of
from mfvpr.report.runs import Figure, file_names
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import clip_middle, path_inside, printable

_NAME_LENGTH = 40  # characters of an image's name in the title
_MAP_NAME_LENGTH = 80  # characters of a name or a place of a map
_GRAY = 150  # of an image that is not at hand


def query_figures(evaluation: EvaluationReport, shown: int | Sequence[int]) -> list[Figure]:
    """The paper's figure for a few queries, correct and incorrect ones, spread over each sequence.

    `shown` is a number of queries, or their rows.
    """
    several, folders = len(evaluation.sequences) > 1, file_names([sequence.name for sequence in evaluation.sequences])
    figures: list[Figure] = []
    for place, sequence in enumerate(evaluation.sequences):
        drawings = SequenceFigures(evaluation, place)
        folder = f"{folders[sequence.name]}/" if several else ""
        for query, verdict in drawings.verdicts(shown).items():
            draw = partial(drawings.draw, query=query, verdict=verdict)
            figures.append((f"{folder}{verdict}_{query:04d}.png", draw))
    return figures


class SequenceFigures:
    """The figures of one sequence."""

    def __init__(self, evaluation: EvaluationReport, place: int) -> None:
        """Take the parts of the sequence at a place, by the system that decides."""
        self._evaluation, self._sequence = evaluation, evaluation.sequences[place]
        self._matched, self._database = evaluation.ranked.matched[place], evaluation.ranked.dataset.database
        self._ranked = evaluation.ranked.systems[evaluation.headline][place]
        self._correct, self._positives = evaluation.is_correct(evaluation.headline, place), evaluation.positives[place]
        self._reasons = evaluation.by_sequence(evaluation.reasons(evaluation.headline))[place]

    def verdicts(self, selection: int | Sequence[int]) -> dict[int, str]:
        """Verdicts of queries that get a figure: the selected rows, or so many, half of them correct if known."""
        has_prediction = self._ranked.rows[:, 0] >= 0
        words = ["best"] if self._correct is None else ["correct", "incorrect"]
        is_first = np.ones(len(has_prediction), bool) if self._correct is None else self._correct[:, 0]
        verdicts = np.where(is_first, words[0], words[-1])
        if not isinstance(selection, int):
            return {query: str(verdicts[query]) for query in selection if has_prediction[query]}
        chosen: dict[int, str] = {}
        for word, numbers in zip(words, np.array_split(range(selection), len(words)), strict=True):
            queries = np.flatnonzero(has_prediction & (verdicts == word))
            spread = np.linspace(0, len(queries) - 1, min(len(numbers), len(queries))).round().astype(int)
            chosen |= dict.fromkeys(queries[spread].tolist(), word)
        return chosen

    def title(self, query: int, verdict: str) -> str:
        """The score, whether the prediction is correct within the threshold, and both names."""
        truth, headline = self._sequence.truth, self._evaluation.headline
        within = "" if truth is None else " at" + threshold_words(truth.unit, self._evaluation.threshold)
        names = f"{_short(self._sequence.images.names[query])} -> {_short(self._prediction(query))}"
        note = f" (no place: {reason})" if (reason := self._reasons[query]) else ""
        return f"{headline}, {verdict}{within}: {names}{note}"

    def draw(self, path: Path, query: int, verdict: str) -> None:
        """Draw the prediction, and below an incorrect one a correct one."""
        candidates = [self._candidate(query, 0, verdict)]
        candidates += self.correct_candidates(query) if verdict == "incorrect" else []
        values = self._evaluation.headline, self._sequence.name, verdict, self._sequence.images.names[query]
        about = dict(zip(ABOUT, (*values, self._prediction(query)), strict=True))
        original = self._sequence.images.read(query)
        image = self._resize(original)
        aspect = pixel_aspect_of(original, image)
        histogram_figure(path, image, candidates, title=self.title(query, verdict), pixel_aspect=aspect, about=about)

    def correct_candidates(self, query: int) -> list[Candidate]:
        """The first correct candidate, or the correct image that retrieval missed; empty if there is none."""
        truth = self._sequence.truth
        if self._correct is None or self._positives is None or truth is None or not self._positives.counts[query]:
            return []
        if self._correct[query].any():
            return [self._candidate(query, int(np.argmax(self._correct[query])), "correct")]
        nearest, rows = truth.place(query), self._positives.of(query)
        row = nearest if nearest is not None and nearest in rows else int(rows[0])
        num_candidates = self._matched.candidates.indices.shape[1]
        return [self._shown(row, "correct", f"not among the {num_candidates} candidates")]

    def _prediction(self, query: int) -> str:
        return self._database.names[self._ranked.rows[query, 0]]

    def _candidate(self, query: int, rank: int, verdict: str) -> Candidate:
        """The candidate at a rank from 0."""
        row, score = int(self._ranked.rows[query, rank]), self._ranked.scores[query, rank]
        place = int(np.flatnonzero(self._matched.candidates.indices[query] == row)[0])
        pair = jax.tree.map(lambda values: values[place], self._matched.matches[0][query])
        explanation = explain(self._evaluation.histogram or HistogramOfShifts(), pair)
        return self._shown(row, verdict, f"rank {rank + 1}, score {score:.5g}", pair, explanation)

    def _shown(self, row: int, verdict: str, words: str, *matched: Any) -> Candidate:
        caption = f"{verdict}: {_short(self._database.names[row])}, {words}"
        return Candidate(self._resize(self._database.read(row)), caption, *matched)

    def _resize(self, image: np.ndarray) -> np.ndarray:
        extractor = self._evaluation.ranked.system.pipeline.extractor
        size = extractor.image_size
        return image if size is None else resize(image, size, extractor.interpolation)


def localization_figure(
    path: Path,
    known: Map,
    name: str,
    image: UInt8[np.ndarray, "height width 3"],
    localization: Localization,
    *,
    root: Path | None = None,
) -> None:
    """Write the figure of one prediction: the image beside the best candidate, their matches, the histogram of shifts.

    `image` is RGB. `root` is the folder of the map's images, by their names; an image that cannot be read is drawn
    gray, as are all without a folder. An InputError if the candidate's name leads out of the folder.
    """
    prediction, extractor = localization.prediction, known.extractor
    width, height = extractor.image_size
    candidate = Candidate(np.full((height, width, 3), _GRAY, np.uint8), "no candidate")
    if localization.matches is not None:
        best = prediction.alternatives[0].name
        shown, note = candidate.image, " (its image is not at hand)"
        if root is not None:
            file = path_inside(root, best)
            with suppress(InputError):  # the map keeps features, not images
                shown, note = resize(read_image(file), extractor.image_size, extractor.interpolation), ""
        scorers = known.system.scorers.values()
        histogram = next((scorer for scorer in scorers if isinstance(scorer, HistogramOfShifts)), HistogramOfShifts())
        p = "" if prediction.confidence is None else f", confidence {prediction.confidence:.2f}"
        caption = f"{clip_middle(best, _MAP_NAME_LENGTH)}{note}, score {prediction.score:.5g}{p}"
        candidate = Candidate(shown, caption, localization.matches, explain(histogram, localization.matches))
    query = resize(image, extractor.image_size, extractor.interpolation)
    place = f"no place ({prediction.reason})" if prediction.place is None else str(prediction.place)
    title = f"{clip_middle(name, _MAP_NAME_LENGTH)} -> {clip_middle(place, _MAP_NAME_LENGTH)}"
    about = {"image": name, "place": str(prediction.place)}
    histogram_figure(path, query, [candidate], title=title, pixel_aspect=pixel_aspect_of(image, query), about=about)


def _short(name: str) -> str:
    return clip_middle(printable(name), _NAME_LENGTH)
