"""The street: houses on both sides, ground, trees, lamps, signs, cars, and the sky."""

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np

from mfvpr.datasets.streets.camera import Facade
from mfvpr.datasets.streets.houses import Design, draw_facade, draw_wall
from mfvpr.datasets.streets.objects import Car, build_car, draw_lamp, draw_sign
from mfvpr.datasets.streets.sheets import Panel, Prop, Sheet, Texture, blotches, texture, upright
from mfvpr.datasets.streets.weather import ROOFS, WALLS, WEATHERS, Image, Rng, Weather, as_array, pick, tone

LAMP_SPACING = 22.0  # meters
NUM_CARS = 24
CLOUDS = {weather: place for place, weather in enumerate(WEATHERS.values())}  # seeds of the clouds of each weather


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
    strips = enumerate(np.arange(-8.0, length, 8.0))  # the first lies partly behind the first camera
    return Scene(
        ground=tuple(build_ground(np.random.default_rng([seed, 3, index]), z) for index, z in strips),
        houses=tuple(prop for props, _ in rows for prop in props),
        street=tuple(build_furniture(seed, length)),
        facades=tuple(facade for _, facades in rows for facade in facades),
        cars=tuple(build_car(seed, index) for index in range(NUM_CARS)),
        sky=cache(lambda weather: draw_sky(np.random.default_rng([seed, 5, CLOUDS[weather]]), weather)),
    )


def lamp_light(z: np.ndarray) -> np.ndarray:
    """Light of the street lamps at z (meters), 0..1."""
    return np.exp(-((((z + LAMP_SPACING / 2) % LAMP_SPACING - LAMP_SPACING / 2) / 5.0) ** 2))


def build_row(seed: int, side: int, length: float) -> tuple[list[Prop], list[Facade]]:
    """The houses of one side of the street (-1: left, 1: right), now and then with a garden in between."""
    rng = np.random.default_rng([seed, 1, side + 1])
    # Both sides take turns through the same few designs, so that the street looks alike every 35 m or so.
    designs = [Design(np.random.default_rng([seed, 0, index])) for index in range(4)]
    props, facades, z = [], [], 2.0
    while z < length:
        if rng.random() < 0.2:
            gap = rng.uniform(2.0, 4.0)
            props.append(build_tree(rng, side * 12.5, z + gap - 0.5))
            hedge = Sheet(5.0, 1.9, None)
            for x, y in rng.uniform((0.1, 0.15), (4.9, 1.9), (500, 2)):
                light = 1.15 - 0.4 * y / 1.9 + rng.uniform(-0.2, 0.2)
                hedge.ellipse(x, y, 0.17, 0.14, tone((80, 118, 60), light), snow=int(150 * light))
            props.append(upright(texture(hedge), side * 9.9, z + 0.2, 5.0, 1.9))
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
    slope = Sheet(width, float(np.hypot(depth / 2, rise)), pick(rng, ROOFS), scale=16)
    shape = slope.day.shape[:2]
    slope.settle_snow(np.clip(225 + 20 * blotches(rng, shape, 12), 0, 250))
    tiles = 1 - 0.18 * (np.arange(shape[0]) % 5 == 0)[:, None]
    slope.shade((tiles * (1 + 0.08 * blotches(rng, shape, 4)))[..., None])
    roof = Panel(texture(slope, sun=1.05), (middle, top, near), step, (-side * depth / 2, rise, 0))
    end = Sheet(depth, height + rise, tone(wall, 0.86), scale=16)  # the side under the pointed roof
    draw_wall(end, rng)
    for corner in ([(0, 0), (depth / 2, 0), (0, rise)], [(depth, 0), (depth / 2, 0), (depth, rise)]):
        cv2.fillPoly(end.day, [np.rint(np.array(corner) * end.scale).astype(np.int32)], (0, 0, 0, 0))
    gable = Panel(texture(end), (min(inner, outer), top, z), (depth, 0, 0), (0, height + rise, 0))
    return Prop(z + width / 2, (gable, roof, facade)), Facade(inner, z, z + width, height)


def build_tree(rng: Rng, x: float, z: float) -> Prop:
    """A tree in leaf with its trunk at x and z, in meters: trunk, branches and a round crown of many dabs."""
    width, height = rng.uniform(3.0, 4.4), rng.uniform(5.0, 6.6)
    sheet = Sheet(width, height, None)
    middle, bark = width / 2, (88, 68, 54)
    sheet.line([(middle, height), (middle + 0.1, 0.45 * height)], 0.28, bark)
    for end in rng.uniform(0.25, 0.75, 5) * width:
        sheet.line([(middle, 0.62 * height), (end, 0.25 * height)], 0.1, bark)
    leaf = tone((92, 132, 62), rng.uniform(0.8, 1.1))
    for angle, radius in zip(rng.uniform(0, 2 * np.pi, 700), np.sqrt(rng.random(700)), strict=True):
        u, v = middle + radius * 0.42 * width * np.cos(angle), 0.34 * height * (1 + 0.85 * radius * np.sin(angle))
        light = 1.15 - 0.5 * v / (0.68 * height) + rng.uniform(-0.1, 0.1)
        size = rng.uniform(0.07, 0.2)
        sheet.ellipse(u, v, size, 0.8 * size, tone(leaf, light), snow=int(rng.uniform(120, 220) * min(1.0, light)))
    return upright(texture(sheet, 0.5 * lamp_light(np.array(z))), x, z, width, height)


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


def build_ground(rng: Rng, z: float) -> Prop:
    """A strip of 8 m from z onwards, seen from above: y runs against the driving direction."""
    sheet, middle, length = Sheet(24.0, 8.0, (164, 158, 148), scale=24), 12.0, 8.0
    for y in np.arange(0, length, 1.0):  # slabs of the sidewalk
        sheet.rect(0, y, 2 * middle, 0.05, (136, 130, 122))
    for x in np.arange(0, 2 * middle, 1.0):
        sheet.rect(x, 0, 0.05, length, (136, 130, 122))
    sheet.rect(middle - 4.4, 0, 8.8, length, (196, 192, 184))
    sheet.rect(middle - 4.2, 0, 8.4, length, (98, 98, 102))
    for _ in range(rng.integers(0, 3)):  # patches and manholes
        x, y = rng.uniform((middle - 3.8, 0), (middle + 2, length - 2))
        sheet.rect(x, y, rng.uniform(0.6, 1.8), rng.uniform(0.8, 2.0), tone((98, 98, 102), rng.uniform(0.75, 1.15)))
        sheet.ellipse(middle + rng.uniform(-3, 3), y, 0.35, 0.35, (70, 68, 66))
    for y in np.arange(0, length, 4.0):
        sheet.rect(middle - 0.08, y, 0.16, 2.2, (222, 220, 210))
    if rng.random() < 0.15:
        for x in np.arange(-3.8, 3.8, 1.0):
            sheet.rect(middle + x, length / 2 - 1.5, 0.5, 3.0, (226, 224, 216))
    # Grain and stains on the strip, and snow that is thinner where wheels have passed.
    shape = sheet.day.shape[:2]
    fade = np.sin(np.linspace(0, np.pi, shape[0]))[:, None]  # no stain may end at the edge of a strip
    grain = 0.03 * rng.standard_normal(shape, np.float32)
    sheet.shade((1 + grain + 0.05 * fade * blotches(rng, shape, 30))[..., None])
    x = np.linspace(-sheet.width / 2, sheet.width / 2, shape[1])
    ruts = sum(np.exp(-(((x - rut) / 0.24) ** 4)) for rut in (-2.7, -1.2, 1.2, 2.7))
    sheet.settle_snow(np.clip(235 - 110 * ruts + 18 * fade * blotches(rng, shape, 10), 0, 250))
    light = lamp_light(np.linspace(z + 8, z, shape[0]))[:, None] * np.exp(-((np.linspace(-12, 12, shape[1]) / 8) ** 2))
    return Prop(z + 4, (Panel(texture(sheet, 0.8 * light), (-12, 0, z + 8), (24, 0, 0), (0, 0, -8)),))


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
