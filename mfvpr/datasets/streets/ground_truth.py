"""Shifts of the scene between two images, from the geometry of the street."""

import csv
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mfvpr.datasets.streets.camera import Camera

STEP = 8  # px


@dataclass(frozen=True)
class Facade:
    """The street side of a house, in meters: the plane x = `x` between two z, up to `height`."""

    x: float
    start: float
    end: float
    height: float


def visible_points(facades: Iterable[Facade], camera: Camera) -> Float[np.ndarray, "points 3"]:
    """Points on the nearest facades, seen through a grid of every `STEP`-th px of the image."""
    width, height = camera.image_size
    u, v = np.meshgrid(np.arange(STEP / 2, width, STEP), np.arange(STEP / 2, height, STEP))
    rays = np.stack([(u - width / 2) / camera.focal, (v - height / 2) / camera.focal, np.ones_like(u)], -1)
    rays = rays.reshape(-1, 3) @ camera.rotation()
    nearest = np.full(len(rays), np.inf)
    for facade in facades:
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (facade.x - camera.x) / rays[:, 0]
            points = camera.center() + distance[:, None] * rays
        hit = (distance > 0) & (points[:, 2] >= facade.start) & (points[:, 2] <= facade.end)
        hit &= (points[:, 1] <= 0) & (points[:, 1] >= -facade.height)
        nearest = np.where(hit & (distance < nearest), distance, nearest)
    hits = np.isfinite(nearest)
    return camera.center() + nearest[hits, None] * rays[hits]


def image_shift(points: Float[np.ndarray, "points 3"], query: Camera, database: Camera) -> tuple[float, float]:
    """Shift (x, y) in px that moves the scene of the query image onto the database image.

    It is the median, per axis, of the position in the database image minus the position in the query image, over the
    world points inside both images.
    """
    (before, inside_query), (after, inside_database) = query.project(points), database.project(points)
    x, y = np.median((after - before)[inside_query & inside_database], axis=0)
    return float(x), float(y)


def write_ground_truth(path: Path, facades: Iterable[Facade], queries: list[Camera], database: list[Camera]) -> None:
    """Write the pairs of frames and their shifts in px; see `draw_streets`."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("query", "database", "shift_x", "shift_y"))
        for i, (query, candidate) in enumerate(zip(queries, database, strict=True)):
            shift = image_shift(visible_points(facades, query), query, candidate)
            writer.writerow((f"{i:04d}.png", f"{i:04d}.png", *(f"{s:.3f}" for s in shift)))
