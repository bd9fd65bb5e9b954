"""Write features for other programs."""

from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Float, Shaped

from mfvpr.io.containers import shorten
from mfvpr.io.h5 import write_h5
from mfvpr.io.names import require_different
from mfvpr.io.npz import write_npz
from mfvpr.types import Features
from mfvpr.utils.errors import InputError


def write_features(
    path: Path | str, names: Sequence[str], rows: Iterable[tuple[int, Features]], *, half: bool = False
) -> None:
    """Write features without padding, one image after the other; `open_features` reads them back.

    Each file is written completely or not at all.

    Args:
        path: `.h5` or `.hdf5`: as hloc, descriptors `[D, N]`; `.npz`: one file with arrays named `image/part`,
            descriptors `[N, D]`; another name: a folder with `image.npz` for each image, arrays named by their part.
        names: `[M]` names of the images; hloc expects paths below its image folder.
        rows: (row, features) pairs, as from `ImportedFeatures.read`.
        half: float16 instead of float32, as hloc by default. Positions lose up to 0.5 px beyond 1024 px.

    Raises:
        InputError: a value is too large for float16, a name is no path below a folder, or two images share a name.
    """
    path = Path(path)
    require_different(path, names)
    parts = ((names[row], _parts(names[row], features, half)) for row, features in rows)
    if path.suffix.lower() in (".h5", ".hdf5"):
        write_h5(path, ((name, arrays | {"descriptors": arrays["descriptors"].T}) for name, arrays in parts))
    elif path.suffix.lower() == ".npz":
        write_npz(path, ((f"{name}/{part}", array) for name, arrays in parts for part, array in arrays.items()))
    else:
        for name, arrays in parts:
            inside = PurePosixPath(name)
            if not inside.parts or inside.is_absolute() or ".." in inside.parts:
                raise InputError(f"{shorten(name)}: expected a path below the folder of images; rename it")
            write_npz(path / f"{name}.npz", arrays.items())


def convert_floats(where: str, values: Shaped[np.ndarray, "*shape"], half: bool) -> Float[np.ndarray, "*shape"]:
    """Convert to float32, or to float16 if `half`.

    Raises:
        InputError: a value is not finite in float16.
    """
    if not half:
        return np.asarray(values, np.float32)
    with np.errstate(over="ignore"):
        halves = np.asarray(values, np.float16)
    if not np.isfinite(halves).all():
        raise InputError(f"{where}: expected values that float16 holds (up to 65504), got others; write float32")
    return halves


def _parts(name: str, features: Features, half: bool) -> dict[str, np.ndarray]:
    mask, size = np.asarray(features.mask), np.asarray(features.image_size)
    arrays = {
        part: convert_floats(f"{shorten(name)}: {part}", np.asarray(getattr(features, part))[mask], half)
        for part in ("keypoints", "descriptors", "scores")
    }
    return arrays | {"image_size": size.astype(np.int64) if (size == np.round(size)).all() else size}
