"""The street: houses on both sides, ground, trees, lamps, signs, cars, and the sky.

The order of the random numbers decides the pixels: changing it is a new `drawing.VERSION`.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import cv2
import numpy as np

from mfvpr.datasets.streets.sheets import WEATHERS, Color, Panel, Prop, Rng, Sheet, Texture, Weather, blotches, tone


def colors(text: str) -> tuple[Color, ...]:
    """Colors from hexadecimal numbers RRGGBB."""
    return tuple(tuple(bytes.fromhex(word)) for word in text.split())


WALLS = colors("e2cda0 d6aa82 c47860 aab8a0 b0bcc8 e8e0d0 cd968c baa078 965c4e d8bebe")
TRIMS = colors("f5f0e6 e6decd 786e68")
ACCENTS = colors("96302c 26547c 28604a c49430 5c3c6e 30343c d06030")
ROOFS = colors("9e523e 844a3e 5c5c66 70544c")
CARS = colors("ba2c28 284882 e4e4e2 3c4046 969ca0 406854 d6b246")
GLASS, WARM = colors("3e4c5c ffc46e")

LANE = 1.8  # x of the driving lane, meters
LAMP_SPACING = 22.0  # meters
NUM_CARS = 24
CLOUDS = {weather: place for place, weather in enumerate(WEATHERS.values())}  # seeds of the clouds of each weather
# Where cars may be: x, smallest and largest distance ahead of the camera (meters), whether oncoming.
TRAFFIC = ((LANE, 7, 25, 0), (-LANE, 5, 22, 1), (-LANE, 25, 50, 1), (4.0, 5, 18, 0), (4.0, 25, 50, 0), (-4.0, 5, 18, 1))

Car = tuple[Prop, Prop]  # a car with its middle at x = 0 and its near end at z = 0: seen from behind, and oncoming


class Facade(NamedTuple):
    """The street side of a house, in meters: the plane x = `x` between two z, up to `height`."""

    x: float
    start: float
    end: float
    height: float


# Window types, shared by many houses: width and height in meters, columns and rows of panes, ornament.
MOTIFS = (
    (1.0, 1.6, 2, 3, "shutters"),
    (1.1, 1.7, 2, 2, "arch"),
    (1.7, 1.4, 3, 1, "lintel"),
    (1.1, 2.1, 2, 3, "railing"),
    (1.2, 1.5, 2, 4, "lintel"),
)

# Shapes of cars, in meters: length, width, heights of hood and roof; where glass and roof start, from rear and front.
BODIES = (
    (4.3, 1.75, 0.92, 1.45, (0.15, 0.7), (1.3, 2.1)),
    (4.6, 1.8, 0.95, 1.42, (0.7, 1.3), (1.3, 2.1)),
    (5.4, 2.0, 1.15, 2.5, (0.02, 0.06), (0.8, 1.5)),
)


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


def pick(rng: Rng, values: tuple[Any, ...]) -> Any:
    return values[int(rng.integers(len(values)))]


def lamp_light(z: np.ndarray) -> np.ndarray:
    """Light of the street lamps at z (meters), 0..1."""
    return np.exp(-((((z + LAMP_SPACING / 2) % LAMP_SPACING - LAMP_SPACING / 2) / 5.0) ** 2))


def build_row(seed: int, side: int, length: float) -> tuple[list[Prop], list[Facade]]:
    """The houses of one side of the street (-1: left, 1: right), now and then with a garden in between."""
    rng = np.random.default_rng([seed, 1, side + 1])
    # Both sides take turns through the same few designs, so that the street looks alike every 35 m or so.
    designs = []  # window type, width in meters, floors above the ground floor, whether there is a shop
    for index in range(4):
        draw = np.random.default_rng([seed, 0, index])
        designs.append((pick(draw, MOTIFS), draw.uniform(6.0, 11.0), int(draw.integers(1, 4)), draw.random() < 0.5))
    props, facades, z = [], [], 2.0
    while z < length:
        if rng.random() < 0.2:
            gap = rng.uniform(2.0, 4.0)
            props.append(build_tree(rng, side * 12.5, z + gap - 0.5))
            hedge = Sheet(5.0, 1.9, None)
            for x, y in rng.uniform((0.1, 0.15), (4.9, 1.9), (500, 2)):
                light = 1.15 - 0.4 * y / 1.9 + rng.uniform(-0.2, 0.2)
                hedge.ellipse(x, y, 0.17, 0.14, tone((80, 118, 60), light), snow=int(150 * light))
            props.append(Prop.upright(hedge.texture(), side * 9.9, z + 0.2, 5.0, 1.9))
            z += gap
        design = designs[len(facades) % len(designs)]
        prop, facade = build_house(rng, design, side, rng.choice((7.4, 7.9, 8.4, 9.4)), z)
        props.append(prop)
        facades.append(facade)
        z = facade.end
    return props, facades


def build_house(rng: Rng, design: tuple, side: int, x: float, z: float) -> tuple[Prop, Facade]:
    """A house whose facade stands at side * x (side -1: left) from z onwards, in meters."""
    width, depth, rise, wall = design[1], 9.0, rng.uniform(1.8, 3.4), pick(rng, WALLS)
    sheet = draw_facade(rng, wall, design)
    height = sheet.height
    along = np.linspace(z, z + width, sheet.day.shape[1])[::-side]
    above = np.linspace(height, 0, sheet.day.shape[0])[:, None]
    light = lamp_light(along) * np.exp(-(((above - 3.5) / 3.0) ** 2))
    near, far = (z, z + width) if side < 0 else (z + width, z)
    step = (0.0, 0.0, far - near)
    inner, middle, outer, top = side * x, side * (x + depth / 2), side * (x + depth), -height - rise
    facade = Panel(sheet.texture(light, 1.06 if side < 0 else 0.84), (inner, -height, near), step, (0, height, 0))
    slope = Sheet(width, float(np.hypot(depth / 2, rise)), pick(rng, ROOFS), scale=16)
    shape = slope.day.shape[:2]
    slope.effects[..., 3] = np.clip(225 + 20 * blotches(rng, shape, 12), 0, 250)
    tiles = 1 - 0.18 * (np.arange(shape[0]) % 5 == 0)[:, None]
    slope.shade((tiles * (1 + 0.08 * blotches(rng, shape, 4)))[..., None])
    roof = Panel(slope.texture(sun=1.05), (middle, top, near), step, (-side * depth / 2, rise, 0))
    end = Sheet(depth, height + rise, tone(wall, 0.86), scale=16)  # the side under the pointed roof
    draw_wall(end, rng)
    for corner in ([(0, 0), (depth / 2, 0), (0, rise)], [(depth, 0), (depth / 2, 0), (depth, rise)]):
        cv2.fillPoly(end.day, [np.rint(np.array(corner) * end.scale).astype(np.int32)], (0, 0, 0, 0))
    gable = Panel(end.texture(), (min(inner, outer), top, z), (depth, 0, 0), (0, height + rise, 0))
    return Prop(z + width / 2, (gable, roof, facade)), Facade(inner, z, z + width, height)


def draw_facade(rng: Rng, wall: Color, design: tuple) -> Sheet:
    """The street side of a house: a ground floor of 3.6 m, more floors of 3 m each, a cornice."""
    trim, accent = pick(rng, TRIMS), pick(rng, ACCENTS)
    motif, width, floors, is_shop = design
    sheet = Sheet(width, 4.1 + 3.0 * floors, wall)
    draw_wall(sheet, rng)
    # Marks that tell walls apart: flaked plaster with bare bricks, posters, scribbles.
    for _ in range(rng.integers(10, 22)):
        x, y = rng.uniform((0.3, 0.5), (sheet.width - 0.3, sheet.height - 0.5))
        angles = np.linspace(0, 2 * np.pi, 11)
        radii = rng.uniform(0.4, 1.0, 11) * rng.uniform(0.12, 0.45)
        flake = np.stack([x + radii * np.cos(angles), y + 0.7 * radii * np.sin(angles)], 1)
        sheet.polygon(flake, pick(rng, ((150, 96, 80), (196, 186, 170), (110, 100, 96))))
    for _ in range(rng.integers(2, 6)):
        x, y = rng.uniform(0.2, sheet.width - 1.2), sheet.height - rng.uniform(2.0, 2.6)
        w, h = rng.uniform(0.5, 1.0), rng.uniform(0.8, 1.3)
        sheet.rect(x, y, w, h, pick(rng, (*ACCENTS, *TRIMS)))
        for _ in range(4):
            sheet.polygon(rng.uniform(0.05, 0.95, (3, 2)) * (w, h) + (x, y), pick(rng, (*ACCENTS, *WALLS)))
        sheet.glyphs(rng, x + 0.08, y + 0.72 * h, w - 0.16, 0.2 * h, (30, 30, 34))
    if rng.random() < 0.5:
        start = (rng.uniform(0.5, sheet.width - 1.5), sheet.height - 1.4)
        sheet.glyphs(rng, *start, 1.5, rng.uniform(0.4, 0.8), pick(rng, ACCENTS))
    bays = int(width // 2.4)
    middles = (np.arange(bays) + 0.5) * width / bays
    for floor in range(floors):
        for x in middles:
            draw_window(sheet, rng, float(x), 1.1 + 3.0 * floor, motif, trim, accent)
    top = 0.5 + 3.0 * floors
    sheet.rect(0, top - 0.1, width, 0.18, trim, snow=180)
    if is_shop:  # a sign, an awning and a display window
        sheet.rect(0.3, top + 0.2, width - 0.6, 0.75, accent, tone(accent, 0.9))
        sheet.glyphs(rng, 0.6, top + 0.32, rng.uniform(0.5, 1.0) * (width - 1.2), 0.5, trim)
        sheet.rect(0.5, top + 1.1, width - 2.2, 2.1, (54, 52, 54), tone(WARM, 0.85))
        for x in np.arange(0.8, width - 2.4, 0.7):  # goods
            size = rng.uniform(0.2, 0.6)
            sheet.rect(x, top + 3.1 - size, 0.45, size, pick(rng, (*ACCENTS, *WALLS)), (150, 110, 60))
        sheet.rect(width - 1.5, top + 1.1, 1.1, sheet.height - top - 1.1, tone(accent, 0.7))
        sheet.rect(width - 1.35, top + 1.3, 0.8, 1.2, GLASS, tone(WARM, 0.7))
        if rng.random() < 0.5:
            for stripe, x in enumerate(np.arange(0.4, width - 1.8, 0.4)):
                sheet.rect(x, top + 1.0, 0.4, 0.7, trim if stripe % 2 else accent, snow=150)
    else:
        for x in middles[1:]:
            draw_window(sheet, rng, float(x), top + 1.0, MOTIFS[4], trim, accent)
        sheet.rect(middles[0] - 0.7, top + 0.7, 1.4, 2.9, trim)
        sheet.rect(middles[0] - 0.55, top + 0.85, 1.1, 2.75, accent)
    sheet.rect(0, 0, width, 0.3, tone(trim, 0.92), snow=120)
    return sheet


def draw_wall(sheet: Sheet, rng: Rng) -> None:
    """Bricks or plaster over the whole sheet, with stains and rain streaks of its own."""
    rows, columns = sheet.day.shape[:2]
    if rng.random() < 0.3:
        joint = tone(tuple(sheet.day[0, 0, :3].tolist()), 0.9)
        for row, y in enumerate(np.arange(0, sheet.height, 0.22)):
            sheet.rect(0, y, sheet.width, 0.04, joint)
            for x in np.arange(0.3 * (row % 2), sheet.width, 0.6):
                sheet.rect(x, y, 0.04, 0.22, joint)
    fine = 0.03 * rng.standard_normal((rows, columns), np.float32)
    patches = 0.05 * blotches(rng, (rows, columns), 40) + 0.05 * blotches(rng, (rows, columns), 12)
    streaks = 0.05 * blotches(rng, (1, columns), 5) * np.linspace(1, 0, rows, dtype=np.float32)[:, None]
    foot = 1 - 0.25 * np.exp(-np.linspace(sheet.height, 0, rows, dtype=np.float32) / 0.6)[:, None]
    sheet.shade(((1 + fine + patches + streaks) * foot)[..., None])


def draw_window(sheet: Sheet, rng: Rng, x: float, y: float, motif: tuple, trim: Color, accent: Color) -> None:
    """One window with its middle at x and its upper edge at y; one in four is lit at night."""
    w, h, columns, rows, ornament = motif
    left = x - w / 2
    glow = tone(WARM, rng.uniform(0.6, 1.0)) if rng.random() < 0.25 else (0, 0, 0)
    if ornament == "arch":
        sheet.ellipse(x, y, w / 2 + 0.1, 0.45, trim)
        sheet.ellipse(x, y, w / 2, 0.35, GLASS, glow)
    sheet.rect(left - 0.1, y - 0.1 * (ornament != "arch"), w + 0.2, h + 0.2, trim)
    sheet.rect(left, y, w, h, tone(GLASS, rng.uniform(0.7, 1.5)), glow)
    for side in (0, 1):  # curtains, each drawn a different way
        cloth = rng.uniform(0.05, 0.35) * w
        sheet.rect(left + side * (w - cloth), y, cloth, h * rng.uniform(0.5, 1), (198, 190, 178), tone(glow, 0.7))
    for column in range(1, columns):
        sheet.rect(left + w * column / columns - 0.03, y, 0.06, h, trim)
    for row in range(1, rows):
        sheet.rect(left, y + h * row / rows - 0.03, w, 0.06, trim)
    sheet.rect(left - 0.2, y + h + 0.08, w + 0.4, 0.12, tone(trim, 0.85), snow=240)
    if ornament == "shutters":
        for x in (left - 0.6, left + w + 0.1):
            sheet.rect(x, y - 0.05, 0.5, h + 0.1, accent)
            for slat in np.arange(0.12, h, 0.2):
                sheet.rect(x + 0.08, y + slat, 0.34, 0.06, tone(accent, 0.65))
    elif ornament == "lintel":
        sheet.rect(left - 0.25, y - 0.32, w + 0.5, 0.16, trim, snow=200)
    elif ornament == "railing":
        for x in np.arange(left - 0.15, left + w + 0.2, 0.14):
            sheet.rect(x, y + h - 0.9, 0.04, 0.9, (40, 40, 44))
        sheet.rect(left - 0.2, y + h - 0.95, w + 0.4, 0.07, (40, 40, 44), snow=220)
    if rng.random() < 0.3:  # flowers on the sill
        for x in rng.uniform(left, left + w, 7):
            sheet.ellipse(x, y + h + 0.02, 0.1, 0.1, pick(rng, ((70, 110, 60), (190, 60, 70), (220, 160, 60))))


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
    return Prop.upright(sheet.texture(0.5 * lamp_light(np.array(z))), x, z, width, height)


def build_furniture(seed: int, length: float) -> list[Prop]:
    """Lamps, trees and signs along both sidewalks."""
    rng, iron, red, white = np.random.default_rng([seed, 2]), (52, 58, 56), (186, 40, 36), (240, 238, 232)
    lamp = Sheet(1.0, 5.2, None)
    lamp.rect(0.44, 0.6, 0.12, 4.6, iron)
    lamp.rect(0.38, 4.3, 0.24, 0.9, iron)
    lamp.polygon([(0.22, 0.1), (0.78, 0.1), (0.66, 0.75), (0.34, 0.75)], (226, 222, 204), (255, 236, 190))
    lamp.polygon([(0.15, 0.14), (0.85, 0.14), (0.5, 0.0)], iron, snow=240)
    light, places = lamp.texture(), enumerate(np.arange(LAMP_SPACING, length, LAMP_SPACING))
    props = [Prop.upright(light, 5.4 if index % 2 else -5.4, z, 1.0, 5.2) for index, z in places]
    for side in (-1, 1):
        for z in np.arange(6.0, length, 11.0):
            kind = rng.random()
            if kind < 0.35:
                props.append(build_tree(rng, side * 5.6, z + rng.uniform(-2, 2)))
            elif kind < 0.75:
                sign, kind = Sheet(0.9, 2.9, None), rng.integers(3)
                sign.rect(0.41, 0.4, 0.08, 2.5, (120, 122, 124))
                if kind == 0:
                    sign.ellipse(0.45, 0.45, 0.42, 0.42, red)
                    sign.ellipse(0.45, 0.45, 0.32, 0.32, white)
                elif kind == 1:
                    sign.polygon([(0.0, 0.85), (0.9, 0.85), (0.45, 0.05)], red)
                    sign.polygon([(0.16, 0.76), (0.74, 0.76), (0.45, 0.25)], white)
                else:
                    sign.rect(0.05, 0.05, 0.8, 0.8, (36, 78, 150))
                sign.glyphs(rng, 0.3, 0.32, 0.4, 0.36, (30, 30, 34) if kind < 2 else white)
                props.append(Prop.upright(sign.texture(), side * 4.9, z + rng.uniform(-3, 3), 0.9, 2.9))
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
    sheet.effects[..., 3] = np.clip(235 - 110 * ruts + 18 * fade * blotches(rng, shape, 10), 0, 250)
    light = lamp_light(np.linspace(z + 8, z, shape[0]))[:, None] * np.exp(-((np.linspace(-12, 12, shape[1]) / 8) ** 2))
    return Prop(z + 4, (Panel(sheet.texture(0.8 * light), (-12, 0, z + 8), (24, 0, 0), (0, 0, -8)),))


def draw_sky(rng: Rng, weather: Weather) -> np.ndarray:
    """Sky, clouds and a far skyline, directly in the colors of the weather; the horizon is the lower edge."""
    rows, columns = shape = (256, 1024)
    height = np.linspace(1, 0, rows, dtype=np.float32)[:, None, None]
    zenith, horizon = np.array(weather.zenith, np.float32), np.array(weather.horizon, np.float32)
    sky = np.broadcast_to(horizon + (zenith - horizon) * height**0.6, (rows, columns, 3)).copy()
    cloud = sum(blotches(rng, shape, cell) * cell / 90 for cell in (90.0, 45.0, 20.0))
    cover = np.clip(cloud * 0.7, 0, 1)[..., None] * np.clip(height * 4, 0, 1)
    sky += cover * 0.7 * (np.array(tone(weather.horizon, 1.15), np.float32) - sky)
    for layer, gain in ((0.16, 0.92), (0.10, 0.8)):
        bumps = 0.35 * blotches(rng, (1, columns), 60) + 0.1 * blotches(rng, (1, columns), 8)
        hill = np.arange(rows)[:, None] > rows * (1 - layer * (1 + bumps))
        sky[hill] = np.array(tone(weather.horizon, gain), np.float32) * np.array((0.92, 1.0, 0.98), np.float32)
    return np.dstack([np.clip(sky, 0, 255).astype(np.uint8), np.full(shape, 255, np.uint8)])


def traffic(cars: tuple[Car, ...], z: float, rng: Rng) -> list[Prop]:
    """Cars ahead, oncoming cars and parked cars around a camera at z."""
    props = []
    for x, nearest, farthest, oncoming in TRAFFIC:
        car = cars[int(rng.integers(len(cars)))]
        if rng.random() < 0.7:
            props.append(car[oncoming].move(x + rng.uniform(-0.2, 0.2), z + rng.uniform(nearest, farthest)))
    return props


def build_car(seed: int, index: int) -> Car:
    """Car number `index` of the street with this seed; panels that face away are included, but never painted."""
    rng = np.random.default_rng([seed, 4, index])
    length, width, hood, roof, rear, front = BODIES[int(rng.choice(3, p=(0.4, 0.35, 0.25)))]
    paint, waist, x = pick(rng, CARS), roof - hood, -width / 2
    side = Sheet(length, roof, None)  # the right one
    (low, high), nose, brow = rear, length - front[0], length - front[1]
    side.polygon([(low, waist), (high, 0), (brow, 0), (nose, waist)], tone(paint, 0.9), snow=90)
    side.rect(0, waist, length, hood - 0.22, paint)
    if roof < 2:
        inner = [(low + 0.25, waist), (high + 0.08, 0.1), (brow - 0.05, 0.1), (nose - 0.2, waist)]
        side.polygon(inner, (44, 54, 64))
        side.rect(length * 0.48, 0.1, 0.08, waist, paint)
    else:
        side.glyphs(rng, 0.5, 0.5, 2.6, 0.7, pick(rng, ACCENTS))
        side.polygon([(brow - 1.0, 0.3), (brow, 0.3), (nose - 0.2, waist), (brow - 1.0, waist)], (44, 54, 64))
    side.rect(0, roof - 0.4, length, 0.12, tone(paint, 0.6))
    for wheel in (0.85, length - 0.85):
        side.ellipse(wheel, roof - 0.33, 0.33, 0.33, (30, 30, 32))
        side.ellipse(wheel, roof - 0.33, 0.18, 0.18, (170, 172, 176))
    shadow, top = Sheet(2.0, 2.0, None), Sheet(1.0, 1.0, tone(paint, 1.1))
    shadow.ellipse(1.0, 1.0, 1.0, 1.0, (66, 66, 70), snow=60)
    top.effects[..., 3] = 235
    glass = Sheet(width, waist, paint)  # rear window or windshield with its frame
    glass.rect(0.12, 0.08, width - 0.24, min(0.8, glass.height - 0.12), (48, 58, 68))
    ground, cover, window, right = shadow.texture(), top.texture(), glass.texture(), side.texture()

    def left(weather: Weather) -> np.ndarray:
        return right(weather)[:, ::-1]

    views = []
    for near, far, lights, glow, sides in (  # from behind, and from the front
        (rear, front, (160, 30, 30), (255, 50, 40), (left, right)),
        (front, rear, (236, 236, 228), (255, 250, 230), (right, left)),
    ):
        end = Sheet(width, hood - 0.2, tone(paint, 0.94))  # below the glass, with lights and plate
        end.rect(0, end.height - 0.22, width, 0.22, (48, 48, 52))
        end.rect(width / 2 - 0.28, 0.32, 0.56, 0.14, (236, 232, 214))
        for place in (0.08, width - 0.4):
            end.rect(place, 0.12, 0.32, 0.18, lights, glow)
        back, across = length - far[1], (width, 0, 0)
        panels = (
            Panel(ground, (x - 0.25, 0, length + 0.3), (width + 0.5, 0, 0), (0, 0, -length - 0.5)),
            Panel(cover, (x, -hood, length), across, (0, 0, -length)),
            Panel(end.texture(), (x, -hood, 0), across, (0, hood - 0.2, 0)),
            Panel(cover, (x, -roof, back), across, (0, 0, near[1] - back)),
            Panel(window, (x, -roof, near[1]), across, (0, waist, near[0] - near[1])),
            Panel(sides[0], (x, -roof, length), (0, 0, -length), (0, roof, 0)),
            Panel(sides[1], (-x, -roof, 0), (0, 0, length), (0, roof, 0)),
        )
        views.append(Prop(length / 2, panels))
    return views[0], views[1]
