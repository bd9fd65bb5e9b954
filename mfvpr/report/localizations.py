"""The figure of one localization: an image beside the place that the map found."""

from contextlib import suppress
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from mfvpr.datasets.images import read_image, resize
from mfvpr.evaluation.stages import explain
from mfvpr.localization.map import Map
from mfvpr.localization.predictions import Localization
from mfvpr.report.figures import Candidate, histogram_figure, pixel_aspect_of
from mfvpr.scoring.histogram import HistogramOfShifts
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import clip_middle, path_inside

_GRAY = 150  # of an image that is not at hand
_NAME_LENGTH = 80  # characters of a name or a place


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

    `image` is RGB. `root` is the folder of the map's images, by their names; an image that cannot be
    read is drawn gray, as are all without a folder.

    Raises:
        InputError: the candidate's name leads out of the folder.
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
        caption = f"{clip_middle(best, _NAME_LENGTH)}{note}, score {prediction.score:.5g}{p}"
        candidate = Candidate(shown, caption, localization.matches, explain(histogram, localization.matches))
    query = resize(image, extractor.image_size, extractor.interpolation)
    place = f"no place ({prediction.reason})" if prediction.place is None else str(prediction.place)
    title = f"{clip_middle(name, _NAME_LENGTH)} -> {clip_middle(place, _NAME_LENGTH)}"
    about = {"image": name, "place": str(prediction.place)}
    histogram_figure(path, query, [candidate], title=title, pixel_aspect=pixel_aspect_of(image, query), about=about)
