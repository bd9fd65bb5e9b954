"""The sky: clouds and a far skyline."""

from functools import cache

import numpy as np

from mfvpr.datasets.streets.camera import CAMERA_HEIGHT, Camera
from mfvpr.datasets.streets.colors import as_array, tone
from mfvpr.datasets.streets.panels import Panel, Prop
from mfvpr.datasets.streets.sheets import Texture, blotches
from mfvpr.datasets.streets.types import Image, Rng
from mfvpr.datasets.streets.weather import WEATHERS, Weather


def draw_sky(rng: Rng, weather: Weather) -> Image:
    """Sky, clouds and a far skyline, directly in the colors of the weather; the horizon is the lower edge."""
    rows, columns = shape = (256, 1024)
    height = np.linspace(1, 0, rows, dtype=np.float32)[:, None, None]
    zenith, horizon = as_array(weather.zenith), as_array(weather.horizon)
    sky = np.broadcast_to(horizon + (zenith - horizon) * height**0.6, (rows, columns, 3)).copy()
    cloud = sum(blotches(rng, shape, cell) * cell / 90 for cell in (90.0, 45.0, 20.0))
    cover = np.clip(cloud * 0.7, 0, 1)[..., None] * np.clip(height * 4, 0, 1)
    sky += cover * 0.7 * (as_array(tone(weather.horizon, 1.15)) - sky)
    for layer, gain in ((0.16, 0.92), (0.10, 0.8)):
        bumps = 0.35 * blotches(rng, (1, columns), 60) + 0.1 * blotches(rng, (1, columns), 8)
        ridge = rows * (1 - layer * (1 + bumps))
        hill = np.arange(rows)[:, None] > ridge
        sky[hill] = as_array(tone(weather.horizon, gain)) * as_array((0.92, 1.0, 0.98))
    return np.dstack([np.clip(sky, 0, 255).astype(np.uint8), np.full(shape, 255, np.uint8)])


def sky_texture(seed: int) -> Texture:
    """The sky of the street with this seed, whose clouds differ from weather to weather."""
    places = {weather: place for place, weather in enumerate(WEATHERS.values())}
    return cache(lambda weather: draw_sky(np.random.default_rng([seed, 5, places[weather]]), weather))


def sky_prop(sky: Texture, camera: Camera) -> Prop:
    """The sky, so far away that it moves along with the camera."""
    z = camera.z + 4.0
    return Prop(z, (Panel(sky, (camera.x - 8, -CAMERA_HEIGHT - 3.9, z), (16, 0, 0), (0, 4.0, 0)),))
