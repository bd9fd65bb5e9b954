"""Matches of one pair from arrays of another program, checked."""

from typing import Any

import numpy as np
from jaxtyping import Float32, Num

from mfvpr.core.types import Features, Matches
from mfvpr.io.checks import as_float32
from mfvpr.io.features import require_inside
from mfvpr.io.formats.pairs import Size
from mfvpr.utils.errors import InputError

_ROUNDING = 1e-3  # by which a confidence may leave 0 to 1


def numbered_matches(
    where: str, first: Any, second: Any, confidence: Any, features0: Features, features1: Features
) -> Matches:
    """Matches `[M]` from numbers of keypoints.

    Args:
        where: the pair, for messages.
        first: numbers `[M]` of keypoints of `features0`; `second` of `features1`.
        confidence: `[M]` from 0 to 1; None = 1.
        features0: of the query, without padding; distances are 0 without descriptors.
        features1: of the candidate.
    """
    number0, number1 = _numbers(where, first, features0), _numbers(where, second, features1)
    if len(number0) != len(number1):
        raise InputError(f"{where}: expected pairs of keypoints, got {len(number0)} and {len(number1)} numbers")
    dimensions = [np.shape(features.descriptors)[1] for features in (features0, features1)]
    if dimensions[0] != dimensions[1]:
        got = f"{dimensions[0]} and {dimensions[1]}"
        raise InputError(f"{where}: expected descriptors of one length, got {got}; give the features that were matched")
    differences = np.asarray(features0.descriptors)[number0] - np.asarray(features1.descriptors)[number1]
    return Matches(
        points0=features0.keypoints[number0],
        points1=features1.keypoints[number1],
        distance=np.linalg.norm(differences, axis=1).astype(np.float32),
        scores0=features0.scores[number0],
        scores1=features1.scores[number1],
        mask=np.ones(len(number0), bool),
        image_size0=features0.image_size,
        image_size1=features1.image_size,
        confidence=_confidences(where, confidence, len(number0)),
        index0=number0,
        index1=number1,
        count0=np.int32(len(features0.mask)),
        count1=np.int32(len(features1.mask)),
    )


def point_matches(where: str, first: Any, second: Any, confidence: Any, size0: Size, size1: Size) -> Matches:
    """Matches `[M]` from points `[M, 2]` (x, y) in images of these sizes, px; their distances are 0, their scores 1."""
    points, sizes = [], [np.array(size, np.float32) for size in (size0, size1)]
    for values, size in zip((first, second), sizes, strict=True):
        values = as_float32(f"{where}: points", np.asarray(values), "fiu")
        values = values if values.size else np.zeros((0, 2), np.float32)
        if values.ndim != 2 or values.shape[1] != 2:
            raise InputError(f"{where}: expected points (x, y) [M, 2], got {list(values.shape)}")
        require_inside(where, values, size)
        points.append(values)
    if len(points[0]) != len(points[1]):
        raise InputError(f"{where}: expected as many points in both images, got {len(points[0])} and {len(points[1])}")
    ones = np.ones(len(points[0]), np.float32)
    return Matches(
        points0=points[0],
        points1=points[1],
        distance=np.zeros_like(ones),
        scores0=ones,
        scores1=ones,
        mask=ones > 0,
        image_size0=sizes[0],
        image_size1=sizes[1],
        confidence=_confidences(where, confidence, len(ones)),
    )


def _numbers(where: str, values: Any, features: Features) -> Num[np.ndarray, " matches"]:
    numbers, count = np.asarray(values), len(features.mask)
    numbers = numbers if numbers.size else np.zeros(0, np.int32)
    if numbers.ndim != 1 or numbers.dtype.kind not in "iu":
        raise InputError(f"{where}: expected numbers of keypoints [M], got {numbers.dtype}{list(numbers.shape)}")
    if numbers.size and not 0 <= numbers.min() <= numbers.max() < count:
        got = f"{numbers.min()} to {numbers.max()}"
        raise InputError(
            f"{where}: expected numbers of {count} keypoints, got {got}; give the features that were matched"
        )
    return numbers.astype(np.int32)


def _confidences(where: str, confidence: Any, count: int) -> Float32[np.ndarray, " matches"]:
    if confidence is None:
        return np.ones(count, np.float32)
    values = as_float32(f"{where}: confidences", np.asarray(confidence), "fiu")
    if values.shape != (count,):
        raise InputError(f"{where}: expected {count} confidences, got {list(values.shape)}")
    if count and not -_ROUNDING <= values.min() <= values.max() <= 1 + _ROUNDING:
        raise InputError(
            f"{where}: expected confidences from 0 to 1, got {values.min():g} to {values.max():g}; scale them, or "
            "leave them out (confidences=False for files)"
        )
    return np.clip(values, 0, 1)
