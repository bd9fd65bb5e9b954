"""Sheets: flat drawings in meters, the textures they become in each weather, and panels that carry textures.

A sheet has its colors on a summer day, its glow at night, and the amount of snow that settles, for use in any weather.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy.typing import ArrayLike

Image = UInt8[np.ndarray, "_ _ _"]  # rows, columns, channels
Floats = Float[np.ndarray, "..."]
Color = tuple[int, ...]  # RGB, 0..255
Rng = np.random.Generator
DARK = (0, 0, 0)


def tone(color: Color, gain: float) -> Color:
    return tuple(min(255, int(c * gain)) for c in color)


@dataclass(frozen=True)
class Weather:
    """All settings of the drawing that depend on hour and season.

    Effects are in px of an image 448 px wide. Some grow with the frame's heavy-tailed `severity`, see `expose`.
    """

    ambient: tuple[float, float, float]  # gain on the day colors
    zenith: Color
    horizon: Color  # also the color of the haze
    haze: float  # distance at which the haze has taken 63 %, meters
    noise: float  # standard deviation of the sensor's noise, in levels of 0..255
    lamp: tuple[float, float, float] = (0, 0, 0)  # further gain right under a street lamp
    sun: float = 0.0  # contrast between surfaces that face the sun and others, 0..1
    glow: float = 0.0  # visibility of glowing parts, 0..1
    snow: float = 0.0  # visibility of settled snow, 0..1
    motion: float = 0.0  # width of the blur along the turn, px per unit of severity
    bloom: float = 0.0  # gain on the glow around bright lights
    defocus: float = 0.0  # least standard deviation of the blur, px of the drawn image
    defocus_spread: float = 0.0  # largest random addition to it, px
    drops: float = 0.0  # addition to it by drops on the lens, px per unit of severity
    flakes: float = 0.0  # mean number of snow flakes per image
    streaks: float = 0.0  # mean number of rain streaks per image


# New weathers go to the end: the position in the table seeds the clouds (see `scene.CLOUDS`).
WEATHERS = {
    "day": Weather(
        ambient=(1.0, 1.0, 1.0), sun=1.0, zenith=(92, 148, 214), horizon=(214, 226, 234), haze=160.0, noise=1.0,
    ),
    "night": Weather(
        ambient=(0.26, 0.30, 0.45), lamp=(0.72, 0.52, 0.26), glow=1.0, zenith=(8, 12, 34), horizon=(44, 40, 62),
        haze=110.0, noise=4.0, motion=0.4, bloom=1.0, defocus=0.7, defocus_spread=0.3,
    ),
    "snow": Weather(
        ambient=(0.56, 0.60, 0.70), lamp=(0.3, 0.22, 0.1), glow=0.8, snow=0.95, zenith=(128, 138, 164),
        horizon=(184, 188, 204), haze=75.0, noise=1.5, defocus=0.3, drops=0.08, flakes=130,
    ),
    "dawn": Weather(
        ambient=(0.68, 0.56, 0.52), lamp=(0.3, 0.21, 0.1), sun=0.4, glow=0.45, zenith=(98, 112, 152),
        horizon=(236, 184, 152), haze=85.0, noise=2.0, defocus=0.4,
    ),
    "dusk": Weather(
        ambient=(0.44, 0.41, 0.50), lamp=(0.5, 0.37, 0.18), sun=0.15, glow=0.85, zenith=(44, 52, 96),
        horizon=(190, 122, 98), haze=120.0, noise=3.0, motion=0.2, bloom=0.6, defocus=0.5,
    ),
    "night-rain": Weather(
        ambient=(0.23, 0.26, 0.38), lamp=(0.78, 0.58, 0.32), glow=1.0, zenith=(10, 12, 24), horizon=(42, 44, 58),
        haze=65.0, noise=5.0, motion=0.4, bloom=1.4, defocus=0.7, defocus_spread=0.4, drops=0.1, streaks=110,
    ),
    "winter": Weather(
        ambient=(0.74, 0.76, 0.82), sun=0.1, glow=0.2, snow=0.3, zenith=(168, 176, 188), horizon=(206, 210, 216),
        haze=110.0, noise=1.5, defocus=0.3,
    ),
    "rain": Weather(
        ambient=(0.54, 0.56, 0.60), lamp=(0.2, 0.15, 0.08), glow=0.5, zenith=(112, 118, 128), horizon=(160, 164, 170),
        haze=70.0, noise=2.0, defocus=0.4, drops=0.08, streaks=160,
    ),
}  # fmt: skip


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

    def rect(self, x: float, y: float, w: float, h: float, color: Color, glow: Color = DARK, snow: int = 0) -> None:
        x0, y0, x1, y1 = (max(0, round(a * self.scale)) for a in (x, y, x + w, y + h))
        self.day[y0:y1, x0:x1] = (*color, 255)
        self.effects[y0:y1, x0:x1] = (*glow, snow)

    def polygon(self, points: ArrayLike, color: Color, glow: Color = DARK, snow: int = 0) -> None:
        corners = [np.rint(np.asarray(points, float) * self.scale * 16).astype(np.int32)]
        cv2.fillPoly(self.day, corners, (*color, 255), shift=4)
        cv2.fillPoly(self.effects, corners, (*glow, snow), shift=4)

    def ellipse(
        self, x: float, y: float, rx: float, ry: float, color: Color, glow: Color = DARK, snow: int = 0
    ) -> None:
        angles = np.linspace(0, 2 * np.pi, 20, endpoint=False)
        points = np.stack([x + rx * np.cos(angles), y + ry * np.sin(angles)], 1)
        self.polygon(points, color, glow, snow)

    def line(self, points: ArrayLike, width: float, color: Color) -> None:
        """An open line through points `[n, 2]`; it neither glows nor takes snow."""
        corners = np.rint(np.asarray(points, float) * self.scale * 16).astype(np.int32)
        cv2.polylines(self.day, [corners], False, (*color, 255), max(1, round(width * self.scale)), shift=4)

    def shade(self, gain: Floats) -> None:
        self.day[..., :3] = np.clip(self.day[..., :3] * gain, 0, 255)

    def glyphs(self, rng: Rng, x: float, y: float, width: float, height: float, color: Color) -> None:
        """A word of random glyphs, whose strokes connect points of a small grid."""
        step = height * 0.85
        for left in np.arange(x, x + width - 0.6 * step, step):
            nodes = rng.integers(0, (3, 4), (5, 2)) / (2, 3) * (0.6 * step, height)
            self.line(nodes + (left, y), height * 0.14, color)

    def texture(self, lamp_light: Floats | float = 0.0, sun: float = 1.0) -> Texture:
        """The texture of the finished sheet, computed when a weather is first used.

        `lamp_light` (0..1, broadcast over rows and columns) is the light of street lamps on the sheet, `sun` the gain
        of a surface with this orientation to the sun.
        """
        light = np.asarray(lamp_light, np.float32)

        @cache
        def seen_in(weather: Weather) -> Image:
            lamps = np.broadcast_to(light, self.day.shape[:2])[..., None]
            color = self.day[..., :3].astype(np.float32)
            glow, cover = self.effects[..., :3].astype(np.float32), self.effects[..., 3:].astype(np.float32) / 255
            ambient = np.multiply(weather.ambient, 1 + weather.sun * (sun - 1), dtype=np.float32)
            seen = np.maximum(color * (ambient + lamps * np.array(weather.lamp, np.float32)), weather.glow * glow)
            seen += weather.snow * cover * (np.array(tone(weather.horizon, 1.15), np.float32) - seen)
            return np.dstack([np.clip(seen, 0, 255).astype(np.uint8), self.day[..., 3]])

        return seen_in


def blotches(rng: Rng, shape: tuple[int, int], cell: float) -> Floats:
    """Smooth noise with a standard deviation of about 1 and spots `cell` px wide."""
    rows, columns = (max(2, round(n / cell)) for n in shape)
    return cv2.resize(rng.standard_normal((rows, columns), np.float32), shape[::-1], interpolation=cv2.INTER_CUBIC)


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

    @classmethod
    def upright(cls, texture: Texture, x: float, z: float, width: float, height: float) -> "Prop":
        """A panel that stands on the ground across the street, with its middle at x; all in meters."""
        return cls(z, (Panel(texture, (x - width / 2, -height, z), (width, 0, 0), (0, height, 0)),))

    def move(self, x: float, z: float) -> "Prop":
        panels = (replace(p, corner=(p.corner[0] + x, p.corner[1], p.corner[2] + z)) for p in self.panels)
        return Prop(self.z + z, tuple(panels))
