"""The camera and the street as flat panels: houses on both sides, ground, trees, lamps, signs, cars.

World axes: x to the right, y down, z along the street, in meters; the ground is y = 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mfvpr.data import _street_objects as objects
from mfvpr.data import _street_textures as art
from mfvpr.data._street_textures import Rng, Textures

NEAR = 0.5  # panels are cut off nearer than this, meters
CAMERA_HEIGHT = 1.6  # meters
LAMP_SPACING = 22.0  # meters
Floats = NDArray[Any]  # floating point: the annotations of cv2 do not tell


@dataclass(frozen=True)
class Camera:
    """A pinhole camera at (x, -CAMERA_HEIGHT, z); angles in radians, heading to the right, pitch up."""

    x: float
    z: float
    heading: float
    pitch: float
    image_size: tuple[int, int]  # width, height in px

    @property
    def focal(self) -> float:
        """Focal length in px."""
        return 0.7 * self.image_size[0]

    def rotation(self) -> Floats:
        """Rows: the camera's right, down and forward axes in the world."""
        sin_h, cos_h, sin_p, cos_p = (f(a) for a in (self.heading, self.pitch) for f in (np.sin, np.cos))
        forward = np.array([sin_h * cos_p, -sin_p, cos_h * cos_p])
        right = np.array([cos_h, 0.0, -sin_h])
        return np.stack([right, np.cross(forward, right), forward])

    def center(self) -> Floats:
        """The camera's position in the world."""
        return np.array([self.x, -CAMERA_HEIGHT, self.z])

    def projection(self) -> Floats:
        """The 3x4 matrix from world points (x, y, z, 1) to homogeneous px; the last row gives the depth in m."""
        width, height = self.image_size
        intrinsics = np.array([[self.focal, 0, width / 2], [0, self.focal, height / 2], [0, 0, 1]])
        rotation = self.rotation()
        return intrinsics @ np.column_stack([rotation, -rotation @ self.center()])

    def project(self, points: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """World points (n, 3) to px (n, 2), and which of them lie inside the image."""
        homogeneous = np.column_stack([points, np.ones(len(points))]) @ self.projection().T
        pixels = homogeneous[:, :2] / np.maximum(homogeneous[:, 2:], NEAR)
        inside = (homogeneous[:, 2] > NEAR) & np.all((pixels >= 0) & (pixels < self.image_size), axis=1)
        return pixels, inside


@dataclass(frozen=True)
class Panel:
    """A flat parallelogram: its upper left corner and the edges to the right and down, seen from its front."""

    textures: Textures
    corner: tuple[float, float, float]
    right: tuple[float, float, float]
    down: tuple[float, float, float]


@dataclass(frozen=True)
class Prop:
    """Panels that are painted together, in this order; z is that of the middle, for sorting."""

    z: float
    panels: tuple[Panel, ...]


@dataclass(frozen=True)
class Facade:
    """A street side of a house for the ground truth: the plane x = `x` between two z, up to `height`."""

    x: float
    start: float
    end: float
    height: float


@dataclass(frozen=True)
class Scene:
    """All that stands along the street; each tuple of props is painted as one layer."""

    ground: tuple[Prop, ...]
    houses: tuple[Prop, ...]
    street: tuple[Prop, ...]
    facades: tuple[Facade, ...]
    cars: tuple[tuple[Prop, Prop], ...]  # at x = 0 with the near end at z = 0: driving ahead, oncoming
    backdrop: Textures


def lamp_light(z: Floats) -> Floats:
    """How strongly the street lamps light what is at z, 0..1."""
    return np.exp(-((((z + LAMP_SPACING / 2) % LAMP_SPACING - LAMP_SPACING / 2) / 5.0) ** 2))


def build_house(rng: Rng, design: art.Design, side: int, x: float, z: float) -> tuple[Prop, Facade]:
    """A house whose facade stands at side * x (side -1: left) from z onwards."""
    width, depth, rise = design.width, 9.0, rng.uniform(1.8, 3.4)
    wall = art.pick(rng, art.WALLS)
    sheet = art.draw_facade(rng, wall, design)
    height = sheet.height
    along = np.linspace(z, z + width, sheet.day.shape[1])[::-side]
    fall = np.linspace(height, 0, sheet.day.shape[0])[:, None]
    lit = lamp_light(along) * np.exp(-(((fall - 3.5) / 3.0) ** 2))
    near, far = (z, z + width) if side < 0 else (z + width, z)
    step = (0.0, 0.0, far - near)
    inner, outer = side * x, side * (x + depth)
    facade = Panel(art.dress(sheet, lit, 1.06 if side < 0 else 0.84), (inner, -height, near), step, (0, height, 0))
    roof = Panel(
        art.dress(art.draw_roof(rng, width, float(np.hypot(depth / 2, rise))), sun=1.05),
        (side * (x + depth / 2), -height - rise, near),
        step,
        (-side * depth / 2, rise, 0),
    )
    gable = Panel(
        art.dress(art.draw_gable(rng, wall, depth, height, rise)),
        (min(inner, outer), -height - rise, z),
        (depth, 0, 0),
        (0, height + rise, 0),
    )
    return Prop(z + width / 2, (gable, roof, facade)), Facade(inner, z, z + width, height)


def upright(textures: Textures, x: float, z: float, width: float, height: float) -> Prop:
    """A panel that stands on the ground across the street, with its middle at x."""
    return Prop(z, (Panel(textures, (x - width / 2, -height, z), (width, 0, 0), (0, height, 0)),))


def build_row(seed: int, side: int, length: float) -> tuple[list[Prop], list[Facade]]:
    """The houses of one side of the street, now and then with a garden in between."""
    rng = np.random.default_rng([seed, 1, side + 1])
    # Both sides take turns through the same few designs, so that the street looks alike every 35 m or so.
    designs = [art.make_design(np.random.default_rng([seed, 0, index])) for index in range(4)]
    props, facades, z = [], [], 2.0
    while z < length:
        if rng.random() < 0.2:
            gap = rng.uniform(2.0, 4.0)
            props += [build_tree(rng, side * 12.5, z + gap - 0.5)]
            props += [upright(art.dress(objects.draw_hedge(rng, 5.0, 1.9)), side * 9.9, z + 0.2, 5.0, 1.9)]
            z += gap
        design = designs[len(facades) % len(designs)]
        prop, facade = build_house(rng, design, side, rng.choice((7.4, 7.9, 8.4, 9.4)), z)
        props.append(prop)
        facades.append(facade)
        z += design.width
    return props, facades


def build_tree(rng: Rng, x: float, z: float) -> Prop:
    """A tree with its trunk at x and z."""
    width, height = rng.uniform(3.0, 4.4), rng.uniform(5.0, 6.6)
    return upright(art.dress(objects.draw_tree(rng, width, height), 0.5 * lamp_light(np.array(z))), x, z, width, height)


def build_furniture(seed: int, length: float) -> list[Prop]:
    """Lamps, trees and signs along both sidewalks."""
    rng = np.random.default_rng([seed, 2])
    lamp = art.dress(objects.draw_lamp())
    props = []
    for index, z in enumerate(np.arange(LAMP_SPACING, length, LAMP_SPACING)):
        props.append(upright(lamp, 5.4 if index % 2 else -5.4, z, 1.0, 5.2))
    for side in (-1, 1):
        for z in np.arange(6.0, length, 11.0):
            kind = rng.random()
            if kind < 0.35:
                props.append(build_tree(rng, side * 5.6, z + rng.uniform(-2, 2)))
            elif kind < 0.75:
                props.append(upright(art.dress(objects.draw_sign(rng)), side * 4.9, z + rng.uniform(-3, 3), 0.9, 2.9))
    return props


def build_ground(seed: int, length: float) -> list[Prop]:
    """Strips of 8 m, seen from above; the first lies partly behind the first camera."""
    props = []
    for index, z in enumerate(np.arange(-8.0, length, 8.0)):
        sheet = objects.draw_ground(np.random.default_rng([seed, 3, index]), 12.0, 8.0)
        across = np.linspace(-12, 12, sheet.day.shape[1])
        lit = lamp_light(np.linspace(z + 8, z, sheet.day.shape[0]))[:, None] * np.exp(-((across / 8) ** 2))
        props.append(Prop(z + 4, (Panel(art.dress(sheet, 0.8 * lit), (-12, 0, z + 8), (24, 0, 0), (0, 0, -8)),)))
    return props


def build_car(seed: int, index: int) -> tuple[Prop, Prop]:
    """A car with its middle at x = 0 and its near end at z = 0: seen from behind, and coming along."""
    rng = np.random.default_rng([seed, 4, index])
    body, color = objects.BODIES[int(rng.choice(3, p=(0.4, 0.35, 0.25)))], art.pick(rng, art.CARS)
    right = art.dress(objects.draw_car_side(rng, body, color))
    left = {weather: np.ascontiguousarray(texture[:, ::-1]) for weather, texture in right.items()}
    rear = art.dress(objects.draw_car_end(body, color, (160, 30, 30), (255, 50, 40)))
    front = art.dress(objects.draw_car_end(body, color, (236, 236, 228), (255, 250, 230)))
    sheets = (objects.draw_shadow(), objects.draw_car_top(color), objects.draw_car_glass(body, color))
    covers = tuple(art.dress(sheet) for sheet in sheets)
    return (
        assemble_car(body, body.rear, body.front, rear, (left, right), covers),
        assemble_car(body, body.front, body.rear, front, (right, left), covers),
    )


def assemble_car(
    body: objects.Body,
    near: tuple[float, float],
    far: tuple[float, float],
    end: Textures,
    sides: tuple[Textures, Textures],
    covers: tuple[Textures, ...],
) -> Prop:
    """A car from its textures; `near` and `far` say where glass and roof start, from the respective end.

    All panels that face away are there too: they are never painted.
    """
    shadow, top, glass = covers
    width, length, left = body.width, body.length, -body.width / 2
    roof, across = length - far[1], (width, 0, 0)
    panels = (
        Panel(shadow, (left - 0.25, 0, length + 0.3), (width + 0.5, 0, 0), (0, 0, -length - 0.5)),
        Panel(top, (left, -body.hood, length), across, (0, 0, -length)),
        Panel(end, (left, -body.hood, 0), across, (0, body.hood - 0.2, 0)),
        Panel(top, (left, -body.roof, roof), across, (0, 0, near[1] - roof)),
        Panel(glass, (left, -body.roof, near[1]), across, (0, body.roof - body.hood, near[0] - near[1])),
        Panel(sides[0], (left, -body.roof, length), (0, 0, -length), (0, body.roof, 0)),
        Panel(sides[1], (-left, -body.roof, 0), (0, 0, length), (0, body.roof, 0)),
    )
    return Prop(length / 2, panels)


def move(prop: Prop, x: float, z: float) -> Prop:
    """The prop, moved along the ground by x and z meters."""
    panels = (replace(p, corner=(p.corner[0] + x, p.corner[1], p.corner[2] + z)) for p in prop.panels)
    return Prop(prop.z + z, tuple(panels))


def build_scene(seed: int, length: float) -> Scene:
    """The street from z = 0 to `length` meters."""
    rows = [build_row(seed, side, length) for side in (-1, 1)]
    return Scene(
        ground=tuple(build_ground(seed, length)),
        houses=tuple(prop for props, _ in rows for prop in props),
        street=tuple(build_furniture(seed, length)),
        facades=tuple(facade for _, facades in rows for facade in facades),
        cars=tuple(build_car(seed, index) for index in range(24)),
        backdrop={w: objects.draw_backdrop(np.random.default_rng([seed, 5, i]), w) for i, w in enumerate(art.WEATHERS)},
    )
