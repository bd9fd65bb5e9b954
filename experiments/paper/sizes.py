"""Bytes of a database image in float32, as the paper counts them: local features, and what the filter keeps."""

from typing import Any

from experiments.prepare import Tools
from mfvpr.data.datasets import ImageFolder
from mfvpr.fitting import fitted

_FLOAT, _KEYPOINT = 4, 12  # bytes of a number, and of a keypoint with its score


def bytes_of_an_image(tools: Tools, database: ImageFolder) -> dict[str, float]:
    """On average, of what was already taken from the database: `local` features, and the filter's `descriptor`."""
    archive, filter = tools.archive, tools.filter
    sources = archive.local(database, fitted(tools.extractor, database, archive))
    local = sum((_FLOAT * one.dimension + _KEYPOINT) * float(one.counts.mean()) for one in sources)
    describer: Any = fitted(filter, database, archive)  # all filters of the paper have one
    return {
        "local": local,
        "descriptor": _FLOAT * archive.vectors(database, describer.describer, database).values.shape[1],
    }
