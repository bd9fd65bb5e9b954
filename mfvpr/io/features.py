"""Read features and global descriptors that other programs extracted, and write them for other programs.

    features = open_features(Path("feats-d2net-ss.h5"), dataset.database.names)
    for row, image_features in features.read([3, 14]):
        ...

Parts of an image in a file:

- `keypoints` `[N, 2]` (x, y), px, pixel centers at whole numbers; up to two more columns (scale, angle) are ignored;
- `descriptors` `[D, N]` (hloc) or `[N, D]`; float16 becomes float32;
- `scores` or `keypoint_scores` `[N]`, larger = better; without them, or if all are 0 (hloc's SIFT), all are 1;
- `image_size` `[2]` (width, height), px, of the image that the keypoints are in.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Float32, Int32, Shaped

from mfvpr.core.types import Array, Features
from mfvpr.io.containers import (
    Container,
    FileEntry,
    H5File,
    NpzFiles,
    Shapes,
    as_float32,
    choose_reader,
    read_npz,
    reading,
    shorten,
    write_h5,
    write_npz,
)
from mfvpr.io.names import match_names, match_paths, require_all, require_different
from mfvpr.utils.errors import InputError, require_word
from mfvpr.utils.files import printable, replacing, require_replaceable

Lengths = Literal["unit", "normalize", "keep"]
TOLERANCE = 0.01  # of unit length, relative; the error of float16 is 5e-4
EXACT = 1e-6  # the error of float32
GLOBAL = "global_descriptor"  # hloc's name
SCORES = ("scores", "keypoint_scores")
PARTS, OTHERS = ("keypoints", "descriptors"), (*SCORES, "image_size")


@dataclass(frozen=True, eq=False)
class ImportedFeatures:
    """Features of M images in files of another program, made by `open_features`.

    Attributes:
        path: file or folder.
        counts: keypoints of each image, -1 = missing image.
        dimension: D; 0 if no image has a keypoint.
        scored: whether the files have scores; if not, all are 1.
    """

    path: Path
    counts: Int32[np.ndarray, " images"]
    dimension: int
    scored: bool
    _container: Container
    _images: tuple[str | None, ...]
    _transposed: bool
    _sizes: Float32[np.ndarray, "images 2"] | None
    _lengths: Lengths

    def __len__(self) -> int:
        return len(self.counts)

    @property
    def entries(self) -> list[FileEntry | None]:
        """`[M]` place of each image's arrays; None = missing image."""
        return [None if image is None else self._container.entries[image] for image in self._images]

    def read(self, rows: Iterable[int] | None = None) -> Iterator[tuple[int, Features]]:
        """Read the row and features of each image: unpadded NumPy float32 with a full mask.

        Args:
            rows: rows of images, in the order to read them; None = all images in the files.

        Raises:
            InputError: an image is missing, or its arrays are damaged or do not fit each other.
        """
        rows = np.flatnonzero(self.counts >= 0).tolist() if rows is None else [int(row) for row in rows]
        images = {row: image for row in rows if 0 <= row < len(self) and (image := self._images[row]) is not None}
        if missing := [row for row in rows if row not in images]:
            raise InputError(f"{self.path}: expected features of image {missing[0]}, got none; see counts")
        arrays = self._container.arrays([images[row] for row in rows], (*PARTS, *OTHERS))
        for row, parts in zip(rows, arrays, strict=True):
            yield row, self._features(row, f"{self.path}: {shorten(images[row])}", parts)

    def _features(self, row: int, where: str, parts: Mapping[str, np.ndarray]) -> Features:
        count, score = int(self.counts[row]), next((part for part in SCORES if part in parts), None)
        keypoints = as_float32(f"{where}: keypoints", parts["keypoints"], "fiu")[:, :2]
        descriptors = as_float32(f"{where}: descriptors", parts["descriptors"])
        descriptors = descriptors.T if self._transposed else descriptors
        scores = as_float32(f"{where}: {score}", parts[score]).reshape(-1) if score else np.zeros(count, np.float32)
        if not count and not descriptors.size:  # [D, 0], [0, D] or [0]
            descriptors = np.zeros((0, self.dimension), np.float32)
        if not len(keypoints) == len(scores) == count or descriptors.shape != (count, self.dimension):
            expected = f"{count} keypoints with scores and descriptors of {self.dimension} numbers"
            got = f"{len(keypoints)}, {len(scores)} and {list(descriptors.shape)}"
            raise InputError(f"{where}: expected {expected}, got {got}")
        argument = None if self._sizes is None else self._sizes[row]
        size = as_float32(f"{where}: image_size", np.asarray(parts.get("image_size", argument)), "fiu").reshape(-1)
        if size.shape != (2,) or not (size > 0).all() or (argument is not None and (size != argument).any()):
            expected = "(width, height) in pixels" if argument is None else f"the argument {argument.tolist()}"
            raise InputError(f"{where}: image_size: expected {expected}, got {size.tolist()}")
        require_inside(where, keypoints, size)
        return Features(
            keypoints=np.ascontiguousarray(keypoints),
            descriptors=np.ascontiguousarray(_scaled(f"{where}: descriptors", descriptors, self._lengths)),
            scores=scores if scores.any() else np.ones(count, np.float32),
            mask=np.ones(count, bool),
            image_size=size,
        )


def open_features(
    path: Path | str,
    names: Sequence[str],
    *,
    paths: Sequence[str] = (),
    image_size: Any = None,
    lengths: Lengths = "unit",
    partial: bool = False,
) -> ImportedFeatures:
    """Open the features of the images `names`; reads only the headers of their arrays.

    Args:
        path: `.h5` or `.hdf5` of hloc; `.npz` of all images, with arrays named `image/part`; or a folder with a `.npz`
            or a `.d2-net` (of D2-Net's code) for each image.
        names: `[M]` relative POSIX paths, as `ImageFolder.names`; see `names.match_names`. Use hloc's paths if they
            begin at a parent folder (`database/1.jpg`).
        paths: `[M]` full paths of the images, which are tried before the names; () = none.
        image_size: `[2]` or `[M, 2]` (width, height), px, if the files have no `image_size`.
        lengths: of descriptors. `unit`: require unit length within 1 %, and correct rounding; `normalize`: scale to
            unit length; `keep`: do not change them.
        partial: whether images may be missing (their count is -1).

    Raises:
        InputError: the file is missing, damaged or has another format; images are missing or ambiguous; arrays do not
            fit each other.
    """
    path, sizes = Path(path), None
    require_word("lengths", lengths, Lengths)
    if image_size is not None:
        sizes = np.asarray(image_size, np.float32)
        if sizes.shape not in ((2,), (len(names), 2)) or not (np.isfinite(sizes) & (sizes > 0)).all():
            raise InputError(f"image_size: expected (width, height) in pixels, or [M, 2] of them, got {image_size}")
        sizes = np.broadcast_to(sizes, (len(names), 2))
    readers = {".h5": H5File, ".hdf5": H5File, ".npz": NpzFiles}
    container: Container = NpzFiles(path) if path.is_dir() else choose_reader(path, readers)(path)
    images = match_paths(path, names, paths, container.entries)
    if not partial or not any(images):
        require_all(path, names, images, "features")
    rows = {image: row for row, image in enumerate(images) if image is not None}
    shapes = dict(zip(rows, container.shapes(rows, PARTS, OTHERS), strict=True))
    counts = np.full(len(names), -1, np.int32)
    for image, parts in shapes.items():
        where = f"{path}: {shorten(image)}"
        required = PARTS if sizes is not None else (*PARTS, "image_size")
        if missing := [part for part in required if part not in parts]:
            mend = "; give it as image_size=" if missing == ["image_size"] else ""
            raise InputError(f"{where}: expected {', '.join(required)}, got no {' and no '.join(missing)}{mend}")
        shape = parts["keypoints"]
        if len(shape) != 2 or not 2 <= shape[1] <= 4:
            raise InputError(f"{where}: keypoints: expected [N, 2], or scale and angle as well, got {list(shape)}")
        counts[rows[image]] = shape[0]
    transposed, dimension = _layout(path, shapes, container.transposed)
    without = [image for image, parts in shapes.items() if not {*SCORES} & parts.keys()]
    if without and len(without) < len(shapes):  # a missing score would become 1
        raise InputError(f"{path}: expected scores of all images or of none, got none of {shorten(without[0])}")
    content = container, tuple(images), transposed, sizes, lengths
    return ImportedFeatures(path, counts, dimension, not without, *content)


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
        InputError: a file exists, a value is too large for float16, a name is no path below a folder, or two images
            share a name.
    """
    path = Path(path)
    require_different(path, names)

    def arrays_of(name: str, features: Features) -> dict[str, np.ndarray]:
        mask, size = np.asarray(features.mask), np.asarray(features.image_size)
        values = {part: np.asarray(getattr(features, part))[mask] for part in ("keypoints", "descriptors", "scores")}
        arrays = {part: _convert(f"{shorten(name)}: {part}", values[part], half) for part in values}
        return arrays | {"image_size": size.astype(np.int64) if (size == np.round(size)).all() else size}

    parts = ((names[row], arrays_of(names[row], features)) for row, features in rows)
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


def _layout(path: Path, shapes: Mapping[str, Shapes], default: bool) -> tuple[bool, int]:
    """Whether descriptors are `[D, N]`, and D, both the same for all images.

    An image with N = D fits both layouts: other images of the file decide, or the program's usual layout `default`.
    """
    layouts: set[bool] = set()
    dimensions: set[int] = set()
    for image, parts in shapes.items():
        count, shape = parts["keypoints"][0], parts["descriptors"]
        if not count:
            continue
        if len(shape) != 2 or count not in shape:
            expected = f"[{count}, D] or [D, {count}] like the keypoints"
            raise InputError(f"{path}: {shorten(image)}: descriptors: expected {expected}, got {list(shape)}")
        dimensions.add(shape[0] if shape[1] == count else shape[1])
        if shape[0] != shape[1]:
            layouts.add(shape[1] == count)
    if len(layouts) > 1 or len(dimensions) > 1:
        raise InputError(
            f"{path}: expected descriptors of one layout, [D, N] or [N, D], and of one length for all images, got "
            f"lengths {sorted(dimensions)}"
        )
    return next(iter(layouts), default), next(iter(dimensions), 0)


def require_inside(where: str, keypoints: np.ndarray, size: np.ndarray) -> None:
    """Raise an InputError for keypoints in another image size, or as (y, x); float16 may round outwards."""
    margin = np.maximum(2.0, 0.01 * size)
    outside = ((keypoints < -margin) | (keypoints > size - 1 + margin)).any(axis=1)
    if outside.any():
        x, y = keypoints[int(outside.argmax())].tolist()
        raise InputError(
            f"{where}: expected keypoints (x, y) in an image of {size[0]:g} x {size[1]:g} pixels, got ({x:g}, {y:g}); "
            "check image_size (width, height)"
        )


def read_global_descriptors(
    path: Path | str, names: Sequence[str], *, lengths: Lengths = "unit"
) -> Float32[np.ndarray, "images dimensions"]:
    """Global descriptors of the images `names`.

    Args:
        path: `.npy`: `[M, D]`, in the order of the names as Python sorts them (image10 before image2), such as
            VPR-methods-evaluation's `database_descriptors.npy`;
            `.npz`: `descriptors` `[M, D]` and `names` `[M]`; without `names`, the order of `.npy`;
            `.h5` or `.hdf5`: as hloc, a `global_descriptor` `[D]` for each image.
        names: `[M]` relative POSIX paths, matched as in `names.match_names`.
        lengths: as in `open_features`.

    Returns:
        `[M, D]` float32 in the order of `names`.

    Raises:
        InputError: the file is missing or damaged; images are missing or ambiguous; values are not finite; or lengths
            are not 1.
    """
    return read_descriptors_with_entries(path, names, lengths=lengths)[0]


def read_descriptors_with_entries(
    path: Path | str, names: Sequence[str], *, lengths: Lengths = "unit"
) -> tuple[Float32[np.ndarray, "images dimensions"], list[FileEntry]]:
    """Descriptors as `read_global_descriptors` returns them, and `[M]` the entry of each image."""
    path = Path(path)
    require_word("lengths", lengths, Lengths)
    choose_reader(path, dict.fromkeys((".npy", ".npz", ".h5", ".hdf5"), Path))
    suffix, arrays = path.suffix.lower(), {}
    if suffix == ".npz":
        arrays = read_npz(path, ("descriptors", "names"))
    elif suffix == ".npy":
        with reading(path):
            arrays = {"descriptors": np.load(path, allow_pickle=False)}
    else:
        file = H5File(path)
        entries = require_all(path, names, match_names(path, names, file.entries), "descriptors")
        vectors = [parts.get(GLOBAL, np.zeros((0, 0))) for parts in file.arrays(entries, (GLOBAL,))]
        for image, vector in zip(entries, vectors, strict=True):
            if vector.ndim != 1 or vector.shape != vectors[0].shape:
                expected = f"{shorten(image)}: expected {GLOBAL} [D], the same D for all"
                raise InputError(f"{path}: {expected}, got {list(vector.shape)}")
        values = np.stack(vectors) if vectors else np.zeros((0, 0), np.float32)
    if suffix in (".npy", ".npz"):
        if "descriptors" not in arrays:
            raise InputError(f"{path}: expected an array descriptors [M, D], and names [M]; got no descriptors")
        values, file_names = arrays["descriptors"], arrays.get("names")
        if file_names is None:  # in the order of the sorted names
            _require_rows(path, values, names)
            rows = np.argsort(np.argsort(np.array(names, object))).tolist()
            entries = [f"row {row}" for row in rows]
        else:
            if file_names.dtype.kind != "U" or file_names.shape != values.shape[:1]:
                got = f"{file_names.dtype}{list(file_names.shape)} and {list(values.shape)}"
                raise InputError(f"{path}: expected names as text [M] and descriptors [M, D], got {got}")
            require_different(path, file_names.tolist())
            places = {name: row for row, name in enumerate(file_names.tolist())}
            entries = require_all(path, names, match_names(path, names, places), "descriptors")
            rows = [places[entry] for entry in entries]
        values = values[rows]
    _require_rows(path, values, names)
    values = _scaled(str(path), as_float32(str(path), values), lengths)
    return values, [FileEntry(path, entry) for entry in entries]


def write_global_descriptors(
    path: Path | str, names: Sequence[str], descriptors: Float[Array, "images dimensions"], *, half: bool = False
) -> None:
    """Write global descriptors `[M, D]` as `read_global_descriptors` reads them, atomically.

    Args:
        path: new file, `.npy`, `.npz`, `.h5` or `.hdf5`.
        names: `[M]`.
        descriptors: `[M, D]` in the order of `names`.
        half: float16 instead of float32, as hloc by default.
    """
    path = Path(path)
    require_different(path, names)
    values = _convert(str(path), np.asarray(descriptors), half)
    _require_rows(path, values, names)
    suffix = path.suffix.lower()
    if suffix == ".npy":
        require_replaceable(path)
        with replacing(path) as temporary, temporary.open("wb") as file:
            np.lib.format.write_array(file, values[np.argsort(np.array(names, object))], allow_pickle=False)
    elif suffix == ".npz":
        write_npz(path, {"names": np.array([printable(name) for name in names]), "descriptors": values}.items())
    elif suffix in (".h5", ".hdf5"):
        write_h5(path, ((name, {GLOBAL: value}) for name, value in zip(names, values, strict=True)))
    else:
        raise InputError(f"{path}: expected a name that ends with .npy, .npz, .h5 or .hdf5")


def _require_rows(path: Path, descriptors: np.ndarray, names: Sequence[str]) -> None:
    if descriptors.ndim != 2 or len(descriptors) != len(names) or not descriptors.shape[1]:
        raise InputError(f"{path}: expected descriptors [{len(names)}, D] of the images, got {list(descriptors.shape)}")


def _scaled(
    where: str, descriptors: Float[np.ndarray, "rows dimensions"], lengths: Lengths
) -> Float[np.ndarray, "rows dimensions"]:
    """Check or scale the lengths of finite descriptors, see `open_features`; the result is float32."""
    if lengths == "keep" or not len(descriptors):
        return descriptors
    norms = np.sqrt(np.einsum("nd,nd->n", descriptors, descriptors, dtype=np.float64))
    if lengths == "unit":
        worst = int(np.abs(norms - 1).argmax())
        if abs(norms[worst] - 1) > TOLERANCE:
            got = f"length {norms[worst]:.4g} at {worst}; set lengths='normalize' to scale descriptors, or 'keep'"
            raise InputError(f"{where}: expected unit length, got {got}")
    elif not norms.all():
        raise InputError(f"{where}: expected descriptors with a direction, got zeros at {int(norms.argmin())}")
    scale = np.where(np.abs(norms - 1) > EXACT, norms, 1.0)  # unit length in float32: no bit changes
    return (descriptors / scale[:, None]).astype(np.float32)


def _convert(where: str, values: Shaped[np.ndarray, "*shape"], half: bool) -> Float[np.ndarray, "*shape"]:
    """Convert to float32, or to float16 if `half`; InputError for a value that is not finite in float16."""
    if not half:
        return np.asarray(values, np.float32)
    with np.errstate(over="ignore"):
        halves = np.asarray(values, np.float16)
    if not np.isfinite(halves).all():
        raise InputError(f"{where}: expected values that float16 holds (up to 65504), got others; write float32")
    return halves
