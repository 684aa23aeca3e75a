"""Engines, which run the supervisors of chunks: threads of this process, or a Dask cluster."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from facerender.errors import FacerenderError, InputError
from facerender.system.memory import available

_WORKER_MIB = 700  # least memory per worker
_SECONDS = 30  # timeout of the connection to a scheduler, and of the wait for its first worker


@dataclass(frozen=True)
class Engine:
    """An executor of chunks."""

    executor: Executor
    slots: Callable[[], int]  # Returns the number of chunks that can be drawn at the same time.
    workers: int  # Number of supervisor threads in this process; 0 on a cluster.


@contextmanager
def local(workers: int) -> Iterator[Engine]:
    """Yield an engine of `workers` threads in this process, each with its own worker process."""
    executor = ThreadPoolExecutor(workers)
    try:
        yield Engine(executor, lambda: workers, workers)
    finally:
        executor.shutdown(cancel_futures=True)


@contextmanager
def dask(address: str) -> Iterator[Engine]:
    """Yield an engine on a Dask scheduler, whose workers may join and leave. Raise InputError if
    there is no scheduler or no worker, or dask.distributed is missing."""
    try:
        from distributed import Client
    except ImportError:
        raise InputError(
            f"--scheduler {address} needs dask.distributed: pip install 'facerender[batch]'"
        ) from None
    for name in [*logging.getLogger().manager.loggerDict]:  # this module reports Dask's errors
        if name.startswith("distributed"):
            logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        client = Client(address, timeout=_SECONDS)
    except (OSError, ValueError) as error:
        raise InputError(f"no scheduler at {address} ({error}); run: dask scheduler") from None

    def slots() -> int:
        try:
            return max(1, sum(map(int, client.nthreads().values())))
        except OSError:
            raise scheduler_gone() from None

    try:
        try:
            client.wait_for_workers(1, timeout=_SECONDS)
        except TimeoutError:
            raise InputError(
                f"the scheduler at {address} has no worker; run: dask worker {address}"
            ) from None
        # With pure=True, Dask would reuse the result of a chunk whose files have been deleted.
        executor = client.get_executor(pure=False, retries=2)
        yield Engine(executor, slots, 0)
    finally:
        client.close()


def scheduler_gone() -> FacerenderError:
    """Return the error for a scheduler that ended before the batch."""
    return FacerenderError("the scheduler has ended: restart it, and run the same command again")


def default_workers() -> tuple[int, str]:
    """Return the default number of workers, and a text that gives the reason.

    The default is one worker per core that this process may use, or fewer if memory is too small.
    """
    cores, memory = _cores(), available()
    fit = max(1, int(memory // _WORKER_MIB))
    if fit < cores:
        return fit, f"{memory:.0f} MiB of free memory, {_WORKER_MIB} MiB per worker"
    return cores, f"one per core ({cores} cores)"


def _cores() -> int:
    """Return the number of cores that CPU affinity and the cgroup quota allow this process."""
    cores = float(len(os.sched_getaffinity(0)))
    try:
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text().split()
        cores = min(cores, float(quota) / float(period))
    except (OSError, ValueError):  # no quota
        pass
    return max(1, round(cores))
