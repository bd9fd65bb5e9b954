"""The figure of an answer of a map: an image beside where it was taken, and why."""

from pathlib import Path

import numpy as np

from mfvpr.datasets.images import read_image, resize
from mfvpr.evaluation.stages import explain
from mfvpr.features.extractor import Extractor
from mfvpr.localization.answers import Asked
from mfvpr.localization.map import Map
from mfvpr.report.figures import Answer, aspect_of_resized, histogram_figure
from mfvpr.scoring.histogram import HistogramOfShifts
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import below, clipped

_GRAY, _MOST = 150, 80  # of an image that is not at hand; characters of a name or a place


def answer_figure(
    path: Path, known: Map, name: str, image: np.ndarray, asked: Asked, *, root: Path | None = None
) -> None:
    """Write the figure of one answer: the image beside the best candidate, their matches, the histogram of shifts.

    Args:
        path: PNG file to write.
        known: the map that was asked.
        name: of the image.
        image: `[H, W, 3]` uint8 RGB.
        asked: what the map said.
        root: folder of the map's images, which are called by their names; a map keeps none of them, and those that
            cannot be read are drawn gray. None = all.

    Raises:
        InputError: the candidate's name leads out of the folder.
    """
    answer, extractor = asked.answer, known.extractor
    p = "" if answer.p_right is None else f", p(right) {answer.p_right:.2f}"
    place = f"no place ({answer.reason})" if answer.place is None else clipped(str(answer.place), _MOST)
    beside = Answer(_gray(extractor), "no candidate", None, None)
    if asked.matches is not None:
        best = answer.alternatives[0].name
        shown, how = _candidate(extractor, best, root)
        histogram = known.scorer if isinstance(known.scorer, HistogramOfShifts) else HistogramOfShifts()
        caption = f"{clipped(best, _MOST)}{how}, score {answer.score:.5g}{p}"
        beside = Answer(shown, caption, asked.matches, explain(histogram, asked.matches))
    query = resize(image, extractor.image_size, extractor.interpolation)
    title = f"{clipped(name, _MOST)} -> {place}"
    about = {"image": name, "place": str(answer.place)}
    histogram_figure(path, query, [beside], title=title, pixel_aspect=aspect_of_resized(image, query), about=about)


def _candidate(extractor: Extractor, name: str, root: Path | None) -> tuple[np.ndarray, str]:
    """An image of the map as the detector saw it, or a gray one, which is told."""
    if root is not None:
        file = below(root, name)
        try:
            return resize(read_image(file), extractor.image_size, extractor.interpolation), ""
        except InputError:  # it may be anywhere by now; features are what the map keeps
            pass
    return _gray(extractor), " (its image is not at hand)"


def _gray(extractor: Extractor) -> np.ndarray:
    width, height = extractor.image_size
    return np.full((height, width, 3), _GRAY, np.uint8)
