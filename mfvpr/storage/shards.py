"""Shards of one evaluation on many machines: a hash of its name assigns every image and query to a shard.

    cache = FeatureCache(root, shard=Shard(2, 8))
    mfvpr.evaluate(dataset, extractor, filter, scorers, cache=cache)  # NotYet, until all eight are done

Each shard extracts its own images, then matches and scores its own queries. It raises `NotYet` when it needs rows that
other shards have not written; started again, it goes on from there. The last shard finds all rows and returns the
result. All shards use the candidates of the first shard, even if their machines would round otherwise. Stores are named
by the recipes of scorers and extractors, not by the functions that they call: after a change there, use another root.
"""

import hashlib
import math
import re
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from mfvpr.utils.errors import InputError

MOST = 9999  # shards
POLL = 1.0  # seconds between two looks at the rows of other shards


class NotYet(Exception):
    """Rows of other shards are missing; its text is one line that names the rows and the shards.

    Attributes:
        shards: with missing rows.
        is_complete: whether this shard has nothing left to do.
    """

    def __init__(self, message: str, shards: Iterable[int] = (), *, is_complete: bool = False) -> None:
        """Take the message and the attributes."""
        super().__init__(message)
        self.shards, self.is_complete = frozenset(shards), is_complete


@dataclass(frozen=True)
class Shard:
    """One shard of an evaluation.

    Attributes:
        index: of this shard, from 0.
        count: number of shards.
        meets: all shards run at the same time: each waits for the others as long as they take, and takes part in
            common steps (`mfvpr.evaluation.distributed`) even if it does not need their result.
    """

    index: int
    count: int
    meets: bool = False

    def __post_init__(self) -> None:
        """Check the numbers."""
        if not (1 <= self.count <= MOST and 0 <= self.index < self.count):
            raise InputError(f"shard={self}: expected i/n with i from 0 to n - 1 and n up to {MOST}")

    def __str__(self) -> str:
        return f"{self.index}/{self.count}"

    @classmethod
    def parse(cls, text: str) -> "Shard":
        """The shard `i/n`.

        Raises:
            InputError: the text is something else.
        """
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

    def wait(
        self,
        missing: Callable[[], Sequence[int]],
        names: Sequence[str],
        what: str,
        *,
        patience: float = 0.0,
        is_complete: bool = False,
    ) -> None:
        """Wait until other shards have written their rows.

        Args:
            missing: gives the rows that are missing now.
            names: of all rows.
            what: name of the rows in messages.
            patience: seconds.
            is_complete: see `NotYet`.

        Raises:
            NotYet: rows are still missing.
        """
        end = time.monotonic() + (math.inf if self.meets else patience)
        while rows := missing():
            if (seconds := end - time.monotonic()) <= 0:
                shards = {shard_of(names[row], self.count) for row in rows}
                line = f"{what}: {len(rows)} of {len(names)} are missing, of shards {indices(shards)}"
                raise NotYet(line, shards, is_complete=is_complete)
            time.sleep(min(POLL, seconds))


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
    """The results of all calls; if one waits for other shards, the rest are called all the same.

    Raises:
        NotYet: for all calls that wait.
    """
    results, waits = [], []
    for call in calls:
        try:
            results.append(call())
        except NotYet as error:
            waits.append(error)
    if waits:
        lines = dict.fromkeys(map(str, waits))
        shards = frozenset[int]().union(*(wait.shards for wait in waits))
        raise NotYet("; ".join(lines), shards, is_complete=all(wait.is_complete for wait in waits))
    return results
