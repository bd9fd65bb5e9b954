"""Pairs of a data set on one sheet: queries beside the places that its ground truth says they show."""

from pathlib import Path

import numpy as np

from mfvpr.datasets.datasets import Dataset, ImageFolder, QuerySequence
from mfvpr.report.figures import with_longest_side
from mfvpr.report.plots import panels, save_figure
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import clip_middle, printable

SIDE = 320  # px of an image's longer side on the sheet
_PAIRS, _PAIRS_IN_A_ROW = 12, 2  # at least two of each sequence
_CAPTION_LENGTH = 44  # characters
_WIDTH = 3.2  # inches of an image

_Image = tuple[np.ndarray | None, str]  # pixels, None if they cannot be read, and a caption


def contact_sheet(path: Path, dataset: Dataset) -> None:
    """Write a figure of pairs, evenly spread over each sequence; the name replaces an image that cannot be read.

    Without ground truth, queries stand alone.
    """
    each = max(2, -(-_PAIRS // len(dataset.sequences)))
    pairs = [pair for sequence in dataset.sequences for pair in _pairs(sequence, dataset.database, each)]
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
            panel.set_title(printable(clip_middle(caption, _CAPTION_LENGTH)), fontsize=7, parse_math=False)
        if len(pair) < 2:
            axes[2 * number + 1].text(0.5, 0.5, "no place", ha="center")
    save_figure(figure, path, dpi=80)


def _pairs(sequence: QuerySequence, database: ImageFolder, number: int) -> list[list[_Image]]:
    """Queries, each with its place where that is known."""
    pairs = []
    for query in np.unique(np.linspace(0, len(sequence.images) - 1, number).round().astype(int)).tolist():
        place = None if sequence.truth is None else sequence.truth.place(query)
        places = [] if place is None else [_image(database, place, "")]
        pairs.append([_image(sequence.images, query, sequence.name), *places])
    return pairs


def _image(folder: ImageFolder, row: int, sequence: str) -> _Image:
    name = folder.names[row]
    try:
        return with_longest_side(folder.read(row), SIDE), f"{sequence} {name}".strip()
    except InputError:
        return None, f"{name} cannot be read"
