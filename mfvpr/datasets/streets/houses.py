"""Drawings of houses: windows, walls, shops, gable and roof."""

from typing import NamedTuple

import numpy as np

from mfvpr.datasets.streets.sheets import Sheet, blotches, draw_glyphs
from mfvpr.datasets.streets.weather import ACCENTS, DARK, GLASS, TRIMS, WALLS, WARM, Color, Rng, pick, tone


class Motif(NamedTuple):
    """A window type, shared by many houses: size in meters, panes, ornaments."""

    width: float
    height: float
    columns: int
    rows: int
    ornament: str


MOTIFS = (
    Motif(1.0, 1.6, 2, 3, "shutters"),
    Motif(1.1, 1.7, 2, 2, "arch"),
    Motif(1.7, 1.4, 3, 1, "lintel"),
    Motif(1.1, 2.1, 2, 3, "railing"),
    Motif(1.2, 1.5, 2, 4, "lintel"),
)


def draw_window(sheet: Sheet, rng: Rng, x: float, y: float, motif: Motif, trim: Color, accent: Color) -> None:
    """One window with its middle at x and its upper edge at y; one in four is lit at night."""
    w, h = motif.width, motif.height
    left = x - w / 2
    glow = tone(WARM, rng.uniform(0.6, 1.0)) if rng.random() < 0.25 else DARK
    if motif.ornament == "arch":
        sheet.ellipse(x, y, w / 2 + 0.1, 0.45, trim)
        sheet.ellipse(x, y, w / 2, 0.35, GLASS, glow)
    sheet.rect(left - 0.1, y - 0.1 * (motif.ornament != "arch"), w + 0.2, h + 0.2, trim)
    sheet.rect(left, y, w, h, tone(GLASS, rng.uniform(0.7, 1.5)), glow)
    for side in (0, 1):  # curtains, each drawn a different way
        cloth = rng.uniform(0.05, 0.35) * w
        sheet.rect(left + side * (w - cloth), y, cloth, h * rng.uniform(0.5, 1), (198, 190, 178), tone(glow, 0.7))
    for column in range(1, motif.columns):
        sheet.rect(left + w * column / motif.columns - 0.03, y, 0.06, h, trim)
    for row in range(1, motif.rows):
        sheet.rect(left, y + h * row / motif.rows - 0.03, w, 0.06, trim)
    sheet.rect(left - 0.2, y + h + 0.08, w + 0.4, 0.12, tone(trim, 0.85), snow=240)
    if motif.ornament == "shutters":
        for x in (left - 0.6, left + w + 0.1):
            sheet.rect(x, y - 0.05, 0.5, h + 0.1, accent)
            for slat in np.arange(0.12, h, 0.2):
                sheet.rect(x + 0.08, y + slat, 0.34, 0.06, tone(accent, 0.65))
    elif motif.ornament == "lintel":
        sheet.rect(left - 0.25, y - 0.32, w + 0.5, 0.16, trim, snow=200)
    elif motif.ornament == "railing":
        for x in np.arange(left - 0.15, left + w + 0.2, 0.14):
            sheet.rect(x, y + h - 0.9, 0.04, 0.9, (40, 40, 44))
        sheet.rect(left - 0.2, y + h - 0.95, w + 0.4, 0.07, (40, 40, 44), snow=220)
    if rng.random() < 0.3:  # flowers on the sill
        for x in rng.uniform(left, left + w, 7):
            sheet.ellipse(x, y + h + 0.02, 0.1, 0.1, pick(rng, ((70, 110, 60), (190, 60, 70), (220, 160, 60))))


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


def draw_damage(sheet: Sheet, rng: Rng) -> None:
    """Marks that tell walls apart: flaked plaster with bare bricks, posters, scribbles."""
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
        draw_glyphs(sheet, rng, x + 0.08, y + 0.72 * h, w - 0.16, 0.2 * h, (30, 30, 34))
    if rng.random() < 0.5:
        start = (rng.uniform(0.5, sheet.width - 1.5), sheet.height - 1.4)
        draw_glyphs(sheet, rng, *start, 1.5, rng.uniform(0.4, 0.8), pick(rng, ACCENTS))


def draw_shop(sheet: Sheet, rng: Rng, top: float, trim: Color, accent: Color) -> None:
    """A ground floor with a sign, an awning and a display window from `top` to the foot of the sheet."""
    sheet.rect(0.3, top + 0.2, sheet.width - 0.6, 0.75, accent, tone(accent, 0.9))
    draw_glyphs(sheet, rng, 0.6, top + 0.32, rng.uniform(0.5, 1.0) * (sheet.width - 1.2), 0.5, trim)
    sheet.rect(0.5, top + 1.1, sheet.width - 2.2, 2.1, (54, 52, 54), tone(WARM, 0.85))
    for x in np.arange(0.8, sheet.width - 2.4, 0.7):  # goods
        size = rng.uniform(0.2, 0.6)
        sheet.rect(x, top + 3.1 - size, 0.45, size, pick(rng, (*ACCENTS, *WALLS)), (150, 110, 60))
    sheet.rect(sheet.width - 1.5, top + 1.1, 1.1, sheet.height - top - 1.1, tone(accent, 0.7))
    sheet.rect(sheet.width - 1.35, top + 1.3, 0.8, 1.2, GLASS, tone(WARM, 0.7))
    if rng.random() < 0.5:
        for stripe, x in enumerate(np.arange(0.4, sheet.width - 1.8, 0.4)):
            sheet.rect(x, top + 1.0, 0.4, 0.7, trim if stripe % 2 else accent, snow=150)


class Design:
    """Design that several houses share: width in meters, floors above the ground floor, windows, use."""

    def __init__(self, rng: Rng) -> None:
        self.motif = MOTIFS[int(rng.integers(len(MOTIFS)))]
        self.width, self.floors = rng.uniform(6.0, 11.0), int(rng.integers(1, 4))
        self.shop = bool(rng.random() < 0.5)


def draw_facade(rng: Rng, wall: Color, design: Design) -> Sheet:
    """The street side of a house: a ground floor of 3.6 m, more floors of 3 m each, a cornice."""
    trim, accent = pick(rng, TRIMS), pick(rng, ACCENTS)
    width, floors, motif = design.width, design.floors, design.motif
    sheet = Sheet(width, 4.1 + 3.0 * floors, wall)
    draw_wall(sheet, rng)
    draw_damage(sheet, rng)
    bays = int(width // 2.4)
    middles = (np.arange(bays) + 0.5) * width / bays
    for floor in range(floors):
        for x in middles:
            draw_window(sheet, rng, float(x), 1.1 + 3.0 * floor, motif, trim, accent)
    top = 0.5 + 3.0 * floors
    sheet.rect(0, top - 0.1, width, 0.18, trim, snow=180)
    if design.shop:
        draw_shop(sheet, rng, top, trim, accent)
    else:
        for x in middles[1:]:
            draw_window(sheet, rng, float(x), top + 1.0, MOTIFS[4], trim, accent)
        sheet.rect(middles[0] - 0.7, top + 0.7, 1.4, 2.9, trim)
        sheet.rect(middles[0] - 0.55, top + 0.85, 1.1, 2.75, accent)
    sheet.rect(0, 0, width, 0.3, tone(trim, 0.92), snow=120)
    return sheet
