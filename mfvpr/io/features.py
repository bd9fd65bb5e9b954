"""Read features and global descriptors that other programs extracted, and write them for other programs.

Parts of an image in a file:

- `keypoints` `[N, 2]` (x, y), px, pixel centers at whole numbers; up to two more columns (scale, angle) are ignored;
- `descriptors` `[D, N]` (hloc) or `[N, D]`; float16 becomes float32;
- `scores` or `keypoint_scores` `[N]`, larger = better; without them, or if all are 0 (hloc's SIFT), all are 1;
- `image_size` `[2]` (width, height), px, of the image that the keypoints are in.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Float32, Int32, Shaped

from mfvpr.core.types import Array, Features
from mfvpr.io.containers import (
    FileEntry,
    H5File,
    NpzFiles,
    as_float32,
    choose_reader,
    match_names,
    match_paths,
    read_npz,
    reading,
    require_all,
    require_different,
    shorten,
    write_h5,
    write_npz,
)
from mfvpr.utils.errors import InputError, require_word
from mfvpr.utils.files import printable, replacing, require_replaceable

Lengths = Literal["unit", "normalize", "keep"]
TOLERANCE = 0.01  # of unit length, relative; the error of float16 is 5e-4
EXACT = 1e-6  # the error of float32
GLOBAL = "global_descriptor"  # hloc's name
SCORES = ("scores", "keypoint_scores")
PARTS = ("keypoints", "descriptors", *SCORES, "image_size")


@dataclass(frozen=True, eq=False)
class ImportedFeatures:
    """Features of M images in files of another program, made by `open_features`."""

    path: Path  # file or folder
    counts: Int32[np.ndarray, " images"]  # keypoints of each image, -1 = missing image
    dimension: int  # D; 0 if no image has a keypoint
    _container: H5File | NpzFiles
    _images: Sequence[str | None]
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
        """Read the row and features of images in the order of `rows`: unpadded NumPy float32 with a full mask.

        None = all images in the files. An `InputError` for an image that is missing, or whose arrays are damaged.
        """
        rows = np.flatnonzero(self.counts >= 0).tolist() if rows is None else [int(row) for row in rows]
        images = {row: image for row in rows if 0 <= row < len(self) and (image := self._images[row]) is not None}
        if missing := [row for row in rows if row not in images]:
            raise InputError(f"{self.path}: expected features of image {missing[0]}, got none; see counts")
        for row, parts in zip(rows, self._container.read([images[row] for row in rows], PARTS), strict=True):
            where, count = f"{self.path}: {shorten(images[row])}", int(self.counts[row])
            score = next((part for part in SCORES if part in parts), None)
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
            features = Features(
                keypoints=np.ascontiguousarray(keypoints),
                descriptors=np.ascontiguousarray(_scaled(f"{where}: descriptors", descriptors, self._lengths)),
                scores=scores if scores.any() else np.ones(count, np.float32),
                mask=np.ones(count, bool),
                image_size=size,
            )
            yield row, features


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
        names: `[M]` relative POSIX paths, matched as in `containers.match_names`.
        paths: `[M]` full paths of the images, which are tried before the names; () = none.
        image_size: `[2]` or `[M, 2]` (width, height), px, if the files have no `image_size`.
        lengths: of descriptors. `unit`: require unit length within 1 %, and correct rounding; `normalize`: scale to
            unit length; `keep`: do not change them.
        partial: whether images may be missing (their count is -1).

    Raises:
        InputError: a damaged file, another format, missing or ambiguous images, or arrays that do not fit each other.
    """
    path, sizes = Path(path), None
    require_word("lengths", lengths, Lengths)
    if image_size is not None:
        sizes = np.asarray(image_size, np.float32)
        if sizes.shape not in ((2,), (len(names), 2)) or not (np.isfinite(sizes) & (sizes > 0)).all():
            raise InputError(f"image_size: expected (width, height) in pixels, or [M, 2] of them, got {image_size}")
        sizes = np.broadcast_to(sizes, (len(names), 2))
    readers = {".h5": H5File, ".hdf5": H5File, ".npz": NpzFiles}
    container: H5File | NpzFiles = (NpzFiles if path.is_dir() else choose_reader(path, readers))(path)
    images = match_paths(path, names, paths, container.entries)
    if not partial or not any(images):
        require_all(path, names, images, "features")
    rows = {image: row for row, image in enumerate(images) if image is not None}
    counts, has_scores = np.full(len(names), -1, np.int32), set[bool]()
    layouts, dimensions = set[bool](), set[int]()  # whether descriptors are [D, N], and D
    required = {"keypoints", "descriptors"} | ({"image_size"} if sizes is None else set())
    for (image, row), shapes in zip(rows.items(), container.read(rows, PARTS, shapes=True), strict=True):
        if missing := sorted(required - shapes.keys()):
            mend = "; give it as image_size=" if missing == ["image_size"] else ""
            raise InputError(f"{path}: {shorten(image)}: expected {', '.join(missing)}, got none{mend}")
        points, vectors = shapes["keypoints"], shapes["descriptors"]
        count = counts[row] = points[0] if len(points) == 2 and 2 <= points[1] <= 4 else -1
        if count < 0 or (count and not (len(vectors) == 2 and count in vectors)):
            expected = "keypoints [N, 2] (or with scale and angle), and descriptors [N, D] or [D, N]"
            raise InputError(f"{path}: {shorten(image)}: expected {expected}, got {[*points]} and {[*vectors]}")
        has_scores.add(not {*SCORES}.isdisjoint(shapes))
        if count:
            dimensions.add(vectors[0] if vectors[1] == count else vectors[1])
        if count and vectors[0] != vectors[1]:  # the other images tell the layout, or the program's usual one counts
            layouts.add(vectors[1] == count)
    if len(layouts) > 1 or len(dimensions) > 1:
        got = f"lengths {sorted(dimensions)}"
        raise InputError(f"{path}: expected descriptors of one layout, [D, N] or [N, D], and of one length, got {got}")
    if len(has_scores) > 1:  # a missing score would become 1
        raise InputError(f"{path}: expected scores of all images or of none, got some without; extract them again")
    layout, dimension = next(iter(layouts), container.transposed), next(iter(dimensions), 0)
    return ImportedFeatures(path, counts, dimension, container, images, layout, sizes, lengths)


def write_features(
    path: Path | str, names: Sequence[str], rows: Iterable[tuple[int, Features]], *, half: bool = False
) -> None:
    """Write features without padding, as `open_features` reads them; each file completely or not at all.

    Args:
        path: `.h5` or `.hdf5`: as hloc, descriptors `[D, N]`; `.npz`: one file with arrays named `image/part`,
            descriptors `[N, D]`; another name: a folder with `image.npz` for each image, arrays named by their part.
        names: `[M]` names of the images; hloc expects paths below its image folder.
        rows: (row, features) pairs, as from `ImportedFeatures.read`.
        half: float16 instead of float32, as hloc by default. Positions lose up to 0.5 px beyond 1024 px.

    Raises:
        InputError: a file exists, a value is too large for float16, or a name is used twice or is no path in a folder.
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


def require_inside(where: str, keypoints: np.ndarray, size: np.ndarray) -> None:
    """Raise an InputError for keypoints in another image size, or as (y, x); float16 may round outwards."""
    margin = np.maximum(2.0, 0.01 * size)
    outside = ((keypoints < -margin) | (keypoints > size - 1 + margin)).any(axis=1)
    if outside.any():
        x, y = keypoints[int(outside.argmax())].tolist()
        expected, mend = f"an image of {size[0]:g} x {size[1]:g} pixels", "check image_size (width, height)"
        raise InputError(f"{where}: expected keypoints (x, y) in {expected}, got ({x:g}, {y:g}); {mend}")


def read_global_descriptors(
    path: Path | str,
    names: Sequence[str],
    *,
    lengths: Lengths = "unit",
    check_entries: Callable[[list[FileEntry]], None] | None = None,
) -> Float32[np.ndarray, "images dimensions"]:
    """Global descriptors `[M, D]` of the images `names`, float32, in their order.

    Args:
        path: `.npy`: `[M, D]`, in the order of the names as Python sorts them (image10 before image2), such as
            VPR-methods-evaluation's `database_descriptors.npy`;
            `.npz`: `descriptors` `[M, D]` and `names` `[M]`; without `names`, the order of `.npy`;
            `.h5` or `.hdf5`: as hloc, a `global_descriptor` `[D]` for each image.
        names: `[M]` relative POSIX paths, matched as in `containers.match_names`.
        lengths: as in `open_features`.
        check_entries: called with the place of each image's descriptor.

    Raises:
        InputError: a damaged file, missing or ambiguous images, values that are not finite, or lengths that are not 1.
    """
    path = Path(path)
    require_word("lengths", lengths, Lengths)
    choose_reader(path, dict.fromkeys((".npy", ".npz", ".h5", ".hdf5"), Path))
    suffix = path.suffix.lower()
    if suffix in (".npy", ".npz"):
        if suffix == ".npz":
            arrays = read_npz(path, ("descriptors", "names"))
        else:
            with reading(path):
                arrays = {"descriptors": np.load(path, allow_pickle=False)}
        values, known = arrays.get("descriptors", np.zeros(0)), arrays.get("names")
        if known is None:  # in the order of the sorted names
            _require_rows(path, values, names)
            rows = np.argsort(np.argsort(np.array(names, object))).tolist()
            entries = [f"row {row}" for row in rows]
        else:
            if known.dtype.kind != "U" or known.shape != values.shape[:1]:
                got = f"{known.dtype}{list(known.shape)} and {list(values.shape)}"
                raise InputError(f"{path}: expected names as text [M] and descriptors [M, D], got {got}")
            require_different(path, known.tolist())
            places = {name: row for row, name in enumerate(known.tolist())}
            entries = require_all(path, names, match_names(path, names, places), "descriptors")
            rows = [places[entry] for entry in entries]
        values = values[rows]
    else:
        file = H5File(path)
        entries = require_all(path, names, match_names(path, names, file.entries), "descriptors")
        vectors = [parts.get(GLOBAL, np.zeros((0, 0))) for parts in file.read(entries, (GLOBAL,))]
        if len(shapes := {vector.shape for vector in vectors}) > 1:
            raise InputError(f"{path}: expected {GLOBAL} [D] of all images, one D, got {sorted(shapes)}; extract again")
        values = np.stack(vectors) if vectors else np.zeros((0, 0), np.float32)
    _require_rows(path, values, names)
    if check_entries is not None:
        check_entries([FileEntry(path, entry) for entry in entries])
    return _scaled(str(path), as_float32(str(path), values), lengths)


def write_global_descriptors(
    path: Path | str, names: Sequence[str], descriptors: Float[Array, "images dimensions"], *, half: bool = False
) -> None:
    """Write global descriptors `[M, D]` in the order of `names` as `read_global_descriptors` reads them, atomically.

    `path` is a new file, `.npy`, `.npz`, `.h5` or `.hdf5`; `half` means float16, as hloc by default.
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
        got = path.suffix or "no suffix"
        raise InputError(f"{path}: expected a name that ends with .npy, .npz, .h5 or .hdf5, got {got}; rename it")


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
        raise InputError(f"{where}: expected lengths above 0, got zeros at {int(norms.argmin())}; extract again")
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
