"""Work on many processes or machines, by Dask Distributed (extra `cluster`).

with Cluster.local(4) as cluster:
    mfvpr.evaluate(dataset, system, cache=FeatureCache("features"), runtime=Runtime(cluster=cluster))
"""

import os
import shlex
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager
from functools import partial
from multiprocessing import resource_tracker
from typing import Any, TypeVar

from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import available_cpus, round_up
from mfvpr.utils.progress import Track
from mfvpr.utils.versions import versions

BLOCK = 32  # rows of a task at most, which a killed worker loses
_BLOCKS = 16  # tasks at least, if there are so many rows
_SETTINGS = {  # of Dask
    "distributed.scheduler.no-workers-timeout": "30 minutes",  # then a call ends with an error
    "distributed.nanny.pre-spawn-environ.DASK_LOGGING__DISTRIBUTED": "critical",  # the client raises errors of blocks
    "distributed.admin.large-graph-warning-threshold": "8 GB",  # extractors include the weights of their networks
}

Result = TypeVar("Result")


class Cluster:
    """Workers that describe images and match queries in blocks, and write the results to the folder of one cache.

    All machines must have the folders of the cache and of the images under the same paths, and the same versions, which
    every block checks. If a worker dies, another worker repeats its block. Results are those of one process to the bit
    if all machines have the same kind of processor or GPU, the same number of XLA threads, and the same options of JAX,
    which workers read from their environment. Put extractors and matchers of your own into a module that workers can
    import.
    """

    def __init__(self, client: Any) -> None:
        """Use the workers of a `distributed.Client`, whatever started them; one thread per worker is best."""
        self._client = client

    def __str__(self) -> str:
        address = self._client.scheduler.address
        return f"{len(self._client.nthreads())} workers at {address}, dashboard {self._client.dashboard_link}"

    @classmethod
    @contextmanager
    def connect(cls, address: str) -> Iterator["Cluster"]:
        """The workers of the scheduler at `tcp://HOST:PORT`."""
        try:
            client = _distributed().Client(address, set_as_default=False)
        except OSError:
            raise InputError(f"cluster: expected a scheduler at {address}, got no answer; check the address") from None
        with client:
            yield cls(client)

    @classmethod
    @contextmanager
    def local(cls, workers: int, **options: Any) -> Iterator["Cluster"]:
        """Start worker processes on this machine, until the block ends.

        Each has an equal share of the processors, or as many threads of XLA as the variable PJRT_NPROC says. Scripts
        need `if __name__ == "__main__":` before it. `options` are those of `distributed.LocalCluster`.
        """
        distributed = _distributed()
        threads = os.environ.get("PJRT_NPROC") or str(max(1, available_cpus() // max(1, workers)))
        defaults = {
            "n_workers": workers, "threads_per_worker": 1, "memory_limit": 0,  # Dask does not count JAX's memory
            "dashboard_address": ":0", "env": {"PJRT_NPROC": threads},
        }  # fmt: skip
        with _settings(), _without_ctrl_c():
            started = distributed.LocalCluster(**(defaults | options))
        with started, cls.connect(started) as cluster:
            yield cluster

    @classmethod
    @contextmanager
    def slurm(cls, workers: int, options: str = "", log: Callable[[str], None] = print) -> Iterator["Cluster"]:
        """Start an array of Slurm jobs with one worker each, until the block ends.

        `options` are those of `sbatch`, such as `--partition=gpu --gpus=1`. `log` is called with one line.
        """
        with cls.local(0, host="tcp://") as cluster:
            worker = [sys.executable, "-m", "distributed.cli.dask_worker", cluster._client.scheduler.address,
                      "--nthreads=1", "--memory-limit=0", "--no-dashboard", "--death-timeout=60"]  # fmt: skip
            script = f"export PJRT_NPROC=${{PJRT_NPROC:-${{SLURM_CPUS_PER_TASK:-1}}}}; exec {shlex.join(worker)}"
            array = ["--parsable", "--requeue", "--job-name=mfvpr", f"--array=1-{workers}"]
            job = _slurm("sbatch", *array, *shlex.split(options), f"--wrap={script}").partition(";")[0].strip()
            try:
                log(f"cluster: job {job} of Slurm, up to {workers} workers; work begins with the first")
                yield cluster
            finally:
                _slurm("scancel", job)

    def map(
        self,
        function: Callable[..., Result],
        shared: tuple[Any, ...],
        rows: Sequence[int],
        track: Track,
        *,
        multiple: int,
    ) -> list[Result]:
        """Call `function(*shared, block)` for blocks of `rows`; results are in the order in which blocks finish.

        Args:
            function: called in the workers.
            shared: arguments that each worker receives once.
            rows: are split into blocks.
            track: progress over the rows.
            multiple: all blocks but the last have a multiple of so many rows.

        Raises:
            InputError: raised by a block; or all workers, or the scheduler, are lost.
        """
        size = round_up(min(BLOCK, len(rows) // _BLOCKS), multiple)
        blocks = [rows[start : start + size] for start in range(0, len(rows), size)]
        with _settings(), _lost_as_input_error(self._client):
            self._client.wait_for_workers(1)
            # A task, not scattered data: Dask repeats it if its worker dies.
            value = self._client.submit(_same, shared, pure=False)
            task = partial(_run, versions(), function)
            futures = {self._client.submit(task, value, block, pure=False): block for block in blocks}
            results: list[Result] = []
            try:
                for _ in track(self._finished_rows(futures, results), len(rows)):
                    pass
            finally:
                for future in futures:
                    future.release()
        return results

    def _finished_rows(self, futures: dict[Any, Sequence[int]], results: list[Any]) -> Iterator[int]:
        """Move results from futures to a list, and yield the rows of their blocks."""
        for future in _distributed().as_completed(list(futures), loop=self._client.loop):
            results.append(future.result())
            yield from futures.pop(future)  # Dask would repeat the block if its worker died while the future exists


def _same(value: Any) -> Any:
    return value


def _run(expected: dict[str, str], function: Callable[..., Any], shared: tuple[Any, ...], block: Sequence[int]) -> Any:
    """Run a block in a worker that has the expected versions."""
    for name, version in expected.items():
        if (got := versions()[name]) != version:
            raise InputError(f"cluster: expected {name} {version} on all workers, got {got} on {socket.gethostname()}")
    return function(*shared, block)


@contextmanager
def _lost_as_input_error(client: Any) -> Iterator[None]:
    """Raise the loss of workers or of the scheduler as an InputError of one line."""
    distributed, again = _distributed(), "finished blocks are in the cache; run again to go on"
    try:
        yield
    except distributed.KilledWorker as error:
        number, last = error.allowed_failures + 1, error.last_worker.address
        raise InputError(f"cluster: {number} workers died in the same block, the last at {last}; give workers more "
                         f"memory; {again}") from None  # fmt: skip
    except distributed.scheduler.NoWorkerError:
        raise InputError(f"cluster: no worker is left; {again}") from None
    except (CancelledError, distributed.comm.CommClosedError):
        raise InputError(f"cluster: the scheduler at {client.scheduler.address} is gone; {again}") from None


def _distributed() -> Any:
    try:
        import distributed
    except ImportError:
        raise InputError("cluster: Dask Distributed is not installed; pip install 'mfvpr[cluster]'") from None
    return distributed


@contextmanager
def _without_ctrl_c() -> Iterator[None]:
    """Hide Ctrl-C from threads that start in the block, and from their processes; this thread gets it after the block.

    A terminal sends Ctrl-C to all processes, but the client ends the workers.
    """
    resource_tracker.ensure_running()  # its start unblocks the signal
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _settings() -> Any:
    """Settings of Dask in a block."""
    from dask import config

    return config.set(_SETTINGS)


def _slurm(*command: str) -> str:
    """Output of a command of Slurm."""
    try:
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout
    except FileNotFoundError:
        raise InputError(f"cluster: expected Slurm's command {command[0]} on this machine, got none") from None
    except subprocess.CalledProcessError as error:
        raise InputError(f"cluster: {command[0]} failed: {' '.join(error.stderr.split())}") from None
