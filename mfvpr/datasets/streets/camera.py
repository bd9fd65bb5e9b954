"""The pinhole camera, its drives down the street, and the shifts of the scene between two images."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from mfvpr.datasets.streets.sheets import Floats, Rng

NEAR = 0.5  # objects that are nearer to the camera are invisible, meters
CAMERA_HEIGHT = 1.6  # meters
SPACING = 1.75  # between frames, meters
LANE = 1.8  # x of the driving lane, meters
STEP = 8  # px between the points that shifts are measured at
_DEGREE = np.pi / 180


@dataclass(frozen=True)
class Camera:
    """A pinhole camera at (x, -CAMERA_HEIGHT, z), in meters; angles in radians, heading to the right, pitch up."""

    x: float
    z: float
    heading: float
    pitch: float
    image_size: tuple[int, int]  # width, height in px

    @property
    def focal(self) -> float:
        """Focal length in px."""
        return 0.7 * self.image_size[0]

    def rotation(self) -> Float[np.ndarray, "3 3"]:
        """Rows: the camera's right, down and forward axes in the world."""
        sin_h, cos_h, sin_p, cos_p = (f(a) for a in (self.heading, self.pitch) for f in (np.sin, np.cos))
        forward = np.array([sin_h * cos_p, -sin_p, cos_h * cos_p])
        right = np.array([cos_h, 0.0, -sin_h])
        return np.stack([right, np.cross(forward, right), forward])

    def center(self) -> Float[np.ndarray, "3"]:
        """The camera's position in the world, in meters."""
        return np.array([self.x, -CAMERA_HEIGHT, self.z])

    def projection(self) -> Float[np.ndarray, "3 4"]:
        """The matrix from world points (x, y, z, 1) to homogeneous px; the last row gives the depth in m."""
        width, height = self.image_size
        intrinsics = np.array([[self.focal, 0, width / 2], [0, self.focal, height / 2], [0, 0, 1]])
        rotation = self.rotation()
        return intrinsics @ np.column_stack([rotation, -rotation @ self.center()])

    def project(
        self, points: Float[np.ndarray, "points 3"]
    ) -> tuple[Float[np.ndarray, "points 2"], Bool[np.ndarray, " points"]]:
        """World points to px, and which of them lie inside the image."""
        homogeneous = np.column_stack([points, np.ones(len(points))]) @ self.projection().T
        pixels = homogeneous[:, :2] / np.maximum(homogeneous[:, 2:], NEAR)
        inside = (homogeneous[:, 2] > NEAR) & np.all((pixels >= 0) & (pixels < self.image_size), axis=1)
        return pixels, inside


def smooth_walk(rng: Rng, count: int) -> Floats:
    """Smooth random values `[count]` in [-1, 1], similar over 8 frames."""
    steps = np.arange(-30, 31)
    kernel = np.exp(-0.5 * (steps / 8.0) ** 2)
    walk = np.convolve(rng.standard_normal(count + len(steps) - 1), kernel, mode="valid")
    return np.clip(1.3 * walk / np.sqrt(np.sum(kernel**2)) / 2, -1, 1)


def plan_drives(seed: int, count: int, image_size: tuple[int, int]) -> tuple[list[Camera], list[Camera]]:
    """The `count` cameras of the database and of the queries, in driving order; `image_size` is (width, height), px.

    The database keeps to the lane; the queries shift by 0.3 to 1.2 m to either side and turn by up to 9 degrees.
    """
    rng = np.random.default_rng([seed, 6])
    queries = _weave(rng, count, image_size)
    wobble = 0.3 * _DEGREE * rng.standard_normal((2, count))
    database = [
        replace(query, x=LANE, heading=heading, pitch=pitch)
        for query, heading, pitch in zip(queries, *wobble, strict=True)
    ]
    return database, queries


def plan_return(seed: int, number: int, count: int, image_size: tuple[int, int]) -> list[Camera]:
    """The cameras of drive `number` on another day, with another lane, other headings and positions between frames.

    Frame i is at most 0.4 of the database's spacing away from the database's frame i.
    """
    rng = np.random.default_rng([seed, 9, number])
    cameras = _weave(rng, count, image_size)
    places = SPACING * (np.arange(count) + rng.uniform(-0.2, 0.2) + 0.2 * smooth_walk(rng, count))
    return [replace(camera, z=z) for camera, z in zip(cameras, places, strict=True)]


def _weave(rng: Rng, count: int, image_size: tuple[int, int]) -> list[Camera]:
    """Cameras that leave the lane and the direction of the street."""
    shift = smooth_walk(rng, count)
    lane = LANE + np.where(shift < 0, -1, 1) * (0.3 + 0.9 * np.abs(shift))
    heading = _DEGREE * (7.5 * smooth_walk(rng, count) + np.clip(0.5 * rng.standard_normal(count), -1, 1))
    pitch = _DEGREE * (1.0 * smooth_walk(rng, count) + 0.3 * rng.standard_normal(count))
    poses = zip(lane, SPACING * np.arange(count), heading, pitch, strict=True)
    return [Camera(*pose, image_size) for pose in poses]


class Facade(NamedTuple):
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
