"""Panels in true perspective, painted from far to near."""

from collections.abc import Iterable
from itertools import pairwise

import cv2
import numpy as np

from mfvpr.datasets.streets.camera import NEAR, Camera
from mfvpr.datasets.streets.colors import Floats, Image
from mfvpr.datasets.streets.sheets import Panel, Prop
from mfvpr.datasets.streets.weather import Weather

OVERSAMPLING = 1.5  # size of the canvas per size of the image, against jagged edges


def paint(layers: Iterable[Iterable[Prop]], camera: Camera, weather: Weather) -> Image:
    """The image (RGB) that the camera sees, before lens, air and sensor; later layers hide earlier ones."""
    width, height = camera.image_size
    size = (round(width * OVERSAMPLING), round(height * OVERSAMPLING))
    canvas = np.empty((size[1], size[0], 4), np.uint8)
    canvas[:] = (*weather.horizon, 255)
    projection = np.diag([size[0] / width, size[1] / height, 1.0]) @ camera.projection()
    for layer in layers:
        for prop in sorted(layer, key=lambda prop: -prop.z):
            for panel in prop.panels:
                paint_panel(canvas, projection, panel, weather)
    return cv2.resize(canvas, (width, height), interpolation=cv2.INTER_AREA)[..., :3]


def paint_panel(canvas: Image, projection: Floats, panel: Panel, weather: Weather) -> None:
    """Paint one panel over the canvas (RGBA), unless it is out of view or shows its back.

    `projection` `[3, 4]` takes world points to homogeneous px of the canvas.
    """
    frame = np.column_stack([panel.right, panel.down, panel.corner])
    homography = projection @ np.vstack([frame, (0, 0, 1)])
    outline = clip_outline(homography)
    if outline is None or shows_back(outline):
        return
    low = np.maximum(np.floor(outline.min(0)).astype(int) - 1, 0)
    high = np.minimum(np.ceil(outline.max(0)).astype(int) + 2, canvas.shape[1::-1])
    width, height = (high - low).tolist()
    if width <= 0 or height <= 0:
        return
    depth = float(homography[2] @ (0.5, 0.5, 1))
    texture = cv2.LUT(shrink(panel.texture(weather), np.ptp(outline, 0)), haze_table(weather, depth))
    texels = np.diag([1 / texture.shape[1], 1 / texture.shape[0], 1])
    warp = np.array([[1, 0, -low[0]], [0, 1, -low[1]], [0, 0, 1]]) @ homography @ texels
    patch = cv2.warpPerspective(texture, warp, (width, height), borderMode=cv2.BORDER_REPLICATE)
    mask = np.zeros((height, width), np.uint8)
    cv2.fillConvexPoly(mask, np.rint((outline - low) * 16).astype(np.int32), 255, shift=4)
    mask[patch[..., 3] < 128] = 0
    cv2.copyTo(patch, mask, canvas[low[1] : high[1], low[0] : high[0]])


def clip_outline(homography: Floats) -> Floats | None:
    """Corners `[n, 2]` px of the unit square's image, clipped in front of the camera; None if all of it is behind."""
    corners = np.array([[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1.0]]) @ homography.T
    if np.all(corners[:, 2] > NEAR):
        return corners[:, :2] / corners[:, 2:]
    outline = []
    for corner, following in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if corner[2] > NEAR:
            outline.append(corner)
        if (corner[2] > NEAR) != (following[2] > NEAR):
            outline.append(corner + (following - corner) * (NEAR - corner[2]) / (following[2] - corner[2]))
    return np.array([point[:2] / point[2] for point in outline]) if outline else None


def shows_back(outline: Floats) -> bool:
    """Whether the corners `[n, 2]` run the wrong way around, or enclose less than half a px."""
    corners = outline.tolist()
    double_area = 0.0
    for (x0, y0), (x1, y1) in pairwise([*corners, corners[0]]):
        double_area = double_area + x0 * y1 - y0 * x1
    return double_area <= 1


def haze_table(weather: Weather, depth: float) -> Image:
    """Lookup table `[1, 256, 4]` that mixes the haze of `depth` meters of air into a color."""
    share = 1 - np.exp(-((depth / weather.haze) ** 2))
    levels = np.arange(256, dtype=np.float64)[:, None]
    table = levels + share * (np.array((*weather.horizon, 0)) - levels) * (1, 1, 1, 0)
    return table.astype(np.uint8)[None]


def shrink(texture: Image, extent: Floats) -> Image:
    """The texture with no more texels than its image has px, against aliasing; extent is (width, height) in px."""
    rows, columns = texture.shape[:2]
    size = (int(np.clip(np.ceil(extent[0]), 1, columns)), int(np.clip(np.ceil(extent[1]), 1, rows)))
    return texture if size == (columns, rows) else cv2.resize(texture, size, interpolation=cv2.INTER_AREA)
