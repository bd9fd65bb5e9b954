"""Files with arrays by image: hloc's HDF5, NumPy's archives, folders of archives; their names and numbers."""

import zipfile
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import groupby
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float32, Shaped

from mfvpr.utils.errors import InputError
from mfvpr.utils.files import IMAGE_SUFFIXES, printable, replacing, require_file, require_replaceable

MAX_INFLATED = 1 << 30  # bytes of an array that a file stores compressed
SUFFIXES = (".npz", ".d2-net")  # of files in a folder; D2-Net's code writes `.d2-net`
Entry = TypeVar("Entry")
ImageOfEntry = dict[tuple[Path, str], Path]  # file and name of an entry -> image
_FULL_NAMES = "give names with their folders as the file has them"


class FileEntry(NamedTuple):
    """Place of an image's arrays."""

    file: Path
    name: str  # of the image in the file; "" = the file holds one image


class H5File:
    """An hloc file: images are the groups that hold datasets; `entries` are the places of their arrays by name."""

    transposed = True  # descriptors are `[D, N]` if their shapes fit both layouts

    def __init__(self, path: Path) -> None:
        self.path, names = path, list[str]()
        with self._open() as file:
            file.visit(names.append)  # follows no links
        groups = {name.rpartition("/")[0] for name in names}
        images = (name.rpartition("/")[0] for name in names if name not in groups)
        self.entries = {image: FileEntry(path, image) for image in images if image}
        if not self.entries:
            raise InputError(f"{path}: expected a group for every image, as in hloc, got no datasets; extract again")

    def read(self, images: Iterable[str], parts: Sequence[str], *, shapes: bool = False) -> Iterator[dict[str, Any]]:
        """For each image, its arrays among `parts`; their shapes alone, without reading values, if `shapes`."""
        with self._open() as file:
            for image in images:
                group = file[image]
                datasets = {part: self._dataset(file, group, image, part) for part in parts if part in group}
                yield {part: dataset.shape if shapes else dataset[()] for part, dataset in datasets.items()}

    def _dataset(self, file: Any, group: Any, image: str, part: str) -> Any:
        dataset, where = group[part], f"{self.path}: {shorten(image)}/{part}"
        has_values = getattr(dataset, "shape", None) is not None and not dataset.external and not dataset.is_virtual
        is_here = has_values and dataset.file.filename == file.filename
        stored = dataset.id.get_storage_size() if is_here else 0
        if not is_here or (dataset.size and not stored):  # HDF5 would read zeros
            got = "none, a group or a link; copy linked data into the file, or extract this image again"
            raise InputError(f"{where}: expected data in this file, got {got}")
        if dataset.nbytes > max(MAX_INFLATED, stored):
            got = f"{dataset.nbytes:,} bytes; write it uncompressed"
            raise InputError(f"{where}: expected at most 1 GiB in a compressed dataset, got {got}")
        return dataset

    @contextmanager
    def _open(self) -> Iterator[Any]:
        with reading(self.path), _h5py(self.path).File(self.path, "r") as file:
            yield file


class NpzFiles:
    """One archive for all images, or a folder with an archive for each image; attributes as of `H5File`.

    In one archive, arrays are named `image/part`: `a/1.jpg/keypoints`; request many images at once, since every call
    reads its directory. In a folder, files are `a/1.jpg.npz` or `a/1.jpg.d2-net`; hidden ones are skipped.
    """

    transposed = False

    def __init__(self, path: Path) -> None:
        self.path = path
        self.entries: dict[str, FileEntry] = {}
        if path.is_dir():
            for file in sorted(path.rglob("*")):
                inside = file.relative_to(path)
                if file.suffix not in SUFFIXES or any(part.startswith(".") for part in inside.parts):
                    continue
                first = self.entries.setdefault(inside.as_posix().removesuffix(file.suffix), FileEntry(file, "")).file
                if first != file:
                    raise InputError(f"{file}: expected one file of an image, got {first.name} as well; remove either")
        else:
            with _open_npz(path) as archive:
                images = (name.rpartition("/")[0] for name in archive.files)
                self.entries = {image: FileEntry(path, image) for image in images if image}
        if not self.entries:
            expected = f"arrays named by images (a.jpg/keypoints), or a folder of files {' or '.join(SUFFIXES)}"
            raise InputError(f"{path}: expected {expected}, got none; check the path")

    def read(self, images: Iterable[str], parts: Sequence[str], *, shapes: bool = False) -> Iterator[dict[str, Any]]:
        """As `H5File.read`."""
        for file, entries in groupby((self.entries[image] for image in images), key=lambda entry: entry.file):
            with _open_npz(file) as archive:
                known = {*archive.files}
                for entry in entries:
                    names = {part: f"{entry.name}/{part}" if entry.name else part for part in parts}
                    yield {part: _read(archive, name, shapes) for part, name in names.items() if name in known}


def read_npz(path: Path, parts: Iterable[str]) -> dict[str, np.ndarray]:
    """Read the arrays of an archive among `parts`, and no others; InputError if it is damaged, or holds objects."""
    with _open_npz(path) as archive:
        return {part: _read(archive, part) for part in parts if part in archive}


def write_npz(path: Path, arrays: Iterable[tuple[str, np.ndarray]]) -> None:
    """Write a new file of named arrays, one after the other, atomically."""
    require_replaceable(path)
    with replacing(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name, array in arrays:
            with archive.open(f"{printable(name)}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)


def write_h5(path: Path, groups: Iterable[tuple[str, Mapping[str, np.ndarray]]]) -> None:
    """Write a new file with a group for each image, one after the other, atomically; `libver` as in hloc."""
    require_replaceable(path)
    with replacing(path) as temporary, _h5py(path).File(temporary, "w", libver="latest") as file:
        for image, parts in groups:
            group = file.create_group(printable(image))
            for part, array in parts.items():
                group.create_dataset(part, data=array)


def read_npy_header(file: Any) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, whether the order is Fortran's, and type of an array of NumPy's; the file is then at its values."""
    is_first = np.lib.format.read_magic(file) == (1, 0)
    return (np.lib.format.read_array_header_1_0 if is_first else np.lib.format.read_array_header_2_0)(file)


def choose_reader(path: Path, readers: Mapping[str, Callable]) -> Callable:
    """The reader for a file's suffix; raise an InputError for a path that is no file, or has another suffix."""
    require_file(path)
    if path.suffix.lower() not in readers:
        raise InputError(f"{path}: expected a file named {', '.join(readers)}, got {path.suffix or 'no suffix'}")
    return readers[path.suffix.lower()]


@contextmanager
def reading(path: Path, kind: str = "a file", mend: str = "is it whole, and of this kind?") -> Iterator[None]:
    """Require a regular file, and turn any error of its reader into an InputError of one line with the path."""
    try:
        require_file(path, kind)
        yield
    except InputError as error:
        raise InputError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from None
    except Exception as error:  # zipfile, zlib, NumPy, HDF5 and decoders of images share no class of errors
        reason = getattr(error, "strerror", None) or " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path}: cannot be read ({shorten(reason, 160)}); {mend}") from None


def shorten(text: str, limit: int = 60) -> str:
    """Text of a file in at most `limit` printable characters, for messages."""
    start = text[: limit + 1]
    start = start if start.isprintable() else start.encode("unicode_escape").decode("ascii")
    return start if len(start) <= limit else f"{start[: limit - 20]}... ({len(text)} characters)"


def parse_number(text: str) -> float:
    """The number in a text, as C writes it, or a `ValueError`; Python's own `float` also reads `1_0` as 10."""
    if "_" in text or not text.isascii():
        raise ValueError(f"not a number: {text!r}")
    return float(text)


def as_float32(where: str, array: Shaped[np.ndarray, "..."], kinds: str = "f") -> Float32[np.ndarray, "..."]:
    """Convert an array of these kinds of numbers (`numpy.dtype.kind`) to float32; InputError for others."""
    with np.errstate(over="ignore", invalid="ignore"):
        values = np.ascontiguousarray(array, np.float32) if array.dtype.kind in kinds else None
    if values is None or not np.isfinite(values).all():
        got = array.dtype if values is None else f"{array[~np.isfinite(values)][0]}; extract it again"
        raise InputError(f"{where}: expected finite {'floating-point ' * (kinds == 'f')}numbers of float32, got {got}")
    return values


@contextmanager
def _open_npz(path: Path) -> Iterator[Any]:
    with reading(path), path.open("rb") as file:
        archive = np.load(file, allow_pickle=False)
        if not isinstance(archive, np.lib.npyio.NpzFile):
            raise InputError("expected an archive of NumPy (.npz), got an array; save it with np.savez")
        with archive:
            yield archive


def _read(archive: Any, name: str, shape: bool = False) -> Any:
    entry = archive.zip.getinfo(f"{name}.npy")
    if shape:
        with archive.zip.open(entry) as file:
            return read_npy_header(file)[0]
    if entry.file_size > max(MAX_INFLATED, entry.compress_size):
        got = f"{entry.file_size:,} bytes; write it uncompressed"
        raise InputError(f"{shorten(name)}: expected at most 1 GiB in a compressed array, got {got}")
    return np.asarray(archive[name])


def _h5py(path: Path) -> Any:
    try:
        import h5py
    except ImportError:
        raise InputError(f"{path}: expected the package h5py for HDF5, got none; pip install 'mfvpr[hloc]'") from None
    return h5py


def match_names(path: Path, names: Sequence[str], foreign: Iterable[str]) -> list[str | None]:
    """Find the name of each image in a file.

    A name matches if it is the relative path of the image; else if one of the two paths is the end of the other; else
    if this holds without the suffixes of images. All images have the same prefix: if `1.jpg` is `db/1.jpg`, `2.jpg` is
    never `query/2.jpg`.

    Args:
        path: file, for messages.
        names: `[M]` relative POSIX paths of the data set's images.
        foreign: all names in the file; names of other images are ignored.

    Returns:
        `[M]` names in the file; None = the file lacks the image. An `InputError` if an image has several possible
        names, images have different prefixes, or two images have one name.
    """
    require_different(path, names)
    foreign = dict.fromkeys(foreign)
    texts = {printable(name): name for name in foreign} | {printable(name): name for name in names if name in foreign}
    matched = [texts.get(printable(name)) for name in names]
    is_exact = any(matched)
    prefix = ((), ()) if is_exact else None  # folders only in the file's names, and only in the images' names
    for spellings in (lambda name: [name], _stems):
        free = defaultdict(list)  # names by the last part of each of their spellings
        for name in foreign.keys() - set(matched):
            for spelling in spellings(printable(name)):
                free[PurePosixPath(spelling).name].append((name, _parts(spelling)))
        pairs = dict[tuple[int, str], tuple]()  # row and name -> prefix
        for row in (row for row, match in enumerate(matched) if match is None):
            spelling = spellings(printable(names[row]))[0]
            parts = _parts(spelling)
            for name, name_parts in free[PurePosixPath(spelling).name]:
                shared = min(len(parts), len(name_parts))
                if parts[-shared:] == name_parts[-shared:]:  # one path is the end of the other
                    pairs[row, name] = name_parts[:-shared], parts[:-shared]
        is_known = prefix is not None
        prefix = prefix or next(iter(pairs.values()), None)
        chosen = [pair for pair in sorted(pairs) if pairs[pair] == prefix]
        rows, images = Counter(row for row, _ in chosen), Counter(name for _, name in chosen)
        for row, name in sorted(pairs):
            differs = pairs[row, name] != prefix and not is_exact and not (is_known and rows[row])
            if differs or rows[row] > 1 or images[name] > 1:
                expected = "one name for each image, and one prefix for all images of a folder"
                rivals = [pair for pair in sorted(pairs) if pair != (row, name) and (row in pair or name in pair)]
                both = [*(rivals or chosen)[:1], (row, name)]
                got = " and ".join(f"{shorten(name)} for {shorten(names[row])}" for row, name in both)
                raise InputError(f"{path}: expected {expected}, got {got}; {_FULL_NAMES}")
        for row, name in chosen:
            matched[row] = name
    return matched


def match_paths(path: Path, names: Sequence[str], paths: Sequence[str], foreign: Collection[str]) -> list[str | None]:
    """Find images by their full `paths` `[M]`, or if no image has such a name, or () was given, as `match_names`."""
    for kind in filter(None, (paths, names)):
        if any(matched := match_names(path, kind, foreign)):
            return matched
    return [None] * len(names)


def require_different(path: Path, names: Sequence[str]) -> None:
    """Raise an InputError if two images have the same name, or the same name as text in a file."""
    if twice := [name for name, count in Counter(map(printable, names)).items() if count > 1]:
        raise InputError(f"{path}: expected different names, got {shorten(twice[0])} twice; rename one of the images")


def require_all(path: Path, names: Sequence[str], matched: Sequence[Entry | None], content: str) -> list[Entry]:
    """Return what a file has of each image, if that is not None; InputError if it lacks the `content` of an image."""
    missing = [name for name, match in zip(names, matched, strict=True) if match is None]
    if missing:
        got = f"{len(names) - len(missing)}; the first without is {shorten(missing[0])} (names are paths in the folder)"
        raise InputError(f"{path}: expected {content} of all {len(names)} images, got {got}")
    return [match for match in matched if match is not None]


def require_one_image(
    path: Path, images: Sequence[Path], entries: Sequence[FileEntry | None], known: ImageOfEntry
) -> None:
    """Raise an InputError if an entry of a file stands for two images, unless both paths lead to one file.

    `entries` `[M]` of `images` are added to `known`, those of earlier folders; None = the file lacks the image.
    """
    resolved = {entry.file: entry.file.resolve() for entry in entries if entry is not None}
    for image, entry in zip(images, entries, strict=True):
        if entry is None:
            continue
        first = known.setdefault((resolved[entry.file], entry.name), image)
        if first != image and first.resolve() != image.resolve():
            name = shorten(entry.name or entry.file.name)
            got = f"{name} for {shorten(str(first), 300)} and for {shorten(str(image), 300)}"
            mend = f"{_FULL_NAMES}, or a file for each folder"
            raise InputError(f"{path}: expected one image for each entry, got {got}; {mend}")


def adds_folders(name: str, match: str) -> bool:
    """Whether the name in a file has folders before the part that it shares with the image's name."""
    return len(_parts(match)) > len(_parts(name))


def _stems(name: str) -> list[str]:
    """The name without the suffix of an image, and itself, since a stem in a file may contain dots."""
    path = PurePosixPath(name)
    return [path.with_suffix("").as_posix(), name] if path.suffix.lower() in IMAGE_SUFFIXES else [name]


def _parts(name: str) -> tuple[str, ...]:
    return tuple(part for part in name.split("/") if part not in ("", "."))
