"""Sheets: flat drawings in meters, the textures they become in each weather, and panels that carry textures.

A sheet has its colors on a summer day, its glow at night, and the amount of snow that settles, for use in any weather.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np
from numpy.typing import ArrayLike

from mfvpr.datasets.streets.weather import DARK, Color, Floats, Image, Rng, Weather, as_array, tone

Texture = Callable[[Weather], Image]  # colors and opacity (RGBA) in a weather


class Sheet:
    """A drawing of `width` by `height` meters at `scale` px per meter; transparent where `color` is None.

    x is to the right, y down, in meters from the top left corner.
    """

    def __init__(self, width: float, height: float, color: Color | None, scale: int = 32) -> None:
        shape = (max(2, round(height * scale)), max(2, round(width * scale)), 4)
        self.width, self.height, self.scale = width, height, scale
        self.day = np.zeros(shape, np.uint8)  # RGB and opacity
        self.effects = np.zeros(shape, np.uint8)  # RGB of the glow at night, and how much snow settles
        if color is not None:
            self.day[:] = (*color, 255)

    def rect(
        self, x: float, y: float, width: float, height: float, color: Color, glow: Color = DARK, snow: int = 0
    ) -> None:
        """A rectangle with its upper left corner at (x, y)."""
        x0, y0, x1, y1 = (max(0, round(a * self.scale)) for a in (x, y, x + width, y + height))
        self.day[y0:y1, x0:x1] = (*color, 255)
        self.effects[y0:y1, x0:x1] = (*glow, snow)

    def polygon(self, points: ArrayLike, color: Color, glow: Color = DARK, snow: int = 0) -> None:
        """A filled polygon with corners `[n, 2]`."""
        corners = [np.rint(np.asarray(points, float) * self.scale * 16).astype(np.int32)]
        cv2.fillPoly(self.day, corners, (*color, 255), shift=4)
        cv2.fillPoly(self.effects, corners, (*glow, snow), shift=4)

    def ellipse(
        self, x: float, y: float, rx: float, ry: float, color: Color, glow: Color = DARK, snow: int = 0
    ) -> None:
        """An ellipse around (x, y) with half axes rx and ry."""
        angles = np.linspace(0, 2 * np.pi, 20, endpoint=False)
        points = np.stack([x + rx * np.cos(angles), y + ry * np.sin(angles)], 1)
        self.polygon(points, color, glow, snow)

    def line(self, points: ArrayLike, width: float, color: Color) -> None:
        """An open line through points `[n, 2]`; it neither glows nor takes snow."""
        corners = np.rint(np.asarray(points, float) * self.scale * 16).astype(np.int32)
        cv2.polylines(self.day, [corners], False, (*color, 255), max(1, round(width * self.scale)), shift=4)

    def shade(self, gain: Floats) -> None:
        """Multiply the colors by `gain`, broadcast over rows, columns and channels."""
        self.day[..., :3] = np.clip(self.day[..., :3] * gain, 0, 255)

    def settle_snow(self, amount: ArrayLike) -> None:
        """Let snow settle on the whole sheet: `amount` is 0..255, broadcast over rows and columns."""
        self.effects[..., 3] = amount


def texture(sheet: Sheet, lamp_light: Floats | float = 0.0, sun: float = 1.0) -> Texture:
    """The texture of a finished sheet, computed when a weather is first used.

    `lamp_light` (0..1, broadcast over rows and columns) is the light of street lamps on the sheet, `sun` the gain of
    a surface with this orientation to the sun.
    """
    light = np.asarray(lamp_light, np.float32)

    @cache
    def seen_in(weather: Weather) -> Image:
        lamps = np.broadcast_to(light, sheet.day.shape[:2])[..., None]
        color = sheet.day[..., :3].astype(np.float32)
        glow, cover = sheet.effects[..., :3].astype(np.float32), sheet.effects[..., 3:].astype(np.float32) / 255
        ambient = np.multiply(weather.ambient, 1 + weather.sun * (sun - 1), dtype=np.float32)
        seen = np.maximum(color * (ambient + lamps * as_array(weather.lamp)), weather.glow * glow)
        seen += weather.snow * cover * (as_array(tone(weather.horizon, 1.15)) - seen)
        return np.dstack([np.clip(seen, 0, 255).astype(np.uint8), sheet.day[..., 3]])

    return seen_in


def blotches(rng: Rng, shape: tuple[int, int], cell: float) -> Floats:
    """Smooth noise with a standard deviation of about 1 and spots `cell` px wide."""
    rows, columns = (max(2, round(n / cell)) for n in shape)
    return cv2.resize(rng.standard_normal((rows, columns), np.float32), shape[::-1], interpolation=cv2.INTER_CUBIC)


def draw_glyphs(sheet: Sheet, rng: Rng, x: float, y: float, width: float, height: float, color: Color) -> None:
    """Draw a word of random glyphs, whose strokes connect points of a small grid."""
    step = height * 0.85
    for left in np.arange(x, x + width - 0.6 * step, step):
        nodes = rng.integers(0, (3, 4), (5, 2)) / (2, 3) * (0.6 * step, height)
        sheet.line(nodes + (left, y), height * 0.14, color)


@dataclass(frozen=True)
class Panel:
    """A flat parallelogram, in meters: its upper left corner and its edges to the right and down on its front."""

    texture: Texture
    corner: tuple[float, float, float]
    right: tuple[float, float, float]
    down: tuple[float, float, float]


@dataclass(frozen=True)
class Prop:
    """Panels that are painted together, in this order; z (meters) is that of the middle, for sorting."""

    z: float
    panels: tuple[Panel, ...]


def upright(texture: Texture, x: float, z: float, width: float, height: float) -> Prop:
    """A panel that stands on the ground across the street, with its middle at x; all in meters."""
    return Prop(z, (Panel(texture, (x - width / 2, -height, z), (width, 0, 0), (0, height, 0)),))


def move(prop: Prop, x: float, z: float) -> Prop:
    """The prop, moved along the ground by x and z meters."""
    panels = (replace(p, corner=(p.corner[0] + x, p.corner[1], p.corner[2] + z)) for p in prop.panels)
    return Prop(prop.z + z, tuple(panels))
