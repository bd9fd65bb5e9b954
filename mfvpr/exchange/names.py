"""Which image of a file of another program is which image of the data set."""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path, PurePosixPath

from mfvpr.data.files import printable
from mfvpr.data.images import SUFFIXES
from mfvpr.errors import InputError
from mfvpr.exchange.containers import shortened


def match_names(path: Path, names: Sequence[str], foreign: Iterable[str]) -> list[str | None]:
    """What a file calls each image.

    An image is called by its relative path, as in hloc; else by a path that is the end of its own or has its own as its
    end (so a file name alone, or a path from another root); else the same without the suffixes of images. Paths that
    differ in a folder are different images.

    Args:
        path: file, for messages.
        names: `[M]` relative POSIX paths of the data set's images.
        foreign: all that the file calls images; those of other data sets are not looked at.

    Returns:
        `[M]` names in the file; None = the file lacks the image.

    Raises:
        InputError: several could be meant, or the data set has a name twice.
    """
    if twice := [name for name, count in Counter(names).items() if count > 1]:
        raise InputError(f"{path}: expected images with different names, got {shortened(twice[0])} twice")
    plain = {printable(name): name for name in foreign}
    matched: list[str | None] = [printable(name) if printable(name) in plain else None for name in names]
    for variants in (_whole, _stems):
        free = plain.keys() - set(matched)
        rows = [row for row, match in enumerate(matched) if match is None]
        if free and rows:
            _match_ends(path, names, rows, _Ends(free, variants), matched)
    return [None if match is None else plain[match] for match in matched]


def require_all(path: Path, names: Sequence[str], matched: Sequence[str | None], what: str) -> None:
    """Refuse a file that lacks images."""
    missing = [name for name, match in zip(names, matched, strict=True) if match is None]
    if missing:
        raise InputError(
            f"{path}: expected {what} of all {len(names)} images, got {len(names) - len(missing)}; the first without "
            f"is {shortened(missing[0])} (images are called by their paths below their folder)"
        )


Variants = Callable[[str], list[str]]


class _Ends:
    """Foreign names by what they are, and by every end of them."""

    def __init__(self, foreign: Iterable[str], variants: Variants) -> None:
        self.variants = variants
        self.by_variant: dict[str, set[str]] = defaultdict(set)
        self.by_end: dict[str, set[str]] = defaultdict(set)
        for name in foreign:
            for variant in variants(name):
                self.by_variant[variant].add(name)
                for end in _ends(variant):
                    self.by_end[end].add(name)

    def candidates(self, name: str) -> set[str]:
        """Foreign names that may mean this image."""
        wanted = self.variants(name)[0]
        shorter = (self.by_variant.get(end, set()) for end in _ends(wanted))
        return set().union(self.by_end.get(wanted, set()), *shorter)


def _match_ends(path: Path, names: Sequence[str], rows: list[int], ends: _Ends, matched: list[str | None]) -> None:
    """Fill `matched` where one foreign name and one image mean each other alone."""
    candidates = {row: ends.candidates(printable(names[row])) for row in rows}
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
        matched[row] = next(iter(possible))


def _whole(name: str) -> list[str]:
    return [name]


def _stems(name: str) -> list[str]:
    """Without the suffix of an image, or as it is: files named by stems have none, and stems may hold dots."""
    path = PurePosixPath(name)
    return [path.with_suffix("").as_posix(), name] if path.suffix.lower() in SUFFIXES else [name]


def _ends(name: str) -> Iterator[str]:
    """The path and every end of it: a/b/c, b/c, c."""
    parts = [part for part in name.split("/") if part not in ("", ".")]
    return ("/".join(parts[start:]) for start in range(len(parts)))
