"""Figures of a run, small enough for a page."""

import base64
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

from PIL import Image

from mfvpr.report.figures import ABOUT
from mfvpr.utils.errors import InputError

MOST_PICTURES = 60
_WIDTH, _QUALITY = 1000, 75  # px, of JPEG: some 60 kB each


@dataclass(frozen=True)
class Picture:
    """The figure of a query and its prediction, as a `data:` URI; `size` is width and height, px."""

    system: str
    sequence: str
    outcome: str
    query: str
    prediction: str
    source: str
    size: tuple[int, int]


def pictures(run: Path, *, most: int = MOST_PICTURES) -> list[Picture]:
    """Figures of queries in a run folder, by the names of their files; evenly chosen if there are more than `most`."""
    paths = sorted((run / "figures").rglob("*_[0-9]*.png"))
    step = max(1, -(-len(paths) // most))
    return [picture for path in paths[::step] for picture in _pictures(path)]


def _pictures(path: Path) -> Iterator[Picture]:
    """The picture of a figure; empty if its file has no keywords."""
    try:
        with Image.open(path) as image:
            image.load()
            about = image.info
            if {*ABOUT} <= {*about}:
                small = image.convert("RGB")
                small.thumbnail((_WIDTH, small.height))
                file = BytesIO()
                small.save(file, "JPEG", quality=_QUALITY, optimize=True)
                source = f"data:image/jpeg;base64,{base64.b64encode(file.getvalue()).decode()}"
                yield Picture(**{name: str(about[name]) for name in ABOUT}, source=source, size=small.size)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(f"{path}: expected a figure of the run ({error}); remove it, or run again") from None
