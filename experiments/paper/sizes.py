"""Bytes of a database image in float32, as the paper counts them: local features, and what the filter keeps.

Keypoints count where they are found, not where they are the places of a grid. (The paper's MixVPR is of float64.)
"""

from typing import Any

import numpy as np

from experiments.stages import Tools
from mfvpr.datasets import ImageFolder
from mfvpr.features import PatchNetVladFeatures, SelaVprFeatures
from mfvpr.features.windows import WindowExtractor
from mfvpr.retrieval import fitted

_FLOAT, _KEYPOINT = 4, 12  # bytes of a number, and of a keypoint with its score
_GRIDS = (WindowExtractor, PatchNetVladFeatures, SelaVprFeatures)


def bytes_of_an_image(tools: Tools, database: ImageFolder) -> dict[str, float]:
    """On average, of what was already taken from the database: `local` features, and the filter's `descriptor`."""
    archive, filter = tools.archive, tools.filter
    sources = archive.local(database, fitted(tools.extractor, database, archive), [])  # nothing is extracted for this
    keypoint = 0 if isinstance(tools.extractor, _GRIDS) else _KEYPOINT
    local = sum((_FLOAT * one.dimension + keypoint) * _mean(one.source.counts) for one in sources)
    describer: Any = fitted(filter, database, archive)  # all filters of the paper have one
    return {
        "local": local,
        "descriptor": _FLOAT * archive.vectors(database, describer.describer, database).values.shape[1],
    }


def _mean(counts: np.ndarray) -> float:
    """Keypoints of an image, of those that were looked at: filters other than VLAD need candidates alone."""
    known = counts[counts >= 0]
    return float(known.mean()) if known.size else 0.0
