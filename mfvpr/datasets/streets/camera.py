"""The pinhole camera that drives down the street."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mfvpr.datasets.streets.types import Floats

NEAR = 0.5  # objects that are nearer to the camera are invisible, meters
CAMERA_HEIGHT = 1.6  # meters


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

    def rotation(self) -> Floats:
        """Rows: the camera's right, down and forward axes in the world."""
        sin_h, cos_h, sin_p, cos_p = (f(a) for a in (self.heading, self.pitch) for f in (np.sin, np.cos))
        forward = np.array([sin_h * cos_p, -sin_p, cos_h * cos_p])
        right = np.array([cos_h, 0.0, -sin_h])
        return np.stack([right, np.cross(forward, right), forward])

    def center(self) -> Floats:
        """The camera's position `[3]` in the world, in meters."""
        return np.array([self.x, -CAMERA_HEIGHT, self.z])

    def projection(self) -> Floats:
        """The matrix `[3, 4]` from world points (x, y, z, 1) to homogeneous px; the last row gives the depth in m."""
        width, height = self.image_size
        intrinsics = np.array([[self.focal, 0, width / 2], [0, self.focal, height / 2], [0, 0, 1]])
        rotation = self.rotation()
        return intrinsics @ np.column_stack([rotation, -rotation @ self.center()])

    def project(self, points: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """World points `[n, 3]` to px `[n, 2]`, and which of them lie inside the image, `[n]`."""
        homogeneous = np.column_stack([points, np.ones(len(points))]) @ self.projection().T
        pixels = homogeneous[:, :2] / np.maximum(homogeneous[:, 2:], NEAR)
        inside = (homogeneous[:, 2] > NEAR) & np.all((pixels >= 0) & (pixels < self.image_size), axis=1)
        return pixels, inside
