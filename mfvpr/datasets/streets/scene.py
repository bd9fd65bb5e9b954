"""The street: houses on both sides, ground, trees, lamps, signs, cars, and the sky."""

from dataclasses import dataclass
from functools import cache

import numpy as np

from mfvpr.datasets.streets.camera import CAMERA_HEIGHT, Camera, Facade
from mfvpr.datasets.streets.colors import WALLS, Image, Rng, as_array, pick, tone
from mfvpr.datasets.streets.houses import Design, draw_facade, draw_gable, draw_roof, make_design
from mfvpr.datasets.streets.objects import Car, build_car, draw_ground, draw_hedge, draw_lamp, draw_sign, draw_tree
from mfvpr.datasets.streets.sheets import Panel, Prop, Texture, blotches, texture, upright
from mfvpr.datasets.streets.weather import WEATHERS, Weather

LAMP_SPACING = 22.0  # meters
NUM_CARS = 24


@dataclass(frozen=True)
class Scene:
    """All objects of the street; ground, houses and street are painted as one layer each."""

    ground: tuple[Prop, ...]
    houses: tuple[Prop, ...]
    street: tuple[Prop, ...]
    facades: tuple[Facade, ...]
    cars: tuple[Car, ...]
    sky: Texture


def build_scene(seed: int, length: float) -> Scene:
    """The street from z = 0 to `length` meters."""
    rows = [build_row(seed, side, length) for side in (-1, 1)]
    return Scene(
        ground=tuple(build_ground(seed, length)),
        houses=tuple(prop for props, _ in rows for prop in props),
        street=tuple(build_furniture(seed, length)),
        facades=tuple(facade for _, facades in rows for facade in facades),
        cars=tuple(build_car(seed, index) for index in range(NUM_CARS)),
        sky=sky_texture(seed),
    )


def lamp_light(z: np.ndarray) -> np.ndarray:
    """Light of the street lamps at z (meters), 0..1."""
    return np.exp(-((((z + LAMP_SPACING / 2) % LAMP_SPACING - LAMP_SPACING / 2) / 5.0) ** 2))


def build_row(seed: int, side: int, length: float) -> tuple[list[Prop], list[Facade]]:
    """The houses of one side of the street (-1: left, 1: right), now and then with a garden in between."""
    rng = np.random.default_rng([seed, 1, side + 1])
    # Both sides take turns through the same few designs, so that the street looks alike every 35 m or so.
    designs = [make_design(np.random.default_rng([seed, 0, index])) for index in range(4)]
    props, facades, z = [], [], 2.0
    while z < length:
        if rng.random() < 0.2:
            gap = rng.uniform(2.0, 4.0)
            props.append(build_tree(rng, side * 12.5, z + gap - 0.5))
            props.append(upright(texture(draw_hedge(rng, 5.0, 1.9)), side * 9.9, z + 0.2, 5.0, 1.9))
            z += gap
        design = designs[len(facades) % len(designs)]
        prop, facade = build_house(rng, design, side, rng.choice((7.4, 7.9, 8.4, 9.4)), z)
        props.append(prop)
        facades.append(facade)
        z += design.width
    return props, facades


def build_house(rng: Rng, design: Design, side: int, x: float, z: float) -> tuple[Prop, Facade]:
    """A house whose facade stands at side * x (side -1: left) from z onwards, in meters."""
    width, depth, rise = design.width, 9.0, rng.uniform(1.8, 3.4)
    wall = pick(rng, WALLS)
    sheet = draw_facade(rng, wall, design)
    height = sheet.height
    along = np.linspace(z, z + width, sheet.day.shape[1])[::-side]
    above = np.linspace(height, 0, sheet.day.shape[0])[:, None]
    light = lamp_light(along) * np.exp(-(((above - 3.5) / 3.0) ** 2))
    near, far = (z, z + width) if side < 0 else (z + width, z)
    step = (0.0, 0.0, far - near)
    inner, middle, outer, top = side * x, side * (x + depth / 2), side * (x + depth), -height - rise
    facade = Panel(texture(sheet, light, 1.06 if side < 0 else 0.84), (inner, -height, near), step, (0, height, 0))
    slope = texture(draw_roof(rng, width, float(np.hypot(depth / 2, rise))), sun=1.05)
    roof = Panel(slope, (middle, top, near), step, (-side * depth / 2, rise, 0))
    end = texture(draw_gable(rng, wall, depth, height, rise))
    gable = Panel(end, (min(inner, outer), top, z), (depth, 0, 0), (0, height + rise, 0))
    return Prop(z + width / 2, (gable, roof, facade)), Facade(inner, z, z + width, height)


def build_tree(rng: Rng, x: float, z: float) -> Prop:
    """A tree with its trunk at x and z, in meters."""
    width, height = rng.uniform(3.0, 4.4), rng.uniform(5.0, 6.6)
    return upright(texture(draw_tree(rng, width, height), 0.5 * lamp_light(np.array(z))), x, z, width, height)


def build_furniture(seed: int, length: float) -> list[Prop]:
    """Lamps, trees and signs along both sidewalks."""
    rng = np.random.default_rng([seed, 2])
    lamp = texture(draw_lamp())
    places = enumerate(np.arange(LAMP_SPACING, length, LAMP_SPACING))
    props = [upright(lamp, 5.4 if index % 2 else -5.4, z, 1.0, 5.2) for index, z in places]
    for side in (-1, 1):
        for z in np.arange(6.0, length, 11.0):
            kind = rng.random()
            if kind < 0.35:
                props.append(build_tree(rng, side * 5.6, z + rng.uniform(-2, 2)))
            elif kind < 0.75:
                props.append(upright(texture(draw_sign(rng)), side * 4.9, z + rng.uniform(-3, 3), 0.9, 2.9))
    return props


def build_ground(seed: int, length: float) -> list[Prop]:
    """Strips of 8 m, seen from above; the first lies partly behind the first camera."""
    props = []
    for index, z in enumerate(np.arange(-8.0, length, 8.0)):
        sheet = draw_ground(np.random.default_rng([seed, 3, index]), 12.0, 8.0)
        across = np.linspace(-12, 12, sheet.day.shape[1])
        light = lamp_light(np.linspace(z + 8, z, sheet.day.shape[0]))[:, None] * np.exp(-((across / 8) ** 2))
        props.append(Prop(z + 4, (Panel(texture(sheet, 0.8 * light), (-12, 0, z + 8), (24, 0, 0), (0, 0, -8)),)))
    return props


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
