"""Drawings of cars and their traffic, of the ground, trees, lamps, signs and hedges."""

from dataclasses import dataclass

import numpy as np

from mfvpr.datasets.streets.camera import LANE, Camera
from mfvpr.datasets.streets.colors import ACCENTS, CARS, Color, Image, Rng, pick, tone
from mfvpr.datasets.streets.sheets import Panel, Prop, Sheet, Texture, blotches, draw_glyphs, move, texture
from mfvpr.datasets.streets.weather import Weather

# Where cars may be: x, smallest and largest distance ahead of the camera (meters), whether oncoming.
TRAFFIC = (
    (LANE, 7, 25, False), (-LANE, 5, 22, True), (-LANE, 25, 50, True),
    (4.0, 5, 18, False), (4.0, 25, 50, False), (-4.0, 5, 18, True),
)  # fmt: skip

Car = tuple[Prop, Prop]  # a car with its middle at x = 0 and its near end at z = 0: seen from behind, and oncoming


@dataclass(frozen=True)
class Body:
    """Shape of a car, in meters: heights of hood and roof; where glass and roof start, from the rear and the front."""

    length: float
    width: float
    hood: float
    roof: float
    rear: tuple[float, float]
    front: tuple[float, float]


BODIES = (
    Body(4.3, 1.75, 0.92, 1.45, (0.15, 0.7), (1.3, 2.1)),
    Body(4.6, 1.8, 0.95, 1.42, (0.7, 1.3), (1.3, 2.1)),
    Body(5.4, 2.0, 1.15, 2.5, (0.02, 0.06), (0.8, 1.5)),
)


def build_car(seed: int, index: int) -> Car:
    """Car number `index` of the street with this seed; panels that face away are included, but never painted."""
    rng = np.random.default_rng([seed, 4, index])
    body, color = BODIES[int(rng.choice(3, p=(0.4, 0.35, 0.25)))], pick(rng, CARS)
    right = texture(draw_side(rng, body, color))
    rear = texture(draw_end(body, color, (160, 30, 30), (255, 50, 40)))
    front = texture(draw_end(body, color, (236, 236, 228), (255, 250, 230)))
    shadow, top = Sheet(2.0, 2.0, None), Sheet(1.0, 1.0, tone(color, 1.1))
    shadow.ellipse(1.0, 1.0, 1.0, 1.0, (66, 66, 70), snow=60)
    top.settle_snow(235)
    glass = Sheet(body.width, body.roof - body.hood, color)  # rear window or windshield with its frame
    glass.rect(0.12, 0.08, body.width - 0.24, min(0.8, glass.height - 0.12), (48, 58, 68))
    covers = [texture(sheet) for sheet in (shadow, top, glass)]

    def left(weather: Weather) -> Image:
        return right(weather)[:, ::-1]

    def assemble(near: tuple[float, float], far: tuple[float, float], end: Texture, sides: tuple[Texture, ...]) -> Prop:
        width, length, x = body.width, body.length, -body.width / 2
        roof, across = length - far[1], (width, 0, 0)
        shadow, top, glass = covers
        panels = (
            Panel(shadow, (x - 0.25, 0, length + 0.3), (width + 0.5, 0, 0), (0, 0, -length - 0.5)),
            Panel(top, (x, -body.hood, length), across, (0, 0, -length)),
            Panel(end, (x, -body.hood, 0), across, (0, body.hood - 0.2, 0)),
            Panel(top, (x, -body.roof, roof), across, (0, 0, near[1] - roof)),
            Panel(glass, (x, -body.roof, near[1]), across, (0, body.roof - body.hood, near[0] - near[1])),
            Panel(sides[0], (x, -body.roof, length), (0, 0, -length), (0, body.roof, 0)),
            Panel(sides[1], (-x, -body.roof, 0), (0, 0, length), (0, body.roof, 0)),
        )
        return Prop(length / 2, panels)

    return assemble(body.rear, body.front, rear, (left, right)), assemble(body.front, body.rear, front, (right, left))


def traffic(cars: tuple[Car, ...], camera: Camera, rng: Rng) -> list[Prop]:
    """Cars ahead, oncoming cars and parked cars around the camera."""
    props = []
    for x, nearest, farthest, oncoming in TRAFFIC:
        car = cars[int(rng.integers(len(cars)))]
        if rng.random() < 0.7:
            x, z = x + rng.uniform(-0.2, 0.2), camera.z + rng.uniform(nearest, farthest)
            props.append(move(car[oncoming], x, z))
    return props


def draw_side(rng: Rng, body: Body, paint: Color) -> Sheet:
    """The right side of the car, which drives to the right."""
    sheet = Sheet(body.length, body.roof, None)
    length, waist = body.length, body.roof - body.hood
    low, high = body.rear
    nose, brow = length - body.front[0], length - body.front[1]
    sheet.polygon([(low, waist), (high, 0), (brow, 0), (nose, waist)], tone(paint, 0.9), snow=90)
    sheet.rect(0, waist, length, body.hood - 0.22, paint)
    if body.roof < 2:
        inner = [(low + 0.25, waist), (high + 0.08, 0.1), (brow - 0.05, 0.1), (nose - 0.2, waist)]
        sheet.polygon(inner, (44, 54, 64))
        sheet.rect(length * 0.48, 0.1, 0.08, waist, paint)
    else:
        draw_glyphs(sheet, rng, 0.5, 0.5, 2.6, 0.7, pick(rng, ACCENTS))
        sheet.polygon([(brow - 1.0, 0.3), (brow, 0.3), (nose - 0.2, waist), (brow - 1.0, waist)], (44, 54, 64))
    sheet.rect(0, body.roof - 0.4, length, 0.12, tone(paint, 0.6))
    for x in (0.85, length - 0.85):
        sheet.ellipse(x, body.roof - 0.33, 0.33, 0.33, (30, 30, 32))
        sheet.ellipse(x, body.roof - 0.33, 0.18, 0.18, (170, 172, 176))
    return sheet


def draw_end(body: Body, paint: Color, lights: Color, glow: Color) -> Sheet:
    """Rear or front below the glass, with its lights and plate."""
    sheet = Sheet(body.width, body.hood - 0.2, tone(paint, 0.94))
    sheet.rect(0, sheet.height - 0.22, body.width, 0.22, (48, 48, 52))
    sheet.rect(body.width / 2 - 0.28, 0.32, 0.56, 0.14, (236, 232, 214))
    for x in (0.08, body.width - 0.4):
        sheet.rect(x, 0.12, 0.32, 0.18, lights, glow)
    return sheet


def draw_ground(rng: Rng, half_width: float, length: float) -> Sheet:
    """A strip of the street seen from above: y runs against the driving direction."""
    sheet = Sheet(2 * half_width, length, (164, 158, 148), scale=24)
    middle = half_width
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
    wear_ground(sheet, rng)
    return sheet


def wear_ground(sheet: Sheet, rng: Rng) -> None:
    """Grain and stains on the strip, and snow that is thinner where wheels have passed."""
    shape = sheet.day.shape[:2]
    fade = np.sin(np.linspace(0, np.pi, shape[0]))[:, None]  # no stain may end at the edge of a strip
    grain = 0.03 * rng.standard_normal(shape, np.float32)
    sheet.shade((1 + grain + 0.05 * fade * blotches(rng, shape, 30))[..., None])
    x = np.linspace(-sheet.width / 2, sheet.width / 2, shape[1])
    ruts = sum(np.exp(-(((x - rut) / 0.24) ** 4)) for rut in (-2.7, -1.2, 1.2, 2.7))
    sheet.settle_snow(np.clip(235 - 110 * ruts + 18 * fade * blotches(rng, shape, 10), 0, 250))


def draw_tree(rng: Rng, width: float, height: float) -> Sheet:
    """A tree in leaf: trunk, branches and a round crown of many dabs."""
    sheet = Sheet(width, height, None)
    middle, bark = width / 2, (88, 68, 54)
    sheet.line([(middle, height), (middle + 0.1, 0.45 * height)], 0.28, bark)
    for x in rng.uniform(0.25, 0.75, 5) * width:
        sheet.line([(middle, 0.62 * height), (x, 0.25 * height)], 0.1, bark)
    leaf = tone((92, 132, 62), rng.uniform(0.8, 1.1))
    for angle, radius in zip(rng.uniform(0, 2 * np.pi, 700), np.sqrt(rng.random(700)), strict=True):
        x, y = middle + radius * 0.42 * width * np.cos(angle), 0.34 * height * (1 + 0.85 * radius * np.sin(angle))
        light = 1.15 - 0.5 * y / (0.68 * height) + rng.uniform(-0.1, 0.1)
        size = rng.uniform(0.07, 0.2)
        sheet.ellipse(x, y, size, 0.8 * size, tone(leaf, light), snow=int(rng.uniform(120, 220) * min(1.0, light)))
    return sheet


def draw_lamp() -> Sheet:
    sheet = Sheet(1.0, 5.2, None)
    sheet.rect(0.44, 0.6, 0.12, 4.6, (52, 58, 56))
    sheet.rect(0.38, 4.3, 0.24, 0.9, (52, 58, 56))
    sheet.polygon([(0.22, 0.1), (0.78, 0.1), (0.66, 0.75), (0.34, 0.75)], (226, 222, 204), (255, 236, 190))
    sheet.polygon([(0.15, 0.14), (0.85, 0.14), (0.5, 0.0)], (52, 58, 56), snow=240)
    return sheet


def draw_sign(rng: Rng) -> Sheet:
    sheet = Sheet(0.9, 2.9, None)
    sheet.rect(0.41, 0.4, 0.08, 2.5, (120, 122, 124))
    kind = rng.integers(3)
    if kind == 0:
        sheet.ellipse(0.45, 0.45, 0.42, 0.42, (186, 40, 36))
        sheet.ellipse(0.45, 0.45, 0.32, 0.32, (240, 238, 232))
    elif kind == 1:
        sheet.polygon([(0.0, 0.85), (0.9, 0.85), (0.45, 0.05)], (186, 40, 36))
        sheet.polygon([(0.16, 0.76), (0.74, 0.76), (0.45, 0.25)], (240, 238, 232))
    else:
        sheet.rect(0.05, 0.05, 0.8, 0.8, (36, 78, 150))
    draw_glyphs(sheet, rng, 0.3, 0.32, 0.4, 0.36, (30, 30, 34) if kind < 2 else (240, 238, 232))
    return sheet


def draw_hedge(rng: Rng, width: float, height: float) -> Sheet:
    sheet = Sheet(width, height, None)
    for x, y in rng.uniform((0.1, 0.15), (width - 0.1, height), (500, 2)):
        light = 1.15 - 0.4 * y / height + rng.uniform(-0.2, 0.2)
        sheet.ellipse(x, y, 0.17, 0.14, tone((80, 118, 60), light), snow=int(150 * light))
    return sheet
