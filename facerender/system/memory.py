"""Used and available memory of this process, and the release of free memory to the system."""

from __future__ import annotations

import ctypes
import math
import mmap
import os
import sys
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


def give_back() -> None:
    """Return freed memory to the system; glibc would keep it."""
    if trim := _malloc_trim():
        trim(0)


def unload(arrays: Iterable[NDArray[Any]]) -> None:
    """Release the memory of arrays that lie in mapped files. The system reads a file again on
    demand. Other arrays do not change."""
    for array in arrays:
        owner: Any = array
        while isinstance(owner, np.ndarray):
            owner = owner.base
        file = getattr(owner, "obj", None)
        if isinstance(file, mmap.mmap) and hasattr(mmap, "MADV_DONTNEED"):
            offset = array.ctypes.data - np.frombuffer(file, dtype=np.uint8).ctypes.data
            start = -(-offset // mmap.PAGESIZE) * mmap.PAGESIZE
            size = (offset + array.nbytes) // mmap.PAGESIZE * mmap.PAGESIZE - start
            if size > 0:
                file.madvise(mmap.MADV_DONTNEED, start, size)


@cache
def _malloc_trim() -> Callable[[int], object] | None:
    """Return glibc's ``malloc_trim``; None with another C library."""
    return getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None


MIB = 1 << 20


def limit(mebibytes: float | None) -> float:
    """Return the memory limit in MiB: the argument or, if None, resident plus available memory."""
    return available() + resident() if mebibytes is None else mebibytes


def available() -> float:
    """Return the MiB that this process can still allocate, limited by the machine and by the
    process's control group; infinite if both limits are unknown."""
    free = math.inf
    with suppress(OSError, ValueError, StopIteration):
        lines = Path("/proc/meminfo").read_text().splitlines()
        free = next(float(line.split()[1]) for line in lines if line.startswith("MemAvailable"))
    with suppress(OSError, ValueError):  # the control group has no limit
        maximum = float(Path("/sys/fs/cgroup/memory.max").read_text())
        used = float(Path("/sys/fs/cgroup/memory.current").read_text())
        free = min(free, (maximum - used) / 1024.0)
    return free / 1024.0


def resident() -> float:
    """Return the resident memory of this process in MiB; 0 if it is unknown."""
    with suppress(OSError, ValueError, IndexError):
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / float(MIB)
    return 0.0
