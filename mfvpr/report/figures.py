"""Figures of images: a pair beside its histogram of shifts, for queries and localized images; contact sheets."""

import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Shaped, UInt8
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure as Canvas
from matplotlib.image import AxesImage
from matplotlib.patches import Rectangle
from PIL import Image

from mfvpr.core.histogram import HistogramOfShifts
from mfvpr.core.types import Matches
from mfvpr.datasets.datasets import Dataset, ImageFolder
from mfvpr.datasets.ground_truth import threshold_words
from mfvpr.datasets.image_reading import read_image, resize
from mfvpr.evaluation.stages import Explanation, explain
from mfvpr.localization.map import Map
from mfvpr.localization.predictions import Localization
from mfvpr.report.evaluations import EvaluationReport
from mfvpr.report.runs import Figure
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import clip_middle, path_inside, printable, replacing, require_replaceable

ABOUT: tuple[str, ...] = ("system", "sequence", "outcome", "query", "prediction")  # keywords in the file of a figure
REFUSED = "refused"  # the outcome of a query with a first candidate, but no place
_AGREES, _DIFFERS = "#2fa8ff", "#ff9a1f"  # which color-blind people can distinguish
_SOFTWARE = b"mfvpr.report"  # at the start of every PNG file
_MATCHES = 30  # drawn, the heaviest, as in the paper
_GAP = 12  # px between the two images
_GRAY = 150  # of an image that is not at hand
_TITLE_LENGTH, _CAPTION_LENGTH, _NAME_LENGTH = 140, 100, 48  # characters that fit; of an image's name in a title
_PAIRS = 12  # of a contact sheet; at least two of each sequence
_SIDE = 320  # px of the longer side of an image on the sheet


def panels(number: int, width: float, height: float, columns: int = 4, **options: Any) -> tuple[Canvas, list[Axes]]:
    """Make a figure of panels, each of `width` x `height` inches, in rows of at most `columns`.

    `options` go to `Figure.subplots`.
    """
    columns = min(columns, number)
    rows = -(-number // columns)
    figure = Canvas(figsize=(width * columns, height * rows), layout="constrained")
    FigureCanvasAgg(figure)
    axes = [*figure.subplots(rows, columns, squeeze=False, **options).flat]
    for unused in axes[number:]:
        unused.set_axis_off()
    return figure, axes[:number]


def save_figure(figure: Canvas, path: Path, *, dpi: int = 110, **options: Any) -> None:
    """Write an image file; `options` go to `Figure.savefig`. Of existing files, only a PNG from here is replaced."""
    is_png = path.suffix == ".png"
    require_replaceable(path, _SOFTWARE if is_png else None)
    if is_png:
        options["metadata"] = {"Software": _SOFTWARE.decode(), **options.get("metadata", {})}
    with replacing(path) as temporary, warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing")  # names in scripts that the font lacks
        figure.savefig(temporary, dpi=dpi, **options)


@dataclass(frozen=True)
class Candidate:
    """A database image beside the query."""

    image: UInt8[np.ndarray, "height width 3"]  # at the size that the points refer to
    caption: str
    matches: Matches | None = None  # [K, ...] of this pair (NumPy); None if the image was not matched
    explanation: Explanation | None = None  # of the matches


def histogram_figure(
    path: Path,
    query_image: UInt8[np.ndarray, "height width 3"],
    candidates: Sequence[Candidate],
    *,
    title: str,
    original: Shaped[np.ndarray, "_ _ 3"],
    about: Mapping[str, str] | None = None,
) -> None:
    """Write the figure of one query, with candidates one below the other, their histograms in the same colors.

    The query's image has the size that the points refer to. Images are drawn in the shape of the `original`, which has
    square pixels. `about` is text by keyword in the file, for programs.
    """
    (height, width, _), shown, count = original.shape, query_image.shape, len(candidates)
    figure, axes = panels(2 * count, 6, 4.8 + 0.2 / count, columns=2, width_ratios=(2, 1.15))
    # A file's name may hold a $.
    figure.suptitle(clip_middle(printable(title), _TITLE_LENGTH), fontsize=11, parse_math=False)
    top = max([1e-9, *(float(candidate.explanation.score) for candidate in candidates if candidate.explanation)])
    for pair, heat, candidate in zip(axes[::2], axes[1::2], candidates, strict=True):
        _draw_pair(pair, query_image, candidate)
        pair.set_aspect((height / shown[0]) / (width / shown[1]))  # of a pixel
        if candidate.explanation is None:
            heat.set_axis_off()
        else:
            figure.colorbar(_draw_histogram(heat, candidate.explanation, top), ax=heat, label="bin score", shrink=0.8)
    metadata = {keyword: printable(text) for keyword, text in (about or {}).items()}
    save_figure(figure, path, bbox_inches="tight", pad_inches=0.15, metadata=metadata)


def _draw_pair(axes: Axes, query: np.ndarray, candidate: Candidate) -> None:
    """Draw query and candidate side by side, with the heaviest matches."""
    offset, image, words = query.shape[1] + _GAP, candidate.image, "query | candidate"
    canvas = np.full((max(len(query), len(image)), offset + image.shape[1], 3), 255, np.uint8)
    canvas[: len(query), : query.shape[1]] = query
    canvas[: len(image), offset:] = image
    axes.imshow(canvas)
    axes.set_axis_off()
    matches, explanation = candidate.matches, candidate.explanation
    if matches is not None and explanation is not None:
        count = int(matches.mask.sum())
        weights = np.where(matches.mask, explanation.weights, -np.inf)
        heaviest = np.lexsort((matches.distance, -weights))[: min(_MATCHES, count)]  # of equal weights the nearest
        start, end = matches.points0[heaviest], matches.points1[heaviest] + [offset, 0]
        colors = np.where(explanation.agrees[heaviest], _AGREES, _DIFFERS)
        axes.add_collection(LineCollection([*zip(start, end, strict=True)], colors=colors, linewidths=0.8, alpha=0.9))
        for points in (start, end):
            axes.scatter(points[:, 0], points[:, 1], s=7, c=colors, linewidths=0)
        drawn, agree = explanation.agrees[heaviest].sum(), explanation.agrees.sum()
        words += f"; blue matches agree with the peak: {drawn} of {len(heaviest)} drawn, {agree} of {count}"
    caption = clip_middle(printable(candidate.caption), _CAPTION_LENGTH)
    axes.set_title(f"{caption}\n{words}", fontsize=9, parse_math=False)


def _draw_histogram(axes: Axes, explanation: Explanation, top: float) -> AxesImage:
    scores, centers_x, centers_y = explanation.histogram
    half = float(centers_x[1] - centers_x[0]) / 2
    inside = scores > -np.inf
    rows, columns = inside.any(axis=1), inside.any(axis=0)
    scores, centers_x, centers_y = scores[rows][:, columns], centers_x[columns], centers_y[rows]
    extent = (centers_x[0] - half, centers_x[-1] + half, centers_y[-1] + half, centers_y[0] - half)
    image = axes.imshow(scores, extent=extent, cmap="magma", interpolation="nearest", vmin=0, vmax=top)
    direction = explanation.direction.replace("_", " ")
    axes.set_xlabel(f"shift x, px ({direction})\nsquare: tallest bin, cross: refined peak", fontsize=8)
    axes.set_ylabel("shift y, px")
    if explanation.score > 0:
        corner, (x, y) = explanation.shift - half, explanation.peak
        axes.add_patch(Rectangle(corner, 2 * half, 2 * half, fill=False, edgecolor="cyan", linewidth=1.4))
        axes.plot(x, y, marker="+", color="cyan", markersize=8)
        axes.set_title(f"histogram of shifts: score {explanation.score:.4g}, peak at ({x:.1f}, {y:.1f}) px", fontsize=9)
    else:
        axes.set_title("histogram of shifts: no votes", fontsize=9)
    return image


def query_figures(report: EvaluationReport, shown: int | Sequence[int]) -> list[Figure]:
    """The paper's figure for so many queries of each sequence, correct and incorrect ones, or for the rows `shown`."""
    figures: list[Figure] = []
    for place in range(len(report.sequences)):
        drawings, folder = SequenceFigures(report, place), report.folder(Path(), place).name
        for query, outcome in drawings.outcomes(shown).items():
            name = (Path(folder) / f"{outcome}_{query:04d}.png").as_posix()
            figures.append((name, partial(drawings.draw, query=query, outcome=outcome)))
    return figures


class SequenceFigures:
    """The figures of one sequence."""

    def __init__(self, report: EvaluationReport, place: int) -> None:
        """Take the parts of the sequence at a place, by the system that decides."""
        headline, part, positives = report.headline, report.parts[place], report.positives
        self._report, self._sequence = report, report.sequences[place]
        self._matched, self._database = report.ranked.matched[place], report.ranked.dataset.database
        self._ranked, self._reasons = report.ranked.systems[headline][place], report.reasons(headline)[part]
        self._correct = None if positives is None else report.correct[headline][part]
        self._positives = None if positives is None else positives.take(part)

    def outcomes(self, selection: int | Sequence[int]) -> dict[int, str]:
        """Outcomes of queries that get a figure: the selected rows, or so many, half of them correct if known.

        Halves are by the first candidate, also of a query that is refused.
        """
        words = ["best"] if self._correct is None else ["correct", "incorrect"]
        by_candidate = np.where(True if self._correct is None else self._correct[:, 0], words[0], words[-1])
        outcomes = np.where(self._ranked.rows[:, 0] >= 0, by_candidate, "")  # "": without a candidate
        if isinstance(selection, int):
            chosen, numbers = list[int](), np.array_split(range(selection), len(words))
            for word, part in zip(words, numbers, strict=True):
                queries = np.flatnonzero(outcomes == word)
                spread = np.linspace(0, len(queries) - 1, min(len(part), len(queries))).round().astype(int)
                chosen += queries[spread].tolist()
        else:
            chosen = [query for query in selection if outcomes[query]]
        return {query: REFUSED if self._reasons[query] else str(outcomes[query]) for query in chosen}

    def draw(self, path: Path, query: int, outcome: str) -> None:
        """Draw the first candidate, and below an incorrect one a correct one."""
        is_incorrect = self._correct is not None and not self._correct[query, 0]
        candidates = [self._candidate(query, 0, outcome)]
        candidates += self.correct_candidates(query) if is_incorrect else []
        sequence, headline, truth = self._sequence, self._report.headline, self._sequence.truth
        name, prediction = sequence.images.names[query], self._database.names[self._ranked.rows[query, 0]]
        words = "" if truth is None else " at" + threshold_words(truth.unit, self._report.threshold)
        words = f" ({self._reasons[query]})" if outcome == REFUSED else words
        title = f"{headline}, {outcome}{words}: {_short(name)} -> {_short(prediction)}"
        about = dict(zip(ABOUT, (headline, sequence.name, outcome, name, prediction), strict=True))
        original = sequence.images.read(query)
        histogram_figure(path, self._resize(original), candidates, title=title, original=original, about=about)

    def correct_candidates(self, query: int) -> list[Candidate]:
        """The first correct candidate, or the correct image that retrieval missed; empty if there is none."""
        truth = self._sequence.truth
        if self._correct is None or self._positives is None or truth is None or not self._positives.counts[query]:
            return []
        if self._correct[query].any():
            return [self._candidate(query, int(np.argmax(self._correct[query])), "correct")]
        nearest, rows = truth.place(query), self._positives.of(query)
        row = nearest if nearest is not None and nearest in rows else int(rows[0])
        return [self._shown(row, "correct", f"not among the {self._ranked.rows.shape[1]} candidates")]

    def _candidate(self, query: int, rank: int, outcome: str) -> Candidate:
        """The candidate at a rank from 0."""
        row, score = int(self._ranked.rows[query, rank]), self._ranked.scores[query, rank]
        place = int(np.flatnonzero(self._matched.candidates.indices[query] == row)[0])
        pair = jax.tree.map(lambda values: values[place], self._matched.matches[0][query])
        explanation = explain(self._report.histogram or HistogramOfShifts(), pair)
        return self._shown(row, outcome, f"rank {rank + 1}, score {score:.5g}", pair, explanation)

    def _shown(self, row: int, outcome: str, words: str, *matched: Any) -> Candidate:
        caption = f"{outcome}: {_short(self._database.names[row])}, {words}"
        return Candidate(self._resize(self._database.read(row)), caption, *matched)

    def _resize(self, image: np.ndarray) -> np.ndarray:
        extractor = self._report.ranked.system.pipeline.extractor
        return image if extractor.image_size is None else resize(image, extractor.image_size, extractor.interpolation)


def _short(name: str) -> str:
    return clip_middle(printable(name), _NAME_LENGTH)


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
    prediction, matches = localization.prediction, localization.matches
    size, interpolation = known.extractor.image_size, known.extractor.interpolation
    candidate = Candidate(np.full((size[1], size[0], 3), _GRAY, np.uint8), "no candidate")
    if matches is not None:
        best = prediction.alternatives[0].name
        shown, note = candidate.image, " (its image is not at hand)"
        if root is not None:
            file = path_inside(root, best)
            with suppress(InputError):  # the map keeps features, not images
                shown, note = resize(read_image(file), size, interpolation), ""
        scorers = known.system.scorers.values()
        histogram = next((scorer for scorer in scorers if isinstance(scorer, HistogramOfShifts)), HistogramOfShifts())
        p = "" if prediction.confidence is None else f", confidence {prediction.confidence:.2f}"
        caption = f"{_short(best)}{note}, score {prediction.score:.5g}{p}"
        candidate = Candidate(shown, caption, matches, explain(histogram, matches))
    query = resize(image, size, interpolation)
    place = f"no place ({prediction.reason})" if prediction.place is None else str(prediction.place)
    title, about = f"{_short(name)} -> {_short(place)}", {"image": name, "place": str(prediction.place)}
    histogram_figure(path, query, [candidate], title=title, original=image, about=about)


def contact_sheet(path: Path, dataset: Dataset) -> None:
    """Write a figure of pairs, evenly spread over each sequence: a query, and the place that the ground truth names."""
    each, cells = max(2, -(-_PAIRS // len(dataset.sequences))), list[tuple[ImageFolder, int] | None]()
    for sequence in dataset.sequences:
        for query in np.unique(np.linspace(0, len(sequence.images) - 1, each).round().astype(int)).tolist():
            place = None if sequence.truth is None else sequence.truth.place(query)
            cells += [(sequence.images, query), None if place is None else (dataset.database, place)]
    figure, axes = panels(len(cells), 3.2, 2.6)
    figure.suptitle(f"{dataset.name}: query | the place that the ground truth names", fontsize=11, parse_math=False)
    for panel, cell in zip(axes, cells, strict=True):
        panel.set_axis_off()
        if cell is None:
            panel.text(0.5, 0.5, "no place", ha="center")
            continue
        folder, row = cell
        panel.set_title(_short(f"{folder.root.name}/{folder.names[row]}"), fontsize=7, parse_math=False)
        try:
            image = Image.fromarray(folder.read(row))
            image.thumbnail((_SIDE, _SIDE))
            panel.imshow(image)
        except InputError:
            panel.text(0.5, 0.5, "cannot be read", ha="center")
    save_figure(figure, path, dpi=80)
