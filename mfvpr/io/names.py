"""Which image of a file of another program is which image of the data set."""

import os
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path, PurePosixPath

from mfvpr.io.containers import FileEntry, shortened
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import IMAGE_SUFFIXES, printable

Prefix = tuple[tuple[str, ...], tuple[str, ...]]  # folders that only the file's names have, only the images' names
ImageOfEntry = dict[tuple[int, int, str], Path]  # image of an entry, by the device, inode and name of the entry
_NO_PREFIX: Prefix = ((), ())


def match_names(path: Path, names: Sequence[str], foreign: Iterable[str]) -> list[str | None]:
    """The name that a file has for each image.

    A name is the relative path of an image, as in hloc; else a path that is the end of the image's path or ends in it
    (a file name alone, or a path from another root); else the same without the suffixes of images. One prefix holds
    for all images: where `1.jpg` is `db/1.jpg`, `2.jpg` is never `query/2.jpg`.

    Args:
        path: file, for messages.
        names: `[M]` relative POSIX paths of the data set's images.
        foreign: all names of the file; names of images of other data sets are ignored.

    Returns:
        `[M]` names in the file; None = the file lacks the image.

    Raises:
        InputError: an image has several possible names, images have different prefixes, or two images have one name.
    """
    require_different(path, names)
    foreign = dict.fromkeys(foreign)
    texts = {printable(name): name for name in foreign} | {printable(name): name for name in names if name in foreign}
    matched = [texts.get(printable(name)) for name in names]
    for variants in (_whole, _stems):
        free = foreign.keys() - set(matched)
        rows = [row for row, match in enumerate(matched) if match is None]
        if free and rows:
            _match_ends(path, names, rows, _Ends(free, variants), matched)
    return matched


def require_different(path: Path, names: Sequence[str]) -> None:
    """Refuse images whose names are the same, or become the same where a file holds them as text."""
    if twice := [name for name, count in Counter(map(printable, names)).items() if count > 1]:
        raise InputError(
            f"{path}: expected images with different names, got {shortened(twice[0])} twice; rename one of the images"
        )


def require_all(path: Path, names: Sequence[str], matched: Sequence[str | None], what: str) -> None:
    """Refuse a file that lacks images."""
    missing = [name for name, match in zip(names, matched, strict=True) if match is None]
    if missing:
        raise InputError(
            f"{path}: expected {what} of all {len(names)} images, got {len(names) - len(missing)}; the first without "
            f"is {shortened(missing[0])} (images are called by their paths below their folder)"
        )


Variants = Callable[[str], list[str]]


def require_one_image(
    path: Path, images: Sequence[Path], entries: Sequence[FileEntry | None], known: ImageOfEntry
) -> None:
    """Refuse an entry that stands for images of two folders.

    Args:
        path: file or folder, for messages.
        images: `[M]` paths of a folder's images.
        entries: `[M]` their entries; None = the file lacks the image.
        known: images of entries so far. The images of this folder are added.

    Raises:
        InputError: an entry has another image in `known`, unless both paths lead to one file.
    """
    for image, entry in zip(images, entries, strict=True):
        if entry is None:
            continue
        status = entry.file.stat()  # one file may have several paths
        other = known.setdefault((status.st_dev, status.st_ino, entry.name), image)
        if other != image and os.path.realpath(other) != os.path.realpath(image):
            name = shortened(entry.name or entry.file.name)
            first, second = (shortened(str(file), 300) for file in (other, image))
            raise InputError(
                f"{path}: expected one image for each entry, got {name} for {first} and for {second}; "
                "give names with their folders as the file has them, or a file for each folder"
            )


def adds_folders(name: str, match: str) -> bool:
    """Whether a matched name has folders before the part that it shares with the image's name."""
    return bool(_prefix(name, match)[0])


class _Ends:
    """Foreign names by what they are, and by every end of them."""

    def __init__(self, foreign: Iterable[str], variants: Variants) -> None:
        self.variants = variants
        self.by_variant: dict[str, set[str]] = defaultdict(set)
        self.by_end: dict[str, set[str]] = defaultdict(set)
        for name in foreign:
            for variant in variants(printable(name)):
                self.by_variant[variant].add(name)
                for end in _ends(variant):
                    self.by_end[end].add(name)

    def candidates(self, name: str) -> set[str]:
        """Foreign names that may mean this image."""
        wanted = self.variants(printable(name))[0]
        shorter = (self.by_variant.get(end, set()) for end in _ends(wanted))
        return set().union(self.by_end.get(wanted, set()), *shorter)


def _match_ends(path: Path, names: Sequence[str], rows: list[int], ends: _Ends, matched: list[str | None]) -> None:
    """Fill `matched` where one foreign name and one image mean each other alone, with the prefix of earlier matches.

    A name at the image's own path contradicts another prefix of earlier matches: it is not ignored.
    """
    examples: dict[Prefix, tuple[str, str]] = {}  # an image and its name in the file
    for name, match in zip(names, matched, strict=True):
        if match is not None:
            examples.setdefault(_prefix(name, match), (name, match))
    prefixes = {*examples, _NO_PREFIX}
    candidates = {
        row: {match for match in ends.candidates(names[row]) if not examples or _prefix(names[row], match) in prefixes}
        for row in rows
    }
    claims = Counter(name for possible in candidates.values() for name in possible)
    for row, possible in candidates.items():
        if not possible:
            continue
        if len(possible) > 1 or claims[next(iter(possible))] > 1:
            several = " and ".join(shortened(name) for name in sorted(possible)[:2])
            raise InputError(
                f"{path}: {shortened(names[row])}: expected its relative path in the file, got {several}, which may "
                "mean other images as well; give names with their folders as the file has them"
            )
        matched[row] = match = next(iter(possible))
        examples.setdefault(_prefix(names[row], match), (names[row], match))
    if len(examples) > 1:
        pairs = " but ".join(f"{shortened(match)} for {shortened(name)}" for name, match in [*examples.values()][:2])
        raise InputError(
            f"{path}: expected names with one prefix for all images of a folder, got {pairs}; give the prefix of the "
            "folder, or name the images by their relative paths"
        )


def _prefix(name: str, match: str) -> Prefix:
    """Folders before the part that both names share."""
    ours, theirs = (tuple(_parts(text)) for text in (name, match))
    shared = min(len(ours), len(theirs))
    return theirs[: len(theirs) - shared], ours[: len(ours) - shared]


def _whole(name: str) -> list[str]:
    return [name]


def _stems(name: str) -> list[str]:
    """Without the suffix of an image, or as it is: files named by stems have none, and stems may hold dots."""
    path = PurePosixPath(name)
    return [path.with_suffix("").as_posix(), name] if path.suffix.lower() in IMAGE_SUFFIXES else [name]


def _ends(name: str) -> Iterator[str]:
    """The path and every end of it: a/b/c, b/c, c."""
    parts = _parts(name)
    return ("/".join(parts[start:]) for start in range(len(parts)))


def _parts(name: str) -> list[str]:
    return [part for part in name.split("/") if part not in ("", ".")]
