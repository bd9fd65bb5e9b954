"""Settings of a call that change no result: devices, memory, progress, messages and a cluster."""

import math
from collections.abc import Callable, Iterator, Sequence
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
        self,
        function: Callable[..., Iterator[Result]],
        shared: tuple[Any, ...],
        rows: Sequence[int],
        label: str,
        multiple: int,
    ) -> Iterator[Result]:
        """Results of `function(*shared, rows)`, one for each row; with a cluster, of `function(*shared, block)`.

        With a cluster, results come block by block, as blocks finish; the rows of a block are a multiple of `multiple`,
        but for the last. The progress has this label.
        """
        cluster = self.cluster
        results = function(*shared, rows) if cluster is None else cluster.map(function, shared, rows, multiple)
        return iter(self.progress(label)(results, len(rows)))


DEFAULT_RUNTIME = Runtime()
