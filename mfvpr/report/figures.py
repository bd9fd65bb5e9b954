"""Figures of images: the paper's histogram figure, which has a pair beside its shifts; contact sheets of data sets."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Shaped, UInt8
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.image import AxesImage
from matplotlib.patches import Rectangle

from mfvpr.core.types import Matches
from mfvpr.datasets.datasets import Dataset, ImageFolder
from mfvpr.datasets.image_reading import resize
from mfvpr.evaluation.stages import Explanation
from mfvpr.report.plots import panels, save_figure
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import clip_middle, printable

ABOUT: tuple[str, ...] = ("system", "sequence", "outcome", "query", "prediction")  # keywords in the file of a figure
_AGREES, _DIFFERS = "#2fa8ff", "#ff9a1f"  # told apart by color-blind people as well
_MATCHES = 30  # drawn, the heaviest, as in the paper
_GAP = 12  # px between the two images
_TITLE_LENGTH, _CAPTION_LENGTH = 140, 100  # characters that fit
_PAIRS, _PAIRS_IN_A_ROW = 12, 2  # of a contact sheet; at least two of each sequence
_SIDE, _WIDTH = 320, 3.2  # of an image on the sheet: px of the longer side, inches
_SHEET_CAPTION_LENGTH = 44  # characters

LabeledImage = tuple[np.ndarray | None, str]  # pixels, None if they cannot be read, and a caption


@dataclass(frozen=True)
class Candidate:
    """A database image beside the query, at the size that the points refer to, and its caption.

    `matches` are of this pair, `[K, ...]`, NumPy; `explanation` is of the matches, see
    `mfvpr.evaluation.stages.explain`. Both are None where the image was not matched.
    """

    image: UInt8[np.ndarray, "height width 3"]
    caption: str
    matches: Matches | None = None
    explanation: Explanation | None = None


def histogram_figure(
    path: Path,
    query_image: UInt8[np.ndarray, "height width 3"],
    candidates: Sequence[Candidate],
    *,
    title: str,
    pixel_aspect: float = 1.0,
    about: Mapping[str, str] | None = None,
) -> None:
    """Write the figure of one query, with candidates one below the other, their histograms in the same colors.

    The query's image has the size that the points refer to. `pixel_aspect` is the height of a pixel by its width, so
    that images are drawn in the shape that they were taken in. `about` is text by keyword in the file, for programs.
    """
    count = len(candidates)
    figure, axes = panels(2 * count, 6, 4.8 + 0.2 / count, columns=2, width_ratios=(2, 1.15))
    # A file's name may hold a $.
    figure.suptitle(clip_middle(printable(title), _TITLE_LENGTH), fontsize=11, parse_math=False)
    top = max([1e-9, *(float(candidate.explanation.score) for candidate in candidates if candidate.explanation)])
    for pair, heat, candidate in zip(axes[::2], axes[1::2], candidates, strict=True):
        _draw_pair(pair, query_image, candidate)
        pair.set_aspect(pixel_aspect)
        if candidate.explanation is None:
            heat.set_axis_off()
        else:
            figure.colorbar(_draw_histogram(heat, candidate.explanation, top), ax=heat, label="bin score", shrink=0.8)
    metadata = {keyword: printable(text) for keyword, text in (about or {}).items()}
    save_figure(figure, path, bbox_inches="tight", pad_inches=0.15, metadata=metadata)


def with_longest_side(image: UInt8[np.ndarray, "_ _ 3"], side: int) -> UInt8[np.ndarray, "_ _ 3"]:
    """Resize an image so that its longer side has so many pixels."""
    scale = side / max(image.shape[:2])
    return resize(image, (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale))))


def pixel_aspect_of(original: Shaped[np.ndarray, "_ _ 3"], smaller: Shaped[np.ndarray, "_ _ 3"]) -> float:
    """Height of a pixel of a resized image by its width, where pixels of the original are squares."""
    (height, width), (new_height, new_width) = original.shape[:2], smaller.shape[:2]
    return (height / new_height) / (width / new_width)


def _draw_pair(axes: Axes, query: np.ndarray, candidate: Candidate) -> None:
    """Draw query and candidate side by side, with the heaviest matches."""
    offset, image, matches, explanation = (
        query.shape[1] + _GAP,
        candidate.image,
        candidate.matches,
        candidate.explanation,
    )
    canvas = np.full((max(len(query), len(image)), offset + image.shape[1], 3), 255, np.uint8)
    canvas[: len(query), : query.shape[1]] = query
    canvas[: len(image), offset:] = image
    axes.imshow(canvas)
    axes.set_axis_off()
    words = "query | candidate"
    if matches is not None and explanation is not None:
        count = int(matches.mask.sum())
        weights = np.where(matches.mask, explanation.weights, -np.inf)
        heaviest = np.lexsort((matches.distance, -weights))[: min(_MATCHES, count)]  # of equal weights the nearest
        start, end = matches.points0[heaviest], matches.points1[heaviest] + [offset, 0]
        colors = np.where(explanation.agrees[heaviest], _AGREES, _DIFFERS)
        lines = np.stack([start, end], axis=1)
        axes.add_collection(LineCollection(list(lines), colors=colors, linewidths=0.8, alpha=0.9))
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
    if explanation.score <= 0:
        axes.set_title("histogram of shifts: no votes", fontsize=9)
        return image
    corner_x, corner_y = explanation.shift - half
    axes.add_patch(Rectangle((corner_x, corner_y), 2 * half, 2 * half, fill=False, edgecolor="cyan", linewidth=1.4))
    axes.plot(*explanation.peak, marker="+", color="cyan", markersize=8)
    words = "histogram of shifts: score {:.4g}, peak at ({:.1f}, {:.1f}) px"
    axes.set_title(words.format(explanation.score, *explanation.peak), fontsize=9)
    return image


def contact_sheet(path: Path, dataset: Dataset) -> None:
    """Write a figure of pairs, evenly spread over each sequence; the name replaces an image that cannot be read.

    Without ground truth, queries stand alone.
    """

    def read(folder: ImageFolder, row: int, sequence: str) -> LabeledImage:
        try:
            return with_longest_side(folder.read(row), _SIDE), f"{sequence} {folder.names[row]}".strip()
        except InputError:
            return None, f"{folder.names[row]} cannot be read"

    each, pairs = max(2, -(-_PAIRS // len(dataset.sequences))), list[list[LabeledImage]]()
    for sequence in dataset.sequences:
        for query in np.unique(np.linspace(0, len(sequence.images) - 1, each).round().astype(int)).tolist():
            place = None if sequence.truth is None else sequence.truth.place(query)
            places = [] if place is None else [read(dataset.database, place, "")]
            pairs.append([read(sequence.images, query, sequence.name), *places])
    shapes = [image.shape for pair in pairs for image, _ in pair if image is not None]
    height = _WIDTH * float(np.median([rows / columns for rows, columns, _ in shapes] or [0.75]))
    rows, columns = -(-len(pairs) // _PAIRS_IN_A_ROW), 2 * _PAIRS_IN_A_ROW
    figure, axes = panels(columns * rows, _WIDTH, 0.3 + height + 0.5 / rows, columns)
    figure.suptitle(f"{dataset.name}: query | the place that the ground truth names", fontsize=11, parse_math=False)
    for panel in axes:
        panel.set_axis_off()
    for number, pair in enumerate(pairs):
        for panel, (image, caption) in zip(axes[2 * number : 2 * number + 2], pair, strict=False):
            if image is not None:
                panel.imshow(image)
            panel.set_title(printable(clip_middle(caption, _SHEET_CAPTION_LENGTH)), fontsize=7, parse_math=False)
        if len(pair) < 2:
            axes[2 * number + 1].text(0.5, 0.5, "no place", ha="center")
    save_figure(figure, path, dpi=80)
