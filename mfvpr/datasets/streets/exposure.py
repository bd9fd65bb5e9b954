"""Effects of lens, air and sensor on a painted image."""

import cv2
import numpy as np

from mfvpr.datasets.streets.colors import Floats, Image, Rng
from mfvpr.datasets.streets.weather import Weather


def expose(image: Image, weather: Weather, rng: Rng) -> Image:
    """The image with all effects of its weather; a few frames are much worse than the rest."""
    exposure, seen = weather.exposure, image.astype(np.float32)
    # Heavy-tailed: below 1 in six of ten frames, above 10 in one of ten.
    severity = min(rng.exponential() ** 3, 20.0) * image.shape[1] / 448
    if exposure.motion:  # long exposures blur along the turn
        seen = cv2.blur(seen, (1 + int(exposure.motion * severity), 1))
    if exposure.bloom:
        seen = bloom(seen, exposure.bloom)
    defocus = exposure.defocus + exposure.drops * severity
    if exposure.defocus_spread:
        defocus += exposure.defocus_spread * rng.random()
    if defocus:
        seen = cv2.GaussianBlur(seen, (0, 0), defocus)
    if exposure.flakes:
        seen = fall_snow(seen, int(rng.uniform(0.5, 1.5) * exposure.flakes), rng)
    if exposure.streaks:
        seen = fall_rain(seen, int(rng.uniform(0.5, 1.5) * exposure.streaks), rng)
    seen += exposure.noise * rng.standard_normal(seen.shape, np.float32)
    return np.clip(seen, 0, 255).astype(np.uint8)


def bloom(image: Floats, gain: float) -> Floats:
    """The image with a glow around bright lights, as from a lens."""
    small = cv2.resize(image, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    bright = np.maximum(small - 150, 0)
    spread = 0.6 * cv2.GaussianBlur(bright, (0, 0), 2) + 0.9 * cv2.GaussianBlur(bright, (0, 0), 7)
    return image + gain * cv2.resize(spread, image.shape[1::-1], interpolation=cv2.INTER_LINEAR)


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
