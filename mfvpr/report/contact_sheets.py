"""Pairs of a data set on one sheet: queries beside the places that its ground truth says they show."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from mfvpr.datasets.datasets import Dataset, QuerySequence
from mfvpr.report.figures import with_longest_side
from mfvpr.report.plots import panels, save_figure
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import clip_middle, printable

SIDE = 320  # px of an image's longer side on the sheet
_PAIRS_IN_A_ROW = 2
_CAPTION_LENGTH = 44  # characters of a caption
_WIDTH = 3.2  # inches of an image


@dataclass(frozen=True)
class _Pair:
    sequence: QuerySequence
    query: int
    place: int | None


def contact_sheet(path: Path, dataset: Dataset, *, pairs: int = 12) -> None:
    """Write a figure of pairs, evenly spread over each sequence; the name replaces an image that cannot be read.

    Args:
        path: image file to write.
        dataset: without ground truth, queries stand alone.
        pairs: smallest number; at least two of each sequence.
    """
    each = max(2, -(-pairs // len(dataset.sequences)))
    chosen = [pair for sequence in dataset.sequences for pair in _pick_pairs(sequence, each)]
    images = [_images(dataset, pair) for pair in chosen]
    shapes = [image.shape for both in images for image, _ in both if image is not None]
    height = _WIDTH * float(np.median([rows / columns for rows, columns, _ in shapes] or [0.75]))
    rows = -(-len(chosen) // _PAIRS_IN_A_ROW)
    columns = 2 * _PAIRS_IN_A_ROW
    figure, axes = panels(columns * rows, _WIDTH, 0.3 + height + 0.5 / rows, columns)
    figure.suptitle(f"{dataset.name}: query | the place that the ground truth names", fontsize=11, parse_math=False)
    for panel in axes:
        panel.set_axis_off()
    for query_panel, place_panel, both in zip(axes[::2], axes[1::2], images, strict=False):
        for panel, drawing in zip((query_panel, place_panel), both, strict=False):
            _draw(panel, *drawing)
        if len(both) < 2:
            place_panel.text(0.5, 0.5, "no place", ha="center")
    save_figure(figure, path, dpi=80)


def _pick_pairs(sequence: QuerySequence, number: int) -> Sequence[_Pair]:
    rows = np.unique(np.linspace(0, len(sequence.images) - 1, number).round().astype(int))
    truth = sequence.truth
    return [_Pair(sequence, int(row), None if truth is None else truth.place(int(row))) for row in rows]


def _images(dataset: Dataset, pair: _Pair) -> list[tuple[np.ndarray | None, str]]:
    """Images and captions of the query, and of its place where that is known."""
    place = [] if pair.place is None else [_image(QuerySequence("", dataset.database, None), pair.place)]
    return [_image(pair.sequence, pair.query), *place]


def _image(sequence: QuerySequence, row: int) -> tuple[np.ndarray | None, str]:
    name = sequence.images.names[row]
    try:
        image = sequence.images.read(row)
    except InputError:
        return None, f"{name} cannot be read"
    return with_longest_side(image, SIDE), f"{sequence.name} {name}".strip()


def _draw(axes: Axes, image: np.ndarray | None, caption: str) -> None:
    if image is not None:
        axes.imshow(image)
    axes.set_title(printable(clip_middle(caption, _CAPTION_LENGTH)), fontsize=7, parse_math=False)
