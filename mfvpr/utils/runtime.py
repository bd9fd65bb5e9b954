"""How work runs: devices, memory, progress, messages, a cluster; work on threads, and seconds by stage."""

import itertools
import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, TypeVar

from mfvpr.utils.cluster import Cluster, Result
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import Device

Item = TypeVar("Item")
Track = Callable[[Iterable[Any], int], Iterable[Any]]  # (items, their number) -> the same items


def no_progress(items: Iterable[Item], total: int) -> Iterable[Item]:
    """No progress bar."""
    return items


@dataclass(frozen=True)
class Runtime:
    """Settings of a call that change no result.

        mfvpr.evaluate(data, system, runtime=mfvpr.Runtime(log=print, memory=2.0))

    Attributes:
        devices: that share the work; None = the default device of JAX.
        memory: GB that features of the database may take on the devices, and matches in memory; None = a third of what
            is free, or 2 GB in each worker of a cluster. Not above 0 raises an `InputError`.
        progress: label -> progress bar of the next loop.
        log: called with one line: the work to be done, or a warning.
        cluster: describes images and matches queries; None = this process. Retrieval and scores stay in this process.
    """

    devices: Sequence[Device] | None = None
    memory: float | None = None
    progress: Callable[[str], Track] = lambda label: no_progress
    log: Callable[[str], None] = lambda line: None
    cluster: Cluster | None = None

    def __post_init__(self) -> None:
        if self.memory is not None and not 0 < self.memory < math.inf:
            raise InputError(f"memory={self.memory!r}: expected GB above 0, or None")

    def map(
        self, function: Callable[..., Iterator[Result]], shared: tuple, rows: Sequence[int], label: str, multiple: int
    ) -> Iterator[Result]:
        """Results of `function(*shared, rows)`, one for each row, with progress.

        With a cluster, they come in blocks as these finish, of a multiple of `multiple` rows but for the last.
        """
        cluster = self.cluster
        results = function(*shared, rows) if cluster is None else cluster.map(function, shared, rows, multiple)
        return iter(self.progress(label)(results, len(rows)))


DEFAULT_RUNTIME = Runtime()


@dataclass
class Stopwatch:
    """Seconds by stage. A stage excludes the stages inside it."""

    seconds: dict[str, float] = field(default_factory=dict)
    _inside: list[float] = field(default_factory=list, repr=False)  # seconds of other stages inside each open one

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        self._inside.append(0)
        try:
            yield
        finally:
            total, inside = time.perf_counter() - start, self._inside.pop()
            if self._inside:
                self._inside[-1] += total
            self.seconds[stage] = round(self.seconds.get(stage, 0) + total - inside, 3)


def ordered_map(function: Callable[[Item], Result], items: Iterable[Item], *, workers: int) -> Iterator[Result]:
    """`map` on threads, for work that releases the interpreter lock: in order, at most 2 x `workers` ahead."""
    remaining, futures = iter(items), deque[Future[Result]]()
    pool = ThreadPoolExecutor(workers)
    try:
        while True:
            next_items = itertools.islice(remaining, 2 * workers - len(futures))
            futures.extend(pool.submit(function, item) for item in next_items)
            if not futures:
                return
            yield futures.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)
