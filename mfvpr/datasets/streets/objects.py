"""Drawings of cars and their traffic, of the ground, trees, lamps, signs and hedges."""

from typing import NamedTuple

import numpy as np

from mfvpr.datasets.streets.camera import LANE, Camera
from mfvpr.datasets.streets.sheets import Panel, Prop, Sheet, Texture, draw_glyphs, move, texture
from mfvpr.datasets.streets.weather import ACCENTS, CARS, Color, Image, Rng, Weather, pick, tone

# Where cars may be: x, smallest and largest distance ahead of the camera (meters), whether oncoming.
TRAFFIC = (
    (LANE, 7, 25, False),
    (-LANE, 5, 22, True),
    (-LANE, 25, 50, True),
    (4.0, 5, 18, False),
    (4.0, 25, 50, False),
    (-4.0, 5, 18, True),
)

Car = tuple[Prop, Prop]  # a car with its middle at x = 0 and its near end at z = 0: seen from behind, and oncoming


class Body(NamedTuple):
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
