"""Memory of the process: what it has, may still take, and gives back to the system."""

from __future__ import annotations

import ctypes
import math
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path


def give_back() -> None:
    """Give what is free to the system, where glibc would keep it."""
    if trim := _malloc_trim():
        trim(0)


@cache
def _malloc_trim() -> Callable[[int], object] | None:
    """What glibc alone has."""
    return getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None


MIB = 1 << 20


def limit(mebibytes: float | None) -> float:
    """Return the MiB that this process may have: the argument, or what it has and can still get."""
    return available() + resident() if mebibytes is None else mebibytes


def available() -> float:
    """Return the MiB that this process may still take, of the machine and of its control group;
    infinite where neither says."""
    free = math.inf
    with suppress(OSError, ValueError, StopIteration):
        lines = Path("/proc/meminfo").read_text().splitlines()
        free = next(float(line.split()[1]) for line in lines if line.startswith("MemAvailable"))
    with suppress(OSError, ValueError):  # no such limit
        most = float(Path("/sys/fs/cgroup/memory.max").read_text())
        used = float(Path("/sys/fs/cgroup/memory.current").read_text())
        free = min(free, (most - used) / 1024.0)
    return free / 1024.0


def resident() -> float:
    """Return the MiB that this process has; 0 where the system does not say."""
    with suppress(OSError, ValueError, IndexError):
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / float(MIB)
    return 0.0
