"""Flat panels, the parts of all objects on the street."""

from dataclasses import dataclass, replace

from mfvpr.datasets.streets.sheets import Texture


@dataclass(frozen=True)
class Panel:
    """A flat parallelogram, in meters: its upper left corner and its edges to the right and down on its front."""

    texture: Texture
    corner: tuple[float, float, float]
    right: tuple[float, float, float]
    down: tuple[float, float, float]


@dataclass(frozen=True)
class Prop:
    """Panels that are painted together, in this order; z (meters) is that of the middle, for sorting."""

    z: float
    panels: tuple[Panel, ...]


def upright(texture: Texture, x: float, z: float, width: float, height: float) -> Prop:
    """A panel that stands on the ground across the street, with its middle at x; all in meters."""
    return Prop(z, (Panel(texture, (x - width / 2, -height, z), (width, 0, 0), (0, height, 0)),))


def move(prop: Prop, x: float, z: float) -> Prop:
    """The prop, moved along the ground by x and z meters."""
    panels = (replace(p, corner=(p.corner[0] + x, p.corner[1], p.corner[2] + z)) for p in prop.panels)
    return Prop(prop.z + z, tuple(panels))
