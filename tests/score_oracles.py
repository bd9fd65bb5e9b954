"""Soft forms of scores and of matching, and the scores that the paper discusses: NumPy float64, explicit loops.

As in `tests.oracles`, nothing here imports mfvpr or JAX, and all inputs are real entries only.
"""

import itertools
import math

import numpy as np

from tests.oracles import _rows, _values, _window_offsets, histogram_of_shifts


def _log_mean_exp(values):
    largest = max(values)
    return largest + math.log(math.fsum(math.exp(value - largest) for value in values) / len(values))


def _softmax(values):
    largest = max(values)
    powers = [math.exp(value - largest) for value in values]
    total = math.fsum(powers)
    return [power / total for power in powers]


def histogram_score(shifts, weights, size0, size1, *, temperature, **options):
    """T log(mean of exp(s / T)) over all bins s, 0 without matches."""
    if len(shifts) == 0:
        return 0.0
    bins, _, _ = histogram_of_shifts(shifts, weights, size0, size1, **options)
    return temperature * _log_mean_exp([score / temperature for score in _values(bins)])


def _memberships(points, size, num_bins, temperature):
    """For each point {cell (row, column): how far it belongs to it}."""
    members = []
    for point in _rows(points, 2):
        position = [min(max(point[axis] * num_bins / float(size[axis]), 0.0), num_bins) for axis in range(2)]
        along_x, along_y = (_softmax([-((u - c - 0.5) ** 2) / temperature for c in range(num_bins)]) for u in position)
        members.append({(r, c): along_y[r] * along_x[c] for r in range(num_bins) for c in range(num_bins)})
    return members


def anchor_points(
    points0,
    points1,
    weights,
    confidence,
    size0,
    size1,
    *,
    temperature,
    num_bins,
    window,
    tolerance,
    window_mode="half_floor",
    first="query",
    include_self=True,
    cell_weight="winner_sum",
):
    """Every anchor's mean target under V^(1/T), supported by the occupied cells of its window."""
    anchors, targets = (
        _memberships(points, size, num_bins, temperature) for points, size in ((points0, size0), (points1, size1))
    )
    if first == "candidate":
        anchors, targets = targets, anchors
    weights, confidence = _values(weights), _values(confidence)
    cells = [(r, c) for r in range(num_bins) for c in range(num_bins)]
    displacement, occupancy, cell_weights = {}, {}, {}
    for a in cells:
        number = math.fsum(sure * anchor[a] for sure, anchor in zip(confidence, anchors, strict=True))
        occupancy[a] = number**2 / (number**2 + temperature)
        matches = list(zip(weights, anchors, targets, strict=True))
        votes = {t: math.fsum(w * anchor[a] * target[t] for w, anchor, target in matches) for t in cells}
        most = max(votes.values())
        share = {t: (votes[t] / most) ** (1 / temperature) if most > 0 else 1.0 for t in cells}
        total = math.fsum(share.values())
        mean = [math.fsum(share[t] * t[axis] for t in cells) / total for axis in range(2)]
        displacement[a] = mean[0] - a[0], mean[1] - a[1]
        winner_sum = math.fsum(share[t] * votes[t] for t in cells) / total
        cell_weights[a] = {"winner_sum": winner_sum, "cell_sum": math.fsum(votes.values()), "ones": occupancy[a]}

    score = 0.0
    for a in cells:
        for row_offset in _window_offsets(window, window_mode):
            for column_offset in _window_offsets(window, window_mode):
                b = a[0] + row_offset, a[1] + column_offset
                if b in occupancy and (b != a or include_self):
                    support = max(tolerance - math.dist(displacement[a], displacement[b]), 0.0)
                    score += cell_weights[a][cell_weight] * support * occupancy[b]
    return score


def aggregated_score(shifts, weights, confidence, size, *, temperature, mean, clamp):
    """The aggregated score with a hyperbola for |x| and a softplus for the clamp."""
    shifts, weights = _rows(shifts, 2), _values(weights)
    if not shifts:
        return 0.0
    counts = weights if mean == "weighted" else _values(confidence)
    score = 0.0
    for axis in range(2):
        center = math.fsum(c * s[axis] for c, s in zip(counts, shifts, strict=True)) / math.fsum(counts)
        for shift, weight in zip(shifts, weights, strict=True):
            closeness = float(size[axis]) - (math.hypot(shift[axis] - center, temperature) - temperature)
            if clamp:  # T log(1 + exp(z / T)), which overflows as it stands
                gap = math.log1p(math.exp(-abs(closeness) / temperature))
                closeness = max(closeness, 0.0) + temperature * gap
            score += weight * closeness**2
    return score


def soft_matches(descriptors0, descriptors1, keypoints1, scores1, temperature):
    """One row (x, y, score, distance, confidence) per query keypoint."""
    rows0, rows1 = _rows(descriptors0), _rows(descriptors1)
    if not rows0:
        return np.zeros((0, 5))
    cosine = [[math.fsum(a * b for a, b in zip(row0, row1, strict=True)) for row1 in rows1] for row0 in rows0]
    by_row = [_softmax([value / temperature for value in row]) for row in cosine]
    by_column = [_softmax([row[j] / temperature for row in cosine]) for j in range(len(rows1))]
    rows = []
    for i, chances in enumerate(by_row):
        mean = lambda values, chances=chances: math.fsum(p * v for p, v in zip(chances, values, strict=True))  # noqa: E731
        squared = mean([2 - 2 * value for value in cosine[i]])
        confidence = math.fsum(p * by_column[j][i] for j, p in enumerate(chances))
        columns = [mean([float(point[axis]) for point in keypoints1]) for axis in range(2)]
        rows.append([*columns, mean(_values(scores1)), math.sqrt(max(squared, 0.0)), confidence])
    return np.array(rows)


def ratios(descriptors0, descriptors1):
    """Distance to the nearest descriptor over that to the second nearest; 1 where there is none, or both are 0."""
    quotients = []
    for row0 in _rows(descriptors0):
        distances = sorted(math.dist(row0, row1) for row1 in _rows(descriptors1))
        quotients.append(distances[0] / distances[1] if len(distances) > 1 and distances[1] > 0 else 1.0)
    return np.array(quotients)


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
    """log(1 + 1 / L), with a smallest cosine distance of 1e-12; 0 without matches."""
    if len(distance) == 0:
        return 0.0
    return math.log1p(1 / lost_distance(points0, points1, distance, confidence, **options))


def _cosine_distance(first, second, confidence):
    """At least 1e-12; 1 where a vector is 0."""
    dot, square0, square1 = (
        math.fsum(c * a * b for c, a, b in zip(confidence, left, right, strict=True))
        for left, right in ((first, second), (first, first), (second, second))
    )
    return max(1 - dot / math.sqrt(square0 * square1), 1e-12) if square0 and square1 else 1.0
