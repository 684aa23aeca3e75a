"""The process: optional packages, standard error, memory, and the progress of long operations."""

from __future__ import annotations

import ctypes
import math
import mmap
import os
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError
from facerender.system.signals import if_ended

_LOCK = threading.Lock()


def optional(module: str, message: str) -> Any:
    """Import a module of a package that may be missing; raise InputError with the message then."""
    try:
        return import_module(module)
    except ImportError:
        raise InputError(message) from None


@contextmanager
def redirected_stderr(file: IO[Any]) -> Iterator[None]:
    """Redirect file descriptor 2 to an open file within the context; one thread at a time."""
    with _LOCK:
        try:
            original = os.dup(2)
        except OSError:  # standard error is closed
            yield
            return
        try:
            os.dup2(file.fileno(), 2)
            yield
        finally:
            os.dup2(original, 2)
            os.close(original)


def give_back() -> None:
    """Return freed memory to the system; glibc would keep it."""
    if sys.platform == "linux" and (trim := getattr(ctypes.CDLL(None), "malloc_trim", None)):
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


Progress = Callable[[str, float], object]


def no_progress(what: str, done: float) -> None:
    """Ignore progress; used if the caller gives no progress function."""


def shows_bars(quiet: bool) -> bool:
    """Return whether progress bars are shown: on a terminal, unless ``quiet``."""
    return not quiet and sys.stderr.isatty()


class Bar(ExitStack):
    """A tqdm bar on standard error that shows the current step and disappears at the end, or
    ``on_step``, which is called with the name of each step when it starts. If a signal ends the
    process, a line reports the progress, also without a terminal."""

    def __init__(self, quiet: bool = False, on_step: Callable[[str], object] | None = None) -> None:
        super().__init__()
        self._on_step = on_step
        self._shows = on_step is None and shows_bars(quiet)
        self._bar: Any = None
        self._steps: list[str] = []
        self._fraction = 0.0
        self.enter_context(if_ended(self._ended))
        self.callback(self._close)

    def __call__(self, step: str, fraction: float) -> None:
        if self._steps[-1:] != [step]:
            self._steps.append(step)
            self._close()
            if self._on_step:
                self._on_step(step)
            if self._shows:
                from tqdm import tqdm

                form = "{desc} {percentage:3.0f}%|{bar:24}| {elapsed}<{remaining}"
                self._bar = tqdm(desc=step, total=1.0, bar_format=form, leave=False)
        self._fraction = fraction
        if self._bar is not None:
            self._bar.update(fraction - self._bar.n)

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.close()

    def _ended(self) -> str:
        self._close()
        if not self._steps:
            return "before the first step"
        *done, step = self._steps
        return f"done: {', '.join([*done, f'{100.0 * self._fraction:.0f} % of {step}'])}"
