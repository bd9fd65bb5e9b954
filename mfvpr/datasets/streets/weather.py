"""Colors of the street, its light by hour and season, and the effects of lens, air and sensor on an image."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

Image = UInt8[np.ndarray, "_ _ _"]  # rows, columns, channels
Floats = Float[np.ndarray, "..."]
Color = tuple[int, int, int]  # RGB, 0..255
Rng = np.random.Generator

WALLS = (
    (226, 205, 160),
    (214, 170, 130),
    (196, 120, 96),
    (170, 184, 160),
    (176, 188, 200),
    (232, 224, 208),
    (205, 150, 140),
    (186, 160, 120),
    (150, 92, 78),
    (216, 190, 190),
)
TRIMS = ((245, 240, 230), (230, 222, 205), (120, 110, 104))
ACCENTS = ((150, 48, 44), (38, 84, 124), (40, 96, 74), (196, 148, 48), (92, 60, 110), (48, 52, 60), (208, 96, 48))
ROOFS = ((158, 82, 62), (132, 74, 62), (92, 92, 102), (112, 84, 76))
CARS = ((186, 44, 40), (40, 72, 130), (228, 228, 226), (60, 64, 70), (150, 156, 160), (64, 104, 84), (214, 178, 70))
GLASS, WARM, DARK = (62, 76, 92), (255, 196, 110), (0, 0, 0)


def as_array(color: tuple[float, float, float]) -> Float[np.ndarray, "3"]:
    return np.array(color, np.float32)


def pick(rng: Rng, colors: tuple[Color, ...]) -> Color:
    return colors[int(rng.integers(len(colors)))]


def tone(color: Color, gain: float) -> Color:
    """The color, lighter or darker."""
    red, green, blue = (min(255, int(c * gain)) for c in color)
    return red, green, blue


@dataclass(frozen=True)
class Weather:
    """All settings of the drawing that depend on hour and season; colors are RGB gains or RGB values 0..255.

    Effects are in px of an image 448 px wide; 0 leaves an effect out. Some grow with the frame's `severity`, which is
    heavy-tailed: see `expose`.
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


def expose(image: Image, weather: Weather, rng: Rng) -> Image:
    """The image with all effects of its weather; a few frames are much worse than the rest."""
    seen = image.astype(np.float32)
    # Heavy-tailed: below 1 in six of ten frames, above 10 in one of ten.
    severity = min(rng.exponential() ** 3, 20.0) * image.shape[1] / 448
    if weather.motion:  # long exposures blur along the turn
        seen = cv2.blur(seen, (1 + int(weather.motion * severity), 1))
    if weather.bloom:  # a glow around bright lights, as from a lens
        small = cv2.resize(seen, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
        bright = np.maximum(small - 150, 0)
        spread = 0.6 * cv2.GaussianBlur(bright, (0, 0), 2) + 0.9 * cv2.GaussianBlur(bright, (0, 0), 7)
        seen = seen + weather.bloom * cv2.resize(spread, seen.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    defocus = weather.defocus + weather.drops * severity
    if weather.defocus_spread:
        defocus += weather.defocus_spread * rng.random()
    if defocus:
        seen = cv2.GaussianBlur(seen, (0, 0), defocus)
    if weather.flakes:
        seen = fall_snow(seen, int(rng.uniform(0.5, 1.5) * weather.flakes), rng)
    if weather.streaks:
        seen = fall_rain(seen, int(rng.uniform(0.5, 1.5) * weather.streaks), rng)
    seen += weather.noise * rng.standard_normal(seen.shape, np.float32)
    return np.clip(seen, 0, 255).astype(np.uint8)


def fall_snow(image: Floats, count: int, rng: Rng) -> Floats:
    """The image with `count` flakes of several sizes in front."""
    height, width = image.shape[:2]
    flakes = np.zeros((height, width), np.uint8)
    for x, y, radius in rng.uniform((0, 0, width / 1100), (width, height, width / 240), (count, 3)):
        center = (round(x * 16), round(y * 16))
        cv2.circle(flakes, center, round(radius * 16), int(rng.integers(70, 180)), -1, cv2.LINE_AA, 4)
    share = cv2.GaussianBlur(flakes, (0, 0), 0.8).astype(np.float32)[..., None] / 255
    return image + share * (245 - image)


def fall_rain(image: Floats, count: int, rng: Rng) -> Floats:
    """The image with `count` streaks of several lengths in front, all blown to the same side."""
    height, width = image.shape[:2]
    streaks, slant = np.zeros((height, width), np.uint8), rng.uniform(-0.3, 0.3)
    for x, y, length in rng.uniform((0, 0, width / 60), (width, height, width / 14), (count, 3)):
        start, end = (round(x * 16), round(y * 16)), (round((x + slant * length) * 16), round((y + length) * 16))
        cv2.line(streaks, start, end, int(rng.integers(40, 120)), 1, cv2.LINE_AA, 4)
    share = cv2.GaussianBlur(streaks, (0, 0), 0.6).astype(np.float32)[..., None] / 255
    return image + share * (image.mean() + 60 - image)
