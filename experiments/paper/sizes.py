"""Bytes of a database image in float32, as the paper counts them: local features, and what retrieval keeps.

Detected keypoints count, those of a grid do not. (The paper's MixVPR is of float64.)
"""

from typing import Any

from mfvpr.cli.stages import Tools
from mfvpr.datasets import ImageFolder
from mfvpr.features import PatchNetVladFeatures, SelaVprFeatures
from mfvpr.features.windows import WindowExtractor
from mfvpr.retrieval import fit_to_database

_FLOAT, _KEYPOINT = 4, 12  # bytes of a number, and of a keypoint with its score
_GRIDS = (WindowExtractor, PatchNetVladFeatures, SelaVprFeatures)


def bytes_of_an_image(tools: Tools, database: ImageFolder) -> dict[str, float]:
    """Average bytes of what was already extracted: `local` features, and the `descriptor` of retrieval."""
    cache, pipeline = tools.cache, tools.pipeline
    sources = cache.local(database, fit_to_database(pipeline.extractor, database, cache), [])  # extracts nothing
    keypoint = 0 if isinstance(pipeline.extractor, _GRIDS) else _KEYPOINT
    local = 0.0
    for features in sources:
        counts = features.source.counts
        known = counts[counts >= 0]  # retrieval other than VLAD needs the candidates' features alone
        local += (_FLOAT * features.dimension + keypoint) * (float(known.mean()) if known.size else 0.0)
    describer: Any = fit_to_database(pipeline.retriever, database, cache)  # all of the paper's have one
    vectors = cache.vectors(database, describer.describer, database).values
    return {"local": local, "descriptor": _FLOAT * vectors.shape[1]}
