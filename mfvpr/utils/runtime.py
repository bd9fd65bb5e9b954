"""Settings of a call that change no result: devices, memory, progress, messages and a cluster."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from mfvpr.utils.cluster import Cluster, Result
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import Device
from mfvpr.utils.progress import Track, no_progress


@dataclass(frozen=True)
class Runtime:
    """Settings of a call that change no result.

        mfvpr.evaluate(data, system, runtime=mfvpr.Runtime(log=print, memory=2.0))

    Attributes:
        devices: that share the work; None = the default device of JAX.
        memory: GB that features of the database may take on the devices, and matches in memory; None = a third of what
            is free, or 2 GB in each worker of a cluster. Not above 0 raises an `InputError`.
        progress: label -> progress bar of the next loop.
        log: called with one line: the work to be done and the disk space it takes, or a warning.
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
        self, function: Callable[..., Result], shared: tuple[Any, ...], rows: Sequence[int], label: str, multiple: int
    ) -> list[Result]:
        """The result of `function(*shared, rows, track)`; with a cluster, of `function(*shared, block)` for each block.

        `track` is the progress with this label. The rows of a block are a multiple of `multiple`, but for the last.
        """
        track = self.progress(label)
        if self.cluster is None:
            return [function(*shared, rows, track)]
        return self.cluster.map(function, shared, rows, track, multiple)


DEFAULT_RUNTIME = Runtime()
