"""Positions of the cameras of all drives."""

import numpy as np

from mfvpr.datasets.streets.camera import Camera
from mfvpr.datasets.streets.types import Floats, Rng

SPACING = 1.75  # between frames, meters
LANE = 1.8  # x of the driving lane, meters
_DEGREE = np.pi / 180


def smooth_walk(rng: Rng, count: int, correlation: float = 8.0) -> Floats:
    """Smooth random values `[count]` in [-1, 1], similar over `correlation` frames."""
    steps = np.arange(-30, 31)
    kernel = np.exp(-0.5 * (steps / correlation) ** 2)
    walk = np.convolve(rng.standard_normal(count + len(steps) - 1), kernel, mode="valid")
    return np.clip(1.3 * walk / np.sqrt(np.sum(kernel**2)) / 2, -1, 1)


def plan_drives(seed: int, count: int, image_size: tuple[int, int]) -> tuple[list[Camera], list[Camera]]:
    """The `count` cameras of the database and of the queries, in driving order; `image_size` is (width, height), px.

    The database keeps to the lane; the queries shift by 0.3 to 1.2 m to either side and turn by up to 9 degrees.
    """
    rng = np.random.default_rng([seed, 6])
    lane, heading, pitch = _path(rng, count)
    wobble = 0.3 * _DEGREE * rng.standard_normal((2, count))
    z = SPACING * np.arange(count)
    database = [Camera(LANE, *pose, image_size) for pose in zip(z, wobble[0], wobble[1], strict=True)]
    queries = [Camera(*pose, image_size) for pose in zip(lane, z, heading, pitch, strict=True)]
    return database, queries


def plan_return(seed: int, number: int, count: int, image_size: tuple[int, int]) -> list[Camera]:
    """The cameras of drive `number` on another day, with another lane, other headings and positions between frames.

    Frame i is at most 0.4 of the database's spacing away from the database's frame i.
    """
    rng = np.random.default_rng([seed, 9, number])
    lane, heading, pitch = _path(rng, count)
    z = SPACING * (np.arange(count) + rng.uniform(-0.2, 0.2) + 0.2 * smooth_walk(rng, count))
    return [Camera(*pose, image_size) for pose in zip(lane, z, heading, pitch, strict=True)]


def _path(rng: Rng, count: int) -> tuple[Floats, Floats, Floats]:
    """x in meters, heading and pitch in radians `[count]`."""
    shift = smooth_walk(rng, count)
    lane = LANE + np.where(shift < 0, -1, 1) * (0.3 + 0.9 * np.abs(shift))
    heading = _DEGREE * (7.5 * smooth_walk(rng, count) + np.clip(0.5 * rng.standard_normal(count), -1, 1))
    pitch = _DEGREE * (1.0 * smooth_walk(rng, count) + 0.3 * rng.standard_normal(count))
    return lane, heading, pitch
