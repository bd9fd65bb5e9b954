"""Match the names in a file of another program to the images of a data set."""

from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path, PurePosixPath
from typing import TypeVar

from mfvpr.io.containers import FileEntry, shorten
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import IMAGE_SUFFIXES, printable

Entry = TypeVar("Entry")
ImageOfEntry = dict[tuple[Path, str], Path]  # file and name of an entry -> image
_FULL_NAMES = "give names with their folders as the file has them"


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
        `[M]` names in the file; None = the file lacks the image.

    Raises:
        InputError: an image has several possible names, images have different prefixes, or two images have one name.
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
            ours = spellings(printable(names[row]))[0]
            parts = _parts(ours)
            for name, theirs in free[PurePosixPath(ours).name]:
                shared = min(len(parts), len(theirs))
                if parts[-shared:] == theirs[-shared:]:  # one path is the end of the other
                    pairs[row, name] = theirs[:-shared], parts[:-shared]
        is_known = prefix is not None
        prefix = prefix or next(iter(pairs.values()), None)
        chosen = [pair for pair in sorted(pairs) if pairs[pair] == prefix]
        rows, images = Counter(row for row, _ in chosen), Counter(name for _, name in chosen)
        for row, name in sorted(pairs):
            has_other_prefix = pairs[row, name] != prefix and not is_exact and not (is_known and rows[row])
            if has_other_prefix or rows[row] > 1 or images[name] > 1:
                expected = "one name for each image, and one prefix for all images of a folder"
                others = [each for each in sorted(pairs) if each != (row, name) and (row in each or name in each)]
                both = [*(others or chosen)[:1], (row, name)]
                got = " and ".join(f"{shorten(theirs)} for {shorten(names[ours])}" for ours, theirs in both)
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
    resolved = {entry.file: entry.file.resolve() for entry in entries if entry is not None}
    for image, entry in zip(images, entries, strict=True):
        if entry is None:
            continue
        other = known.setdefault((resolved[entry.file], entry.name), image)
        if other != image and other.resolve() != image.resolve():
            name = shorten(entry.name or entry.file.name)
            raise InputError(
                f"{path}: expected one image for each entry, got {name} for {shorten(str(other), 300)} and for "
                f"{shorten(str(image), 300)}; {_FULL_NAMES}, or a file for each folder"
            )


def adds_folders(name: str, match: str) -> bool:
    """Whether the name in a file has folders before the part that it shares with the image's name."""
    return len(_parts(match)) > len(_parts(name))


def _stems(name: str) -> list[str]:
    """The name without the suffix of an image, and itself, since a stem in a file may contain dots."""
    path = PurePosixPath(name)
    return [path.with_suffix("").as_posix(), name] if path.suffix.lower() in IMAGE_SUFFIXES else [name]


def _parts(name: str) -> tuple[str, ...]:
    return tuple(part for part in name.split("/") if part not in ("", "."))
