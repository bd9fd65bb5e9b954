"""Array types that pass between the modules; the annotations of cv2 lack element types."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Image = NDArray[Any]  # uint8, rows x columns x channels
Floats = NDArray[Any]  # floating point
Color = tuple[int, int, int]  # RGB, 0..255
Rng = np.random.Generator
