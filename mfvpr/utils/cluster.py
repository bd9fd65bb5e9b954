"""Many processes and machines, by Dask Distributed (extra `cluster`), which is imported when it is used.

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

BLOCK = 32  # rows of a task at most: all that a killed worker loses
_BLOCKS = 16  # tasks at least, if there are as many rows
_SETTINGS = {  # of Dask
    "distributed.scheduler.no-workers-timeout": "30 minutes",  # then a run ends
    "distributed.nanny.pre-spawn-environ.DASK_LOGGING__DISTRIBUTED": "critical",  # errors of blocks are raised here
    "distributed.admin.large-graph-warning-threshold": "8 GB",  # networks are sent with all weights, once
}
_WORKER = {"threads_per_worker": 1, "memory_limit": 0}  # a task at a time; Dask does not see the memory of JAX

Result = TypeVar("Result")


class Cluster:
    """Workers that describe images and match queries, and write them to the folder of one cache.

    The folders of the cache and of the images are on all machines, under the same paths. Results are those of one
    process to the bit, if all machines compute alike: the same versions (checked), processors or GPUs, and options of
    JAX, which workers take from their environment. If a worker dies, another one does its block again. Your own
    extractors and matchers must be in a module that workers can import.
    """

    def __init__(self, client: Any) -> None:
        """Use the workers of a `distributed.Client`, for instance of one that dask-jobqueue or dask-kubernetes made."""
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
        """So many processes on this machine, each with its share of the processors, or PJRT_NPROC threads of XLA.

        In a script, this stands below `if __name__ == "__main__":`. `options` are those of `distributed.LocalCluster`.
        """
        distributed = _distributed()
        threads = os.environ.get("PJRT_NPROC") or str(max(1, available_cpus() // max(1, workers)))
        options = {"dashboard_address": ":0", "env": {"PJRT_NPROC": threads}} | options
        with _settings(), _ctrl_c_is_ours():
            started = distributed.LocalCluster(n_workers=workers, **_WORKER, **options)
        with started, cls.connect(started) as cluster:
            yield cluster

    @classmethod
    @contextmanager
    def slurm(cls, workers: int, options: str = "", log: Callable[[str], None] = print) -> Iterator["Cluster"]:
        """An array of Slurm jobs with a worker each, until the block ends.

        `options` are those of `sbatch`, such as `--partition=gpu --gpus=1`. `log` is called with a line while the first
        worker waits in the queue.
        """
        with cls.local(0, host="tcp://") as cluster:
            client = cluster._client
            worker = [sys.executable, "-m", "distributed.cli.dask_worker", client.scheduler.address, "--nthreads=1",
                      "--memory-limit=0", "--no-dashboard", "--death-timeout=60"]  # fmt: skip
            script = f"export PJRT_NPROC=${{PJRT_NPROC:-${{SLURM_CPUS_PER_TASK:-1}}}}; exec {shlex.join(worker)}"
            array = ["--parsable", "--requeue", "--job-name=mfvpr", f"--array=1-{workers}"]
            job = _slurm("sbatch", *array, *shlex.split(options), f"--wrap={script}").partition(";")[0].strip()
            try:
                log(f"cluster: waiting for the first of {workers} workers, job {job} of Slurm")
                client.wait_for_workers(1)
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
        """`function(*shared, block)` for blocks of `rows`, in the order in which workers finish.

        Args:
            function: of a module that workers can import.
            shared: arguments that are sent to each worker once.
            rows: to be split; all blocks but the last have a multiple of `multiple` rows.
            track: progress over the rows.

        Raises:
            InputError: of a block; or the workers or the scheduler are lost.
        """
        size = round_up(min(BLOCK, len(rows) // _BLOCKS), multiple)
        blocks = [rows[start : start + size] for start in range(0, len(rows), size)]
        with _settings(), _lost_as_input_error(self._client):
            # Not scattered: if its worker dies, the scheduler sends it again.
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
            yield from futures.pop(future)  # or the block would be done again if its worker dies later


def _same(value: Any) -> Any:
    return value


def _run(expected: dict[str, str], function: Callable[..., Any], shared: tuple[Any, ...], block: Sequence[int]) -> Any:
    """Run a block in a worker, unless its versions compute something else."""
    for name, version in expected.items():
        if (got := versions()[name]) != version:
            raise InputError(f"cluster: expected {name} {version} on all workers, got {got} on {socket.gethostname()}")
    return function(*shared, block)


@contextmanager
def _lost_as_input_error(client: Any) -> Iterator[None]:
    """Raise the loss of workers or of the scheduler as one line."""
    distributed = _distributed()
    again = "what was finished is kept; run again to go on"
    try:
        yield
    except distributed.KilledWorker as error:
        number, last = error.allowed_failures + 1, error.last_worker.address
        raise InputError(f"cluster: a block ended {number} workers, the last at {last}; do they have enough memory? "
                         f"{again}") from None  # fmt: skip
    except distributed.scheduler.NoWorkerError:
        raise InputError(f"cluster: all workers are gone; {again}") from None
    except (CancelledError, distributed.comm.CommClosedError) as error:
        raise InputError(f"cluster: the scheduler at {client.scheduler.address} is gone; {again}") from error


def _distributed() -> Any:
    try:
        import distributed
    except ImportError:
        raise InputError("cluster: expected Dask Distributed; install it with pip install 'mfvpr[cluster]'") from None
    return distributed


@contextmanager
def _ctrl_c_is_ours() -> Iterator[None]:
    """Processes of threads that start in the block never see Ctrl-C; this thread sees it when the block ends."""
    resource_tracker.ensure_running()  # whose start would undo this
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _settings() -> Any:
    """Settings of Dask, for a block."""
    import dask

    return dask.config.set(_SETTINGS)


def _slurm(*command: str) -> str:
    """Output of a command of Slurm."""
    try:
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout
    except FileNotFoundError:
        raise InputError(f"cluster: expected Slurm's command {command[0]}, which is not here") from None
    except subprocess.CalledProcessError as error:
        raise InputError(f"cluster: {command[0]} failed: {' '.join(error.stderr.split())}") from None
