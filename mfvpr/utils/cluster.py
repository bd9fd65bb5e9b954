"""Work on many processes or machines, by Dask Distributed (extra `cluster`)."""

import os
import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager
from functools import lru_cache
from importlib import import_module
from multiprocessing import resource_tracker
from typing import Any, TypeVar

from mfvpr.utils.errors import InputError
from mfvpr.utils.fingerprints import versions
from mfvpr.utils.numerics import available_cpus, round_up

BLOCK = 32  # rows of a task at most, which a killed worker loses
_BLOCKS = 16  # tasks at least, if there are so many rows
_LOGGING = {"distributed": "warning", "distributed.client": "critical", "distributed.scheduler": "critical"}
_SETTINGS = {  # defaults of Dask
    "scheduler": {"no-workers-timeout": "30 minutes"},  # then a call ends with an error
    "nanny": {"pre-spawn-environ": {"DASK_LOGGING__DISTRIBUTED": "critical"}},  # the client raises errors of blocks
    "admin": {"large-graph-warning-threshold": "8 GB"},  # extractors include the weights of their networks
}

Result = TypeVar("Result")


class Cluster:
    """Workers that describe images and match queries in blocks; this process writes the results to a cache.

        with Cluster.local(4) as cluster:
            mfvpr.evaluate(dataset, system, cache=FeatureCache("features"), runtime=Runtime(cluster=cluster))

    All machines need the folders of the cache and of the images under the same paths, and the same versions, which
    every block checks. If a worker dies, another worker repeats its block. Results are those of one process to the bit
    if all machines have the same processors or GPUs, number of XLA threads, and options of JAX, which workers read from
    their environment. Put extractors and matchers of your own into a module that workers can import.

    A scheduler runs the code that it gets. `local` and `slurm` encrypt its connections, by a key pair that only this
    process and its workers have. Other users of the machine can read the dashboard, which listens on 127.0.0.1.
    """

    def __init__(self, client: Any) -> None:
        """Use the workers of `client`, a `distributed.Client`, whatever started them; they need one thread each."""
        self._client, self._dashboard = client, client.dashboard_link

    def __str__(self) -> str:
        address = self._client.scheduler.address
        return f"{len(self._client.nthreads())} workers at {address}, dashboard {self._dashboard}"

    @classmethod
    @contextmanager
    def connect(cls, address: str) -> Iterator["Cluster"]:
        """The workers of the scheduler at `tcp://HOST:PORT`, or `tls://HOST:PORT` with the key of Dask's configuration.

        An `InputError` if no scheduler answers there.
        """
        try:
            client = _distributed().Client(address, set_as_default=False)
        except (OSError, TypeError):  # the latter for tls:// without a key
            hint = "check the address and, for tls://, distributed.comm.tls of Dask's configuration"
            raise InputError(f"cluster: expected a scheduler at {address}, got no answer; {hint}") from None
        with client:
            yield cls(client)

    @classmethod
    @contextmanager
    def local(cls, workers: int, **options: Any) -> Iterator["Cluster"]:
        """Start worker processes on this machine, until the block ends; `options` are those of `LocalCluster` of Dask.

        Each has an equal share of the processors, or as many threads of XLA as the variable PJRT_NPROC says. Scripts
        need `if __name__ == "__main__":` before it. An `InputError` if a worker does not start.
        """
        threads = os.environ.get("PJRT_NPROC") or str(max(1, available_cpus() // max(1, workers)))
        options = {"dashboard_address": "127.0.0.1:0", "security": True, "env": {"PJRT_NPROC": threads}} | options
        resource_tracker.ensure_running()  # its start would unblock the signal
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # workers end with this process
        try:  # Dask does not count JAX's memory
            started = _distributed().LocalCluster(n_workers=workers, threads_per_worker=1, memory_limit=0, **options)
        except RuntimeError as error:
            line = " ".join(str(error.__cause__ or error).split())
            hint = "in a script, put `if __name__ == '__main__':` before the cluster"
            raise InputError(f"cluster: a worker process did not start: {line}; {hint}") from None
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        with started, cls.connect(started) as cluster:
            yield cluster

    @classmethod
    @contextmanager
    def slurm(cls, workers: int, options: str = "") -> Iterator["Cluster"]:
        """Start Slurm jobs of one worker each until the block ends; `options` of `sbatch`, such as `--gpus=1`."""
        with cls.local(0, host="tls://") as cluster:
            cluster._dashboard = re.sub(r"//.*:", "//127.0.0.1:", cluster._dashboard)
            worker = [sys.executable, "-m", "distributed.cli.dask_worker", cluster._client.scheduler.address]
            worker += ["--nthreads=1", "--memory-limit=0", "--death-timeout=60"]
            worker += ["--no-dashboard", "--dashboard-address=127.0.0.1:0"]
            script = f"export PJRT_NPROC=${{PJRT_NPROC:-${{SLURM_CPUS_PER_TASK:-1}}}}; exec {shlex.join(worker)}"
            array = ["--parsable", "--requeue", "--job-name=mfvpr", f"--array=1-{workers}"]
            security, name = cluster._client.security, "DASK_DISTRIBUTED__COMM__TLS__"
            keys = {
                f"{name}CA_FILE": security.tls_ca_file,
                f"{name}WORKER__KEY": security.tls_worker_key,
                f"{name}WORKER__CERT": security.tls_worker_cert,
            }
            command = ["sbatch", *array, *shlex.split(options), f"--wrap={script}"]
            job = _run_slurm(*command, **keys).partition(";")[0].strip()
            try:
                yield cluster
            finally:
                _run_slurm("scancel", job)

    def map(
        self, function: Callable[..., Iterator[Result]], shared: tuple[Any, ...], rows: Sequence[int], multiple: int
    ) -> Iterator[Result]:
        """Results of `Runtime.map` from workers, in the order in which blocks finish; an InputError if workers die."""
        size = round_up(min(BLOCK, len(rows) // _BLOCKS), multiple)
        blocks = [rows[start : start + size] for start in range(0, len(rows), size)]
        client, distributed, futures = self._client, _distributed(), set[Any]()
        again = "finished blocks are in the cache; run again to go on"
        try:
            client.wait_for_workers(1)
            packed = distributed.protocol.pickle.dumps(shared)  # once: networks in use cannot pass between workers
            value = client.submit(bytes, packed, pure=False)  # Dask repeats a task if its worker dies; not `scatter`
            futures |= {client.submit(_run, versions(), function, value, block, pure=False) for block in blocks}
            for future in distributed.as_completed(list(futures), loop=client.loop):
                results = future.result()
                futures.remove(future)  # Dask would repeat the block if its worker died while the future exists
                yield from results
        except distributed.KilledWorker as error:
            number = error.allowed_failures + 1
            raise InputError(f"cluster: {number} workers died in one block; give them more memory; {again}") from None
        except (distributed.scheduler.NoWorkerError, CancelledError, distributed.comm.CommClosedError):
            gone = f"no worker is left, or the scheduler at {client.scheduler.address} is gone"
            raise InputError(f"cluster: {gone}; {again}") from None
        finally:
            for future in futures:
                future.release()


def _run(expected: dict[str, str], function: Callable[..., Any], packed: bytes, block: Sequence[int]) -> list[Any]:
    if (installed := versions()) != expected:
        raise InputError(f"cluster: expected workers with {expected}, got {installed}; install the same versions")
    return list(function(*_unpack(packed), block))


@lru_cache(maxsize=1)  # so that all blocks share compiled programs
def _unpack(packed: bytes) -> tuple[Any, ...]:
    return _distributed().protocol.pickle.loads(packed)


def _distributed() -> Any:
    try:
        from dask import config

        config.update_defaults({"logging": _LOGGING})  # read by the next import
        import_module("cryptography")  # of temporary keys
        import distributed
    except ImportError:
        message = "cluster: Dask Distributed or cryptography is not installed; pip install 'mfvpr[cluster]'"
        raise InputError(message) from None
    config.update_defaults({"distributed": _SETTINGS})
    return distributed


def _run_slurm(*command: str, **variables: str) -> str:
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | variables)
    if done.returncode:
        raise InputError(f"cluster: {shlex.join(command[:2])}: {' '.join(done.stderr.split())}; check cluster.options")
    return done.stdout
