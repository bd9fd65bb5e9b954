"""The table of weathers: all settings of the drawing that depend on hour and season."""

from dataclasses import dataclass

from mfvpr.datasets.streets.colors import Color


@dataclass(frozen=True)
class Exposure:
    """Strength of the effects of lens, air and sensor, in px of an image 448 px wide; 0 leaves an effect out.

    Some effects grow with the frame's `severity`, which is heavy-tailed: see `exposure.expose`.
    """

    noise: float  # standard deviation of the sensor's noise, in levels of 0..255
    motion: float = 0.0  # width of the blur along the turn, px per unit of severity
    bloom: float = 0.0  # gain on the glow around bright lights
    defocus: float = 0.0  # least standard deviation of the blur, px of the drawn image
    defocus_spread: float = 0.0  # largest random addition to it, px
    drops: float = 0.0  # addition to it by drops on the lens, px per unit of severity
    flakes: float = 0.0  # mean number of snow flakes per image
    streaks: float = 0.0  # mean number of rain streaks per image


@dataclass(frozen=True)
class Weather:
    """Light and colors of the street at one hour and season; colors are RGB gains or RGB values 0..255."""

    ambient: tuple[float, float, float]  # gain on the day colors
    lamp: tuple[float, float, float]  # further gain right under a street lamp
    sun: float  # contrast between surfaces that face the sun and others, 0..1
    glow: float  # visibility of glowing parts, 0..1
    snow: float  # visibility of settled snow, 0..1
    zenith: Color
    horizon: Color  # also the color of the haze
    haze: float  # distance at which the haze has taken 63 %, meters
    exposure: Exposure


# New weathers go to the end: the position in the table seeds the clouds (see `scene.sky_texture`).
WEATHERS = {
    "day": Weather(
        ambient=(1.0, 1.0, 1.0), lamp=(0, 0, 0), sun=1.0, glow=0.0, snow=0.0,
        zenith=(92, 148, 214), horizon=(214, 226, 234), haze=160.0,
        exposure=Exposure(noise=1.0),
    ),
    "night": Weather(
        ambient=(0.26, 0.30, 0.45), lamp=(0.72, 0.52, 0.26), sun=0.0, glow=1.0, snow=0.0,
        zenith=(8, 12, 34), horizon=(44, 40, 62), haze=110.0,
        exposure=Exposure(noise=4.0, motion=0.4, bloom=1.0, defocus=0.7, defocus_spread=0.3),
    ),
    "snow": Weather(
        ambient=(0.56, 0.60, 0.70), lamp=(0.3, 0.22, 0.1), sun=0.0, glow=0.8, snow=0.95,
        zenith=(128, 138, 164), horizon=(184, 188, 204), haze=75.0,
        exposure=Exposure(noise=1.5, defocus=0.3, drops=0.08, flakes=130),
    ),
    "dawn": Weather(
        ambient=(0.68, 0.56, 0.52), lamp=(0.3, 0.21, 0.1), sun=0.4, glow=0.45, snow=0.0,
        zenith=(98, 112, 152), horizon=(236, 184, 152), haze=85.0,
        exposure=Exposure(noise=2.0, defocus=0.4),
    ),
    "dusk": Weather(
        ambient=(0.44, 0.41, 0.50), lamp=(0.5, 0.37, 0.18), sun=0.15, glow=0.85, snow=0.0,
        zenith=(44, 52, 96), horizon=(190, 122, 98), haze=120.0,
        exposure=Exposure(noise=3.0, motion=0.2, bloom=0.6, defocus=0.5),
    ),
    "night-rain": Weather(
        ambient=(0.23, 0.26, 0.38), lamp=(0.78, 0.58, 0.32), sun=0.0, glow=1.0, snow=0.0,
        zenith=(10, 12, 24), horizon=(42, 44, 58), haze=65.0,
        exposure=Exposure(noise=5.0, motion=0.4, bloom=1.4, defocus=0.7, defocus_spread=0.4, drops=0.1, streaks=110),
    ),
    "winter": Weather(
        ambient=(0.74, 0.76, 0.82), lamp=(0, 0, 0), sun=0.1, glow=0.2, snow=0.3,
        zenith=(168, 176, 188), horizon=(206, 210, 216), haze=110.0,
        exposure=Exposure(noise=1.5, defocus=0.3),
    ),
    "rain": Weather(
        ambient=(0.54, 0.56, 0.60), lamp=(0.2, 0.15, 0.08), sun=0.0, glow=0.5, snow=0.0,
        zenith=(112, 118, 128), horizon=(160, 164, 170), haze=70.0,
        exposure=Exposure(noise=2.0, defocus=0.4, drops=0.08, streaks=160),
    ),
}  # fmt: skip
