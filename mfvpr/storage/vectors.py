"""Global descriptors of the images on disk, read by every later run.

A row store (`mfvpr.storage.rows`). A row holds one `vector` float32 `[D]`, or several `[V, D]`, to the bit.
"""

from collections.abc import Mapping
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from mfvpr.storage.manifest import VECTORS
from mfvpr.storage.rows import RowFormat, RowStore, row_bytes

VectorStore = RowStore[np.ndarray]


def open_vector_store(folder: Path, recipe: Mapping[str, Any], *, num_images: int, **options: Any) -> VectorStore:
    """The store in `folder`; see `features.open_store`."""
    form = RowFormat(VECTORS, lambda vector: {"vector": np.asarray(vector, np.float32)}, itemgetter("vector"))
    return RowStore(folder, form, recipe, {"num_images": num_images}, **options)


def forecast_bytes(num_images: int, size: int) -> int:
    """Bytes on disk, at most, of one vector of `size` numbers per image."""
    return num_images * row_bytes(4 * size, 1)
