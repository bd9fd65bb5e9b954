"""Shards of one evaluation on many machines: a hash of its name assigns every image and query to a shard.

    try:
        cache = FeatureCache(root, shard=Shard(2, 8))
        mfvpr.evaluate(dataset, system, cache=cache)
    except NotYet as progress:
        print(progress, progress.is_complete)

A shard extracts its own images, then matches its own queries, and always ends with `NotYet`. If features of other
shards are missing, start it again when they are there. When all shards are complete, `evaluate` with
`FeatureCache(root)` reads features and matches, and returns the result. All runs use the candidates of the first shard,
even if their machines would round otherwise.
"""

import hashlib
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from mfvpr.utils.errors import InputError

MOST = 9999  # shards


class NotYet(Exception):
    """The end of a shard's work; its text is one line: what is done, or which rows of which shards are missing.

    Attributes:
        shards: with missing rows.
    """

    def __init__(self, message: str, shards: Iterable[int] = ()) -> None:
        """Take the message and the shards."""
        super().__init__(message)
        self.shards = frozenset(shards)

    @property
    def is_complete(self) -> bool:
        """Whether this shard has nothing left to do."""
        return not self.shards


@dataclass(frozen=True)
class Shard:
    """One shard of an evaluation.

    Attributes:
        index: of this shard, from 0.
        count: number of shards.
    """

    index: int
    count: int

    def __post_init__(self) -> None:
        if not (1 <= self.count <= MOST and 0 <= self.index < self.count):
            raise InputError(f"shard={self}: expected i/n with i from 0 to n - 1 and n up to {MOST}")

    def __str__(self) -> str:
        return f"{self.index}/{self.count}"

    @classmethod
    def parse(cls, text: str) -> "Shard":
        """The shard `i/n`; raises `InputError` if the text is something else."""
        if not (numbers := re.fullmatch(r"(\d{1,9})/(\d{1,9})", text, re.ASCII)):
            raise InputError(f"shard={text}: expected i/n, such as 0/8, the first of eight")
        return cls(int(numbers[1]), int(numbers[2]))

    @property
    def folder(self) -> str:
        """The name of a folder for this shard alone."""
        return f"{self.index}-of-{self.count}"

    def rows(self, names: Sequence[str], among: Sequence[int] | None = None) -> list[int]:
        """Rows of this shard, of all names or `among` rows: by a hash of the name, so that no order matters."""
        return [row for row in (range(len(names)) if among is None else among)
                if shard_of(names[row], self.count) == self.index]  # fmt: skip

    def require_rows(self, missing: Sequence[int], names: Sequence[str], what: str) -> None:
        """Raise `NotYet` if rows of other shards are missing; `what` names the rows in its message."""
        if missing:
            shards = {shard_of(names[row], self.count) for row in missing}
            raise NotYet(f"{what}: {len(missing)} of {len(names)} are missing, of shards {indices(shards)}", shards)


def shard_of(name: str, count: int) -> int:
    """Index of the shard of a name: the first 8 bytes of its SHA-256, big endian, modulo `count`."""
    return int.from_bytes(hashlib.sha256(name.encode("utf-8", "surrogateescape")).digest()[:8]) % count


def indices(numbers: Iterable[int]) -> str:
    """Indices as an array expression, such as `0,2-4`."""
    ranges: list[list[int]] = []
    for index in sorted(set(numbers)):
        if ranges and ranges[-1][1] == index - 1:
            ranges[-1][1] = index
        else:
            ranges.append([index, index])
    return ",".join(str(first) if first == last else f"{first}-{last}" for first, last in ranges)


def together(*calls: Callable[[], Any]) -> list[Any]:
    """The results of all calls; if one ends with `NotYet`, the rest are called all the same.

    Raises:
        NotYet: for all calls that lack rows, or else for all that are complete.
    """
    results, ends = [], []
    for call in calls:
        try:
            results.append(call())
        except NotYet as end:
            ends.append(end)
    if ends:
        lines = dict.fromkeys(str(end) for end in [end for end in ends if not end.is_complete] or ends)
        raise NotYet("; ".join(lines), frozenset[int]().union(*(end.shards for end in ends)))
    return results
