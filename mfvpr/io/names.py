"""Match the names in a file of another program to the images of a data set."""

import os
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath
from typing import TypeVar

from mfvpr.io.containers import FileEntry, shorten
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import IMAGE_SUFFIXES, printable

Entry = TypeVar("Entry")
Prefix = tuple[tuple[str, ...], tuple[str, ...]]  # folders only in the file's names, only in the images' names
ImageOfEntry = dict[tuple[int, int, str], Path]  # device, inode and name of an entry -> image
_NO_PREFIX: Prefix = ((), ())
_FULL_NAMES = "give names with their folders as the file has them"


def match_names(path: Path, names: Sequence[str], foreign: Iterable[str]) -> list[str | None]:
    """Find the name of each image in a file.

    A name matches if it is the relative path of the image, as in hloc; else if one of the two paths is the end of the
    other (a file name alone, or a path from another root); else if this holds without the suffixes of images. All
    images have the same prefix: if `1.jpg` is `db/1.jpg`, `2.jpg` is never `query/2.jpg`.

    Args:
        path: file, for messages.
        names: `[M]` relative POSIX paths of the data set's images.
        foreign: all names in the file; names of other images are ignored.

    Returns:
        `[M]` names in the file; None = the file lacks the image.

    Raises:
        InputError: an image has several possible names, images have different prefixes, or two images have one name.
    """
    require_different(path, names)
    foreign = dict.fromkeys(foreign)
    texts = {printable(name): name for name in foreign} | {printable(name): name for name in names if name in foreign}
    matched = [texts.get(printable(name)) for name in names]
    for spellings in (lambda name: [name], _stems):
        by_file = defaultdict(list)  # free names, and each as it may be spelled, by the last part of the path
        for name in foreign.keys() - set(matched):
            for spelling in spellings(printable(name)):
                by_file[PurePosixPath(spelling).name].append((name, _parts(spelling)))
        candidates = {}
        for row in (row for row, match in enumerate(matched) if match is None):
            spelling = spellings(printable(names[row]))[0]
            named_alike = by_file[PurePosixPath(spelling).name]
            candidates[row] = {name for name, parts in named_alike if _has_same_end(parts, _parts(spelling))}
        _choose(path, names, candidates, matched)
    return matched


def match_paths(path: Path, names: Sequence[str], paths: Sequence[str], foreign: Iterable[str]) -> list[str | None]:
    """Find images by their full `paths` `[M]`, or if no image has such a name, or () was given, as `match_names`."""
    foreign = list(foreign)
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
        raise InputError(
            f"{path}: expected {content} of all {len(names)} images, got {len(names) - len(missing)}; the first "
            f"without is {shorten(missing[0])} (names are paths below the folder)"
        )
    return [match for match in matched if match is not None]


def require_one_image(
    path: Path, images: Sequence[Path], entries: Sequence[FileEntry | None], known: ImageOfEntry
) -> None:
    """Raise an InputError if an entry of a file stands for two images, unless both paths lead to one file.

    `images` and `entries` `[M]` are of a folder; None = the file lacks the image. They are added to `known`, the images
    of the entries of earlier folders.
    """
    for image, entry in zip(images, entries, strict=True):
        if entry is None:
            continue
        status = entry.file.stat()  # identifies the file, which may have several paths
        other = known.setdefault((status.st_dev, status.st_ino, entry.name), image)
        if other != image and os.path.realpath(other) != os.path.realpath(image):
            name = shorten(entry.name or entry.file.name)
            first, second = (shorten(str(file), 300) for file in (other, image))
            raise InputError(
                f"{path}: expected one image for each entry, got {name} for {first} and for {second}; {_FULL_NAMES}, "
                "or a file for each folder"
            )


def adds_folders(name: str, match: str) -> bool:
    """Whether the name in a file has folders before the part that it shares with the image's name."""
    return bool(_prefix(name, match)[0])


def _choose(path: Path, names: Sequence[str], candidates: dict[int, set[str]], matched: list[str | None]) -> None:
    """Fill `matched` for pairs of an image and a foreign name that have no other candidates.

    Candidates have the prefix of earlier matches, or none: a name at the image's own path contradicts an earlier prefix
    and is an error.
    """
    examples: dict[Prefix, tuple[str, str]] = {}  # an image and its name in the file
    for name, match in zip(names, matched, strict=True):
        if match is not None:
            examples.setdefault(_prefix(name, match), (name, match))
    prefixes = {*examples, _NO_PREFIX}
    if examples:
        candidates = {
            row: {match for match in matches if _prefix(names[row], match) in prefixes}
            for row, matches in candidates.items()
        }
    num_images = Counter(name for row_candidates in candidates.values() for name in row_candidates)
    for row, row_candidates in candidates.items():
        if not row_candidates:
            continue
        if len(row_candidates) > 1 or num_images[next(iter(row_candidates))] > 1:
            several = " and ".join(shorten(name) for name in sorted(row_candidates)[:2])
            raise InputError(
                f"{path}: {shorten(names[row])}: expected its relative path in the file, got {several}, which may mean "
                f"other images as well; {_FULL_NAMES}"
            )
        matched[row] = match = next(iter(row_candidates))
        examples.setdefault(_prefix(names[row], match), (names[row], match))
    if len(examples) > 1:
        pairs = " but ".join(f"{shorten(match)} for {shorten(name)}" for name, match in [*examples.values()][:2])
        raise InputError(
            f"{path}: expected names with one prefix for all images of a folder, got {pairs}; give the prefix of the "
            "folder, or name the images by their relative paths"
        )


def _prefix(name: str, match: str) -> Prefix:
    """Folders before the shared end of both names."""
    ours, theirs = (tuple(_parts(text)) for text in (name, match))
    shared = min(len(ours), len(theirs))
    return theirs[: len(theirs) - shared], ours[: len(ours) - shared]


def _stems(name: str) -> list[str]:
    """The name without the suffix of an image, and itself, since a stem in a file may contain dots."""
    path = PurePosixPath(name)
    return [path.with_suffix("").as_posix(), name] if path.suffix.lower() in IMAGE_SUFFIXES else [name]


def _has_same_end(first: Sequence[str], second: Sequence[str]) -> bool:
    """Whether one of two paths is the end of the other."""
    shared = min(len(first), len(second))
    return first[len(first) - shared :] == second[len(second) - shared :]


def _parts(name: str) -> list[str]:
    return [part for part in name.split("/") if part not in ("", ".")]
