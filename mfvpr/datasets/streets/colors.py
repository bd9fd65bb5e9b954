"""Types of arrays and colors, palettes of the street, and arithmetic with colors."""

import numpy as np
from jaxtyping import Float, UInt8

Image = UInt8[np.ndarray, "_ _ _"]  # rows, columns, channels
Floats = Float[np.ndarray, "..."]
Color = tuple[int, int, int]  # RGB, 0..255
Rng = np.random.Generator

WALLS = ((226, 205, 160), (214, 170, 130), (196, 120, 96), (170, 184, 160), (176, 188, 200), (232, 224, 208),
         (205, 150, 140), (186, 160, 120), (150, 92, 78), (216, 190, 190))  # fmt: skip
TRIMS = ((245, 240, 230), (230, 222, 205), (120, 110, 104))
ACCENTS = ((150, 48, 44), (38, 84, 124), (40, 96, 74), (196, 148, 48), (92, 60, 110), (48, 52, 60), (208, 96, 48))
ROOFS = ((158, 82, 62), (132, 74, 62), (92, 92, 102), (112, 84, 76))
CARS = ((186, 44, 40), (40, 72, 130), (228, 228, 226), (60, 64, 70), (150, 156, 160), (64, 104, 84), (214, 178, 70))
GLASS, WARM, DARK = (62, 76, 92), (255, 196, 110), (0, 0, 0)


def as_array(color: tuple[float, float, float]) -> Float[np.ndarray, "3"]:
    return np.array(color, np.float32)


def pick(rng: Rng, colors: tuple[Color, ...]) -> Color:
    return colors[int(rng.integers(len(colors)))]


def tone(color: Color, gain: float) -> Color:
    """The color, lighter or darker."""
    red, green, blue = (min(255, int(c * gain)) for c in color)
    return red, green, blue
