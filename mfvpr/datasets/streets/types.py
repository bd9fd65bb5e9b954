"""Types of arrays and colors that pass between the modules."""

import numpy as np
from jaxtyping import Float, UInt8

Image = UInt8[np.ndarray, "_ _ _"]  # rows, columns, channels
Floats = Float[np.ndarray, "..."]
Color = tuple[int, int, int]  # RGB, 0..255
Rng = np.random.Generator
