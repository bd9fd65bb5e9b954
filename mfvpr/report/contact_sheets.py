"""Pairs of a data set on one sheet: queries beside the places that its ground truth says they show."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from mfvpr.datasets.datasets import Dataset, QuerySequence
from mfvpr.datasets.images import resize
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import clipped, printable, replacing

SIDE = 320  # px of an image's longer side on the sheet
_COLUMNS = 2  # of pairs
_LONGEST = 44  # characters of a caption
_WIDTH = 3.2  # inches of an image


@dataclass(frozen=True)
class _Pair:
    sequence: QuerySequence
    query: int
    place: int | None


def contact_sheet(path: Path, dataset: Dataset, *, pairs: int = 12) -> None:
    """Write a figure of pairs, evenly spread over each sequence.

    Args:
        path: image file to write.
        dataset: whose truths are known, or queries stand alone.
        pairs: at least; at least two of each sequence.

    An image that cannot be read is named in its place.
    """
    each = max(2, -(-pairs // len(dataset.sequences)))
    chosen = [pair for sequence in dataset.sequences for pair in _spread(sequence, each)]
    images = [_images(dataset, pair) for pair in chosen]
    shapes = [image.shape for both in images for image, _ in both if image is not None]
    height = _WIDTH * float(np.median([rows / columns for rows, columns, _ in shapes] or [0.75]))
    rows = -(-len(chosen) // _COLUMNS)
    figure = Figure(figsize=(2 * _COLUMNS * _WIDTH, 0.5 + (0.3 + height) * rows), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(f"{dataset.name}: query | the place that the ground truth names", fontsize=11, parse_math=False)
    cells = figure.subplots(rows, 2 * _COLUMNS, squeeze=False).reshape(-1, 2)
    for axes in cells.ravel():
        axes.set_axis_off()
    for pair, both in zip(cells, images, strict=False):
        for one, drawn in zip(pair, both, strict=False):
            _draw(one, *drawn)
        if len(both) < 2:
            pair[1].text(0.5, 0.5, "no place", ha="center")
    with replacing(path) as temporary, warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing")  # names in scripts that the font lacks
        figure.savefig(temporary, dpi=80)


def _spread(sequence: QuerySequence, number: int) -> Sequence[_Pair]:
    rows = np.unique(np.linspace(0, len(sequence.images) - 1, number).round().astype(int))
    truth = sequence.truth
    return [_Pair(sequence, int(row), None if truth is None else truth.place(int(row))) for row in rows]


def _images(dataset: Dataset, pair: _Pair) -> list[tuple[np.ndarray | None, str]]:
    """Query, and place where it is known."""
    place = [] if pair.place is None else [_image(QuerySequence("", dataset.database, None), pair.place)]
    return [_image(pair.sequence, pair.query), *place]


def _image(sequence: QuerySequence, row: int) -> tuple[np.ndarray | None, str]:
    name = sequence.images.names[row]
    try:
        image = sequence.images.read(row)
    except InputError:
        return None, f"{name} cannot be read"
    scale = SIDE / max(image.shape[:2])
    size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
    return resize(image, size), f"{sequence.name} {name}".strip()


def _draw(axes: Axes, image: np.ndarray | None, caption: str) -> None:
    if image is not None:
        axes.imshow(image)
    axes.set_title(printable(clipped(caption, _LONGEST)), fontsize=7, parse_math=False)
