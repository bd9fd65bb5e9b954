"""Read lists of image pairs: hloc's `query database` and kapture's `query, reference, score`."""

import re
from collections.abc import Collection, Iterator, Sequence, Set
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from mfvpr.io.containers import reading, shorten
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import printable
from mfvpr.utils.numbers import parse_number

_SEPARATOR = re.compile(r"\s*,\s*|\s+")
_SCORED = re.compile(r"(.*?)\s*,\s*([-+.\w]+)")


class Pair(NamedTuple):
    """Names of an image pair, and its score if the line has one."""

    query: str
    database: str
    score: float | None = None


def read_pairs(path: Path, query_names: Sequence[str], database_names: Sequence[str]) -> list[Pair]:
    """Read the pairs of a file, in its order.

    Names may contain spaces or commas: of all splits of a line, the one with known names counts. (hloc splits at every
    space.) Lines that begin with # and hold no known pair are comments.

    Raises:
        InputError: a line has no split with known names, or several.
    """
    with reading(path, mend="expected a text file of image pairs"):
        text = path.read_text(encoding="utf-8-sig", errors="surrogateescape")
    sides = [{printable(name) for name in names} for names in (query_names, database_names)]
    ends = [{end for name in names for end in _ends(name)} for names in sides]
    pairs = []
    for number, line in enumerate(text.split("\n"), start=1):
        stripped = printable(line.strip())
        if stripped and (pair := _pair(f"{path}: line {number}", stripped, sides, ends)):
            pairs.append(pair)
    return pairs


def _ends(name: str) -> tuple[str, str]:
    """File name and stem, which may stand for an image."""
    return PurePosixPath(name).name, PurePosixPath(name).stem


def _pair(where: str, line: str, sides: Sequence[Set[str]], ends: Sequence[Set[str]]) -> Pair | None:
    """The pair of a line; `sides` are the paths of query and database images, `ends` the ends of these paths."""
    words = line.split()
    if len(words) == 2 and words[0] in sides[0] and words[1] in sides[1]:
        return Pair(words[0], words[1])  # nearly every line of hloc
    splits = list(_splits(line))
    pairs = [pair for pair in splits if pair.query in sides[0] and pair.database in sides[1]]
    pairs = pairs or [pair for pair in splits if _ends(pair.query)[0] in ends[0] and _ends(pair.database)[0] in ends[1]]
    if len(pairs) == 1:
        return pairs[0]
    if not pairs and line.startswith("#"):
        return None
    got = "several ways to read" if pairs else "names of none in"
    raise InputError(f"{where}: expected the names of a query and a database image, got {got} {shorten(line)!r}")


def _splits(line: str) -> Iterator[Pair]:
    """All pairs that a line may mean."""
    for separator in _SEPARATOR.finditer(line):
        query, database = line[: separator.start()], line[separator.end() :]
        yield Pair(query, database)
        if scored := _SCORED.fullmatch(database):
            with suppress(ValueError):  # the last word is no number
                yield Pair(query, scored[1], parse_number(scored[2]))


def require_lines(path: Path, names: Collection[str]) -> None:
    """Raise an InputError for names with line breaks, or with spaces at an end."""
    for name in names:
        if name != name.strip() or "\n" in name or "\r" in name:
            raise InputError(f"{path}: expected names of one line without spaces around, got {name!r}; write .npz")
