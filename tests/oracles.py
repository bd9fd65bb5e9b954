"""Reference implementations: NumPy float64, explicit loops, written from the paper and from nothing else.

Nothing here imports mfvpr or JAX, so that a test against this file is a test against the paper. Equations are
numbered as in the paper, "On Model-Free Re-ranking for Visual Place Recognition with Deep Learned Local
Features": 1 is the histogram of shifts, 2 anchor points, 3 the aggregated score. Where its text is ambiguous,
the options are those of the README's table.

All inputs are real entries only (no padding). Points and shifts are (x, y) in pixels, sizes (width, height);
a shift is the candidate's point minus the query's point. Sums whose equality decides a tie use `math.fsum`,
which rounds once and so does not depend on the order of the summands.
"""

import math
import statistics
from operator import mul

import numpy as np


def _rows(array, columns=None):
    """Rows of an array as lists of Python floats (exact for float32 input)."""
    array = np.asarray(array)
    if columns is not None:
        array = array.reshape(-1, columns)
    return [[float(value) for value in row] for row in array]


def _values(array):
    """Entries of a vector as Python floats."""
    return [float(value) for value in np.asarray(array).reshape(-1)]


def _first_argmax(values):
    """Index of the largest value; the first one wins a tie."""
    best = 0
    for index, value in enumerate(values):
        if value > values[best]:
            best = index
    return best


# --- matching -----------------------------------------------------------------------------------------------


def nearest(descriptors0, descriptors1, crosscheck="mutual"):
    """Nearest neighbors with cross-check, first index wins ties: [(i, j, distance)] sorted by i, or by j."""
    rows0, rows1 = _rows(descriptors0), _rows(descriptors1)
    if not rows0 or not rows1:
        return []
    similarity = [[math.fsum(map(mul, a, b)) for b in rows1] for a in rows0]
    forward = [_first_argmax(row) for row in similarity]
    backward = [_first_argmax([row[j] for row in similarity]) for j in range(len(rows1))]

    if crosscheck == "candidate":
        return [(i, j, math.dist(rows0[i], rows1[j])) for j, i in enumerate(backward)]
    matches = []
    for i in range(len(rows0)):
        if crosscheck == "none":
            matches.append((i, forward[i]))
        elif crosscheck == "mutual":
            if backward[forward[i]] == i:
                matches.append((i, forward[i]))
        else:
            suitors = [j for j in range(len(rows1)) if backward[j] == i]
            if suitors:
                matches.append((i, suitors[_first_argmax([similarity[i][j] for j in suitors])]))
    return [(i, j, math.dist(rows0[i], rows1[j])) for i, j in matches]


# --- histogram of shifts ------------------------------------------------------------------------------------


def _bin_centers(lower, upper, bin_size, align):
    """Centers of the fewest bins that cover [lower, upper], at least one."""
    if align == "min_edge":
        count = math.ceil((upper - lower) / bin_size)
        return [lower + bin_size / 2 + index * bin_size for index in range(max(count, 1))]
    if align == "zero_center":  # bin m covers [(m - 1/2) b, (m + 1/2) b]
        first = math.floor(lower / bin_size + 0.5)
        last = math.ceil(upper / bin_size - 0.5)
        return [m * bin_size for m in range(first, max(last, first) + 1)]
    first = math.floor(lower / bin_size)  # zero_edge: bin m covers [m b, (m + 1) b]
    last = math.ceil(upper / bin_size) - 1
    return [(m + 0.5) * bin_size for m in range(first, max(last, first) + 1)]


def histogram_of_shifts(
    shifts,
    weights,
    size0,
    size1,
    *,
    bin_size=15.0,
    sigma=22.5,
    sigma_is_variance=False,
    align="min_edge",
    truncate=math.inf,
    shift_range=None,
):
    """Bin scores [By, Bx], centers_x [Bx], centers_y [By] (paper eq. 1)."""
    shifts, weights = _rows(shifts, 2), _values(weights)
    bin_size = float(bin_size)
    sigma = math.sqrt(sigma) if sigma_is_variance else float(sigma)
    radius = math.inf if truncate is None else truncate * sigma

    centers = []
    for axis in range(2):
        if shift_range is None:
            lower, upper = -float(size0[axis]), float(size1[axis])
        else:
            lower, upper = -float(shift_range[axis]), float(shift_range[axis])
        centers.append(_bin_centers(lower, upper, bin_size, align))
    centers_x, centers_y = centers

    histogram = np.zeros((len(centers_y), len(centers_x)), np.float64)
    for row, center_y in enumerate(centers_y):
        for column, center_x in enumerate(centers_x):
            votes = []
            for (x, y), weight in zip(shifts, weights, strict=True):
                dx, dy = x - center_x, y - center_y
                if abs(dx) <= radius and abs(dy) <= radius:
                    votes.append(weight * math.exp(-(dx * dx + dy * dy) / (2 * sigma * sigma)))
            histogram[row, column] = math.fsum(votes)
    return histogram, np.array(centers_x, np.float64), np.array(centers_y, np.float64)


# --- anchor points ------------------------------------------------------------------------------------------


def _cell(point, size, num_bins):
    """Grid cell (row, column) of a point, clipped to the grid."""
    column = math.floor(point[0] * num_bins / float(size[0]))
    row = math.floor(point[1] * num_bins / float(size[1]))
    return min(max(row, 0), num_bins - 1), min(max(column, 0), num_bins - 1)


def _window_offsets(window, window_mode):
    """Offsets of the square window along one axis."""
    if window_mode == "half_floor":
        return range(-(window // 2), window // 2 + 1)
    if window_mode == "asymmetric":  # exactly `window` cells: 10 -> -5..4, 9 -> -4..4
        return range(-(window // 2), window - window // 2)
    if window_mode == "odd_down":
        odd = window if window % 2 == 1 else window - 1
        return range(-((odd - 1) // 2), (odd - 1) // 2 + 1)
    return range(-window, window + 1)  # radius


def anchor_cells(points0, points1, weights, size0, size1, *, num_bins=15):
    """Matrix of matches {cell: (winning target cell, its summed weight, total weight)}."""
    groups = {}
    for point0, point1, weight in zip(_rows(points0, 2), _rows(points1, 2), _values(weights), strict=True):
        targets = groups.setdefault(_cell(point0, size0, num_bins), {})
        targets.setdefault(_cell(point1, size1, num_bins), []).append(weight)

    cells = {}
    for cell, targets in groups.items():
        candidates = sorted(targets)  # (row, column) in row-major order
        sums = [math.fsum(targets[target]) for target in candidates]
        winner = _first_argmax(sums)
        weights_of_cell = [weight for target in candidates for weight in targets[target]]
        cells[cell] = candidates[winner], sums[winner], math.fsum(weights_of_cell)
    return cells


def anchor_points(
    points0,
    points1,
    weights,
    size0,
    size1,
    *,
    num_bins=15,
    window=10,
    tolerance=3.0,
    window_mode="half_floor",
    first="query",
    include_self=True,
    cell_weight="winner_sum",
):
    """Sum of the anchor scores over all cells with a match (paper eq. 2)."""
    if first == "candidate":
        points0, points1, size0, size1 = points1, points0, size1, size0
    cells = anchor_cells(points0, points1, weights, size0, size1, num_bins=num_bins)
    offsets = _window_offsets(window, window_mode)

    score = 0.0
    for (i, j), ((mi, mj), winner_sum, cell_sum) in cells.items():
        weight = {"winner_sum": winner_sum, "cell_sum": cell_sum, "ones": 1.0}[cell_weight]
        consistent = 0.0
        for row_offset in offsets:
            for column_offset in offsets:
                row, column = i + row_offset, j + column_offset  # (k, l) in the paper
                if (row, column) not in cells or ((row, column) == (i, j) and not include_self):
                    continue
                (target_row, target_column), _, _ = cells[row, column]
                error = math.hypot((i - row) - (mi - target_row), (j - column) - (mj - target_column))
                consistent += max(tolerance - error, 0.0)
        score += weight * consistent
    return float(score)


# --- aggregated score ---------------------------------------------------------------------------------------


def aggregated_score(shifts, weights, size, *, mean="unweighted", clamp=False, confidence=None):
    """Aggregated score (paper eq. 3), 0 without matches. The unweighted mean counts the confidence."""
    shifts, weights = _rows(shifts, 2), _values(weights)
    confidence = [1.0] * len(shifts) if confidence is None else _values(confidence)
    total = math.fsum(weights)
    if not shifts or (mean == "weighted" and total == 0):
        return 0.0

    center = []
    for axis in range(2):
        values = [shift[axis] for shift in shifts]
        if mean == "unweighted":
            center.append(math.fsum(c * v for c, v in zip(confidence, values, strict=True)) / math.fsum(confidence))
        elif mean == "weighted":
            center.append(math.fsum(w * v for w, v in zip(weights, values, strict=True)) / total)
        else:
            center.append(statistics.median(values))

    score = 0.0
    for shift, weight in zip(shifts, weights, strict=True):
        for axis in range(2):
            closeness = float(size[axis]) - abs(shift[axis] - center[axis])
            if clamp:
                closeness = max(closeness, 0.0)
            score += weight * closeness**2
    return score


def grid_anchors(index, side, *, patch=None, outside=-1000):
    """SSM-VPR's score of `index`: by row and column of the candidate the query's cell, None = no match."""
    size = int(0.75 * side) if patch is None else patch
    half = (size - (size % 2 == 0)) // 2
    score = 0
    for row in range(side):
        for column in range(side):
            anchor = index[row][column]
            if anchor is None:
                continue
            for down in range(-half, half + 1):
                for right in range(-half, half + 1):
                    inside = 0 <= row + down < side and 0 <= column + right < side
                    other = index[row + down][column + right] if inside else outside
                    score += other == anchor + down * side + right
    return score


# --- fusion and ranking -------------------------------------------------------------------------------------


def fuse_scales(scores, mask, weights):
    """Sum over scales of z-scores over the candidates with a finite score, `[C, S]` -> `[C]` (Patch-NetVLAD)."""
    fused = np.full(len(mask), np.nan)
    real = [place for place in range(len(mask)) if mask[place]]
    for place in real:
        fused[place] = 0.0
        for scale, weight in enumerate(weights):
            score = float(scores[place, scale])
            finite = [float(scores[row, scale]) for row in real if np.isfinite(scores[row, scale])]
            if np.isfinite(score):
                deviation = np.std(finite) if min(finite) < max(finite) else 0.0
                score = (score - np.mean(finite)) / deviation if deviation else 0.0
            fused[place] += weight * score
    return fused


def rank(scores, mask=None):
    """Positions by descending score: NaN after all numbers, masked last, ties keep the given order."""
    scores = _values(scores)
    mask = [True] * len(scores) if mask is None else [bool(m) for m in mask]
    numbers = [p for p, score in enumerate(scores) if mask[p] and not math.isnan(score)]
    nans = [p for p, score in enumerate(scores) if mask[p] and math.isnan(score)]
    masked = [p for p in range(len(scores)) if not mask[p]]
    return sorted(numbers, key=lambda position: -scores[position]) + nans + masked


# --- evaluation ---------------------------------------------------------------------------------------------


def frame_positives(query_index, database_index, tolerance):
    """|query frame - database frame| <= tolerance, inclusive, [Q, N]."""
    positives = np.zeros((len(query_index), len(database_index)), bool)
    for q, query in enumerate(_values(query_index)):
        for d, reference in enumerate(_values(database_index)):
            positives[q, d] = abs(query - reference) <= tolerance
    return positives


def radius_positives(query_xy, database_xy, radius):
    """Planar distance <= radius, inclusive, [Q, N] (the standard 25 m protocol)."""
    positives = np.zeros((len(query_xy), len(database_xy)), bool)
    for q, query in enumerate(_rows(query_xy, 2)):
        for d, reference in enumerate(_rows(database_xy, 2)):
            positives[q, d] = math.dist(query, reference) <= radius
    return positives


def recall_at_k(order, positives, ks):
    """Fraction of all queries with a positive among the first k rows (-1 = none), NaN without queries."""
    recalls = []
    for k in ks:
        hits = 0
        for row, positive in zip(order, positives, strict=True):
            if any(index >= 0 and positive[index] for index in list(row)[:k]):
                hits += 1
        recalls.append(hits / len(order) if len(order) else math.nan)
    return recalls


# --- VLAD ---------------------------------------------------------------------------------------------------


def _unit(vector):
    """L2-normalized vector; the zero vector stays zero."""
    norm = math.hypot(*vector)
    return [value / norm for value in vector] if norm > 0 else list(vector)


def vlad(descriptors, centers, power=0.5):
    """VLAD (Jegou et al. 2010), intra-normalized (Arandjelovic & Zisserman 2013), power law, L2: [M * D]."""
    centers = _rows(centers)
    dimension = len(centers[0])
    residuals = [[0.0] * dimension for _ in centers]
    for descriptor in _rows(descriptors, dimension):
        squares = [math.fsum((a - b) ** 2 for a, b in zip(descriptor, center, strict=True)) for center in centers]
        closest = _first_argmax([-square for square in squares])
        for axis in range(dimension):
            residuals[closest][axis] += descriptor[axis] - centers[closest][axis]
    flat = [value for residual in residuals for value in _unit(residual)]
    powered = [math.copysign(abs(value) ** power, value) if value != 0 else 0.0 for value in flat]
    return np.array(_unit(powered), np.float64)
