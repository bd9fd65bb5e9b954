"""The paper's histogram figure: both images with their matches beside the histogram of shifts, its peak marked."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from mfvpr.data.files import replacing
from mfvpr.scoring import HistogramOfShifts
from mfvpr.types import Matches
from mfvpr.weighting import match_weights

_AGREES, _DIFFERS = "#3ddc84", "#ff5a5f"


def histogram_figure(
    path: Path,
    query_image: np.ndarray,
    candidate_image: np.ndarray,
    matches: Matches,
    scorer: HistogramOfShifts,
    *,
    title: str,
    max_lines: int = 30,
) -> None:
    """Write the figure of one pair.

    Args:
        path: image file to write.
        query_image: `[H, W, 3]` uint8, at the size that the points refer to.
        candidate_image: likewise.
        matches: of this pair, `[K, ...]`.
        scorer: whose histogram is shown.
        title: above everything.
        max_lines: matches drawn, the heaviest (the paper shows 30). Green ones lie within two sigmas of the peak.
    """
    figure = Figure(figsize=(12, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    pair, heat = figure.subplots(1, 2, width_ratios=(2, 1.15))
    figure.suptitle(title, fontsize=11)
    peak = np.asarray(scorer.dominant_shift(matches, refine=True))
    _draw_pair(pair, query_image, candidate_image, matches, scorer, peak, max_lines)
    image = _draw_histogram(heat, matches, scorer, peak)
    figure.colorbar(image, ax=heat, label="bin score", shrink=0.85)
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=110)


def _draw_pair(
    axes: Axes, query: np.ndarray, candidate: np.ndarray, matches: Matches, scorer: HistogramOfShifts,
    peak: np.ndarray, max_lines: int,
) -> None:  # fmt: skip
    gap = 12
    height = max(len(query), len(candidate))
    canvas = np.full((height, query.shape[1] + gap + candidate.shape[1], 3), 255, np.uint8)
    canvas[: len(query), : query.shape[1]] = query
    canvas[: len(candidate), query.shape[1] + gap :] = candidate
    axes.imshow(canvas)
    axes.set_axis_off()

    weights = np.asarray(match_weights(scorer.weight, matches))
    heaviest = np.argsort(-weights, kind="stable")[: min(max_lines, int(np.sum(matches.mask)))]
    start = np.asarray(matches.points0)[heaviest]
    end = np.asarray(matches.points1)[heaviest]
    sign = 1 if scorer.direction == "candidate_minus_query" else -1
    reach = 2 * np.sqrt(scorer.sigma) if scorer.sigma_is_variance else 2 * scorer.sigma
    agrees = np.linalg.norm(sign * (end - start) - peak, axis=1) <= reach
    offset = np.array([query.shape[1] + gap, 0])
    colors = np.where(agrees, _AGREES, _DIFFERS)
    lines = np.stack([start, end + offset], axis=1)
    axes.add_collection(LineCollection(list(lines), colors=colors, linewidths=0.8, alpha=0.9))
    for points in (start, end + offset):
        axes.scatter(points[:, 0], points[:, 1], s=7, c=colors, linewidths=0)
    axes.set_title(
        f"query | candidate: {len(heaviest)} heaviest of {int(np.sum(matches.mask))} matches, "
        f"{agrees.sum()} agree with the peak",
        fontsize=9,
    )


def _draw_histogram(axes: Axes, matches: Matches, scorer: HistogramOfShifts, peak: np.ndarray):
    scores, centers_x, centers_y = map(np.asarray, scorer.histogram(matches))
    real_y, real_x = (scores > -np.inf).any(axis=1), (scores > -np.inf).any(axis=0)
    scores, centers_x, centers_y = scores[real_y][:, real_x], centers_x[real_x], centers_y[real_y]
    half = float(scorer.bin_size) / 2
    extent = (centers_x[0] - half, centers_x[-1] + half, centers_y[-1] + half, centers_y[0] - half)
    image = axes.imshow(scores, extent=extent, cmap="magma", interpolation="nearest", vmin=0)
    x, y = np.asarray(scorer.dominant_shift(matches))
    axes.add_patch(Rectangle((x - half, y - half), 2 * half, 2 * half, fill=False, edgecolor="cyan", linewidth=1.4))
    axes.plot(*peak, marker="+", color="cyan", markersize=8)
    axes.set_xlabel("shift x, px")
    axes.set_ylabel("shift y, px")
    axes.set_title(f"score {float(scorer(matches)):.4g}, shift ({peak[0]:.1f}, {peak[1]:.1f}) px", fontsize=9)
    return image
