"""Reference implementations of the scores that the paper discusses: NumPy float64, explicit loops.

Written from the papers and what is known of their codes; nothing here imports mfvpr or JAX. All inputs are real matches
of a confidence above 0; points are (x, y) in pixels, a shift is the candidate's point minus the query's.
"""

import itertools
import math


def _rows(points):
    return [(float(x), float(y)) for x, y in points]


def rapid_spatial_score(points0, points1, confidence, size0, *, reach="image_size", size=None, count0=None):
    """Patch-NetVLAD's rapid spatial score (Hausler et al., CVPR 2021), by `count0` keypoints if given."""
    points0, points1, confidence = _rows(points0), _rows(points1), [float(c) for c in confidence]
    if not confidence:
        return 0.0
    score = 0.0
    for axis in (0, 1):
        shifts = [b[axis] - a[axis] for a, b in zip(points0, points1, strict=True)]
        mean = math.fsum(c * shift for c, shift in zip(confidence, shifts, strict=True)) / math.fsum(confidence)
        if size is not None:
            largest = float(size[axis])
        elif reach == "image_size":
            largest = float(size0[axis])
        elif reach == "largest_coordinate":
            largest = max(point[axis] for point in points0 + points1)
        else:
            largest = abs(max(shifts))
        for c, shift in zip(confidence, shifts, strict=True):
            score += c * (largest - abs(shift - mean)) ** 2
    return score / count0 if count0 else score


def visual_phrases(points0, points1, confidence, *, length, cell_size, align="zero_center"):
    """Groups of `length` matches in a cell of shifts (Zhang et al., CVPR 2011), each by its product of confidences."""
    start = {"zero_center": cell_size / 2, "zero_edge": 0.0}[align]
    cells = {}
    for (x0, y0), (x1, y1), c in zip(_rows(points0), _rows(points1), confidence, strict=True):
        cell = math.floor((x1 - x0 + start) / cell_size), math.floor((y1 - y0 + start) / cell_size)
        cells.setdefault(cell, []).append(float(c))
    return math.fsum(math.prod(phrase) for votes in cells.values() for phrase in itertools.combinations(votes, length))


def lost_distance(points0, points1, distance, confidence, *, form="weighted", mirrored=False, width=None):
    """The distance that LoST-X (Garg et al., RSS 2018) minimizes; infinite instead of 0 / 0."""
    x0, x1 = [x for x, _ in _rows(points0)], [x for x, _ in _rows(points1)]
    if mirrored:
        x0 = [float(width) - 1 - x for x in x0]
    matches = range(len(x0))
    c, cosine = [float(value) for value in confidence], [float(d) ** 2 / 2 for d in distance]
    if form == "described":
        return math.fsum(c[k] * abs(x1[k] - x0[k]) * cosine[k] for k in matches)
    if form == "unweighted":
        return _cosine_distance(x0, x1, c) / math.fsum(c)
    total = math.fsum(c[k] * cosine[k] for k in matches)
    normalized = [d / total if total else 0.0 for d in cosine]
    weights = [max(normalized) - d for d in normalized]
    length = math.sqrt(math.fsum(c[k] * weights[k] ** 2 for k in matches))
    if length == 0:
        return math.inf
    cosine_distance = _cosine_distance(
        [w * x for w, x in zip(weights, x0, strict=True)], [w * x for w, x in zip(weights, x1, strict=True)], c
    )
    return cosine_distance / length / math.fsum(c)


def lost_score(points0, points1, distance, confidence, **options):
    """log(1 + 1 / L), with a smallest cosine distance, or `described` L, of 1e-12; 0 without matches."""
    if len(distance) == 0:
        return 0.0
    smallest = lost_distance(points0, points1, distance, confidence, **options)
    return math.log1p(1 / (max(smallest, 1e-12) if options.get("form") == "described" else smallest))


def _cosine_distance(first, second, confidence):
    """At least 1e-12; 1 where a vector is 0."""
    dot, square0, square1 = (
        math.fsum(c * a * b for c, a, b in zip(confidence, left, right, strict=True))
        for left, right in ((first, second), (first, first), (second, second))
    )
    return max(1 - dot / math.sqrt(square0 * square1), 1e-12) if square0 and square1 else 1.0
