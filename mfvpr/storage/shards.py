"""Work that many machines share without a word between them: images and queries by a hash of their names.

    archive = Archive(root, shard=Shard(2, 8))
    mfvpr.evaluate(dataset, extractor, filter, scorers, archive=archive)  # NotYet, until all eight have done theirs

Each takes its own images, then matches and scores its own queries, and stops (`NotYet`) where it needs what others
have not done: started again, it goes on from there. The last one finds everything, and gives the result. Candidates are
those that the first shard found, whatever bits another machine would give. Scores are kept by what scorers are, as
features by their extractors, not by what these call: after a change there, the stores must be others.
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
POLL = 1.0  # seconds between two looks at what others have done


class NotYet(Exception):
    """What other shards have not done; its text is one line, which says what and whose.

    Attributes:
        shards: that lack something.
        is_complete: whether this shard has nothing left to do.
    """

    def __init__(self, what: str, shards: Iterable[int] = (), *, is_complete: bool = False) -> None:
        """See the class."""
        super().__init__(what)
        self.shards, self.is_complete = frozenset(shards), is_complete


@dataclass(frozen=True)
class Shard:
    """One part of several of all work.

    Attributes:
        index: of this part, from 0.
        count: of parts.
        meets: all are at work at the same time: each waits for the others as long as they take, and does what they do
            together (`mfvpr.evaluation.distributed`) also where it needs no more of it.
    """

    index: int
    count: int
    meets: bool = False

    def __post_init__(self) -> None:
        """Refuse a part that there is not."""
        if not (1 <= self.count <= MOST and 0 <= self.index < self.count):
            raise InputError(f"shard={self}: expected i/n with i from 0 to n - 1 and n up to {MOST}")

    def __str__(self) -> str:
        return f"{self.index}/{self.count}"

    @classmethod
    def parse(cls, text: str) -> "Shard":
        """Of `i/n`.

        Raises:
            InputError: something else.
        """
        if not (found := re.fullmatch(r"(\d{1,9})/(\d{1,9})", text, re.ASCII)):
            raise InputError(f"shard={text}: expected i/n, such as 0/8, the first of eight")
        return cls(int(found[1]), int(found[2]))

    @property
    def folder(self) -> str:
        """The name of what is this part's alone."""
        return f"{self.index}-of-{self.count}"

    def rows(self, names: Sequence[str], among: Sequence[int] | None = None) -> list[int]:
        """Rows of the names that are this part's, of all or among some: by a hash, so that no order matters."""
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
        """Until nothing is missing that other shards make.

        Args:
            missing: rows that are, looked up anew.
            names: of all rows.
            what: rows are, for people.
            patience: seconds.
            is_complete: see `NotYet`.

        Raises:
            NotYet: some still are.
        """
        end = time.monotonic() + (
            math.inf if self.meets else patience
        )  # of this machine alone: clocks of others may say anything
        while lacking := missing():
            if (left := end - time.monotonic()) <= 0:
                whose = {shard_of(names[row], self.count) for row in lacking}
                line = f"{what}: {len(lacking)} of {len(names)} are missing, of shards {indices(whose)}"
                raise NotYet(line, whose, is_complete=is_complete)
            time.sleep(min(POLL, left))


def shard_of(name: str, count: int) -> int:
    """Which of so many parts a name belongs to: the first 8 bytes of its SHA-256, big endian, modulo `count`."""
    return int.from_bytes(hashlib.sha256(name.encode("utf-8", "surrogateescape")).digest()[:8]) % count


def indices(some: Iterable[int]) -> str:
    """As an array expression, such as `0,2-4`."""
    ordered, parts = sorted(set(some)), []
    for index in ordered:
        if parts and parts[-1][1] == index - 1:
            parts[-1][1] = index
        else:
            parts.append([index, index])
    return ",".join(str(first) if first == last else f"{first}-{last}" for first, last in parts)


def together(*calls: Callable[[], Any]) -> list[Any]:
    """What each of them gives; where some wait for other shards, the others are made all the same.

    Raises:
        NotYet: for all of them.
    """
    given, waits = [], []
    for call in calls:
        try:
            given.append(call())
        except NotYet as error:
            waits.append(error)
    if waits:
        lines = dict.fromkeys(map(str, waits))
        whose = frozenset[int]().union(*(wait.shards for wait in waits))
        raise NotYet("; ".join(lines), whose, is_complete=all(wait.is_complete for wait in waits))
    return given
