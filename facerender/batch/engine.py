"""What carries chunks to supervisors: the threads of this process, or a Dask cluster."""

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

_WORKER_MIB = 700  # that a worker needs at least
_SECONDS = 30  # to find a scheduler, and a worker of it


@dataclass(frozen=True)
class Engine:
    """What runs chunks.

    Attributes
    ----------
    executor : to which they are submitted
    slots : how many it runs at once
    workers : how many of them in threads of this process; 0 where elsewhere
    """

    executor: Executor
    slots: Callable[[], int]
    workers: int


@contextmanager
def local(workers: int) -> Iterator[Engine]:
    """Threads of this process, each with a worker of its own."""
    executor = ThreadPoolExecutor(workers)
    try:
        yield Engine(executor, lambda: workers, workers)
    finally:
        executor.shutdown(cancel_futures=True)


@contextmanager
def dask(address: str) -> Iterator[Engine]:
    """The workers of a Dask scheduler, however many come and go.

    Raises
    ------
    InputError : no scheduler there, no worker, or dask.distributed is missing
    """
    try:
        from distributed import Client
    except ImportError:
        raise InputError(
            f"--scheduler {address} needs dask.distributed: pip install 'facerender[batch]'"
        ) from None
    for name in [*logging.getLogger().manager.loggerDict]:  # what they say is said here
        if name.startswith("distributed"):
            logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        client = Client(address, timeout=_SECONDS)
    except (OSError, ValueError) as error:
        raise InputError(f"no scheduler at {address} ({error}); start: dask scheduler") from None

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
                f"the scheduler at {address} has no worker; start: dask worker {address}"
            ) from None
        # Impure: a chunk that Dask remembers as done may have been deleted.
        executor = client.get_executor(pure=False, retries=2)
        yield Engine(executor, slots, 0)
    finally:
        client.close()


def scheduler_gone() -> FacerenderError:
    """What is raised when it ends before the batch."""
    return FacerenderError("the scheduler is gone; start it, and run the same command again")


def default_workers() -> tuple[int, str]:
    """Return how many workers this machine is for, and why: one for each core that this process may
    use, and each with the memory that it needs."""
    cores, memory = _cores(), available()
    fit = max(1, int(memory // _WORKER_MIB))
    if fit < cores:
        return fit, f"{memory:.0f} MiB of free memory, {_WORKER_MIB} for each"
    return cores, f"one for each of {cores} cores"


def _cores() -> int:
    """Cores that this process may use, by affinity and by the quota of its control group."""
    cores = float(len(os.sched_getaffinity(0)))
    try:
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text().split()
        cores = min(cores, float(quota) / float(period))
    except (OSError, ValueError):  # no quota
        pass
    return max(1, round(cores))
