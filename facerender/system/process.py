"""The process: signals, standard error, memory, and the progress of long operations.

On a signal the command ends its child processes, removes unfinished output and exits without
running more Python code. A program that imports the package keeps its own signal handlers."""

from __future__ import annotations

import ctypes
import math
import mmap
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from pathlib import Path
from types import FrameType
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

_WORDS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}
_PATIENCE = 2.0  # maximum seconds to wait for children to end
_ending = False
_actions: list[Callable[[], str | None]] = []


def heed_signals() -> None:
    """Let SIGINT, SIGTERM and SIGPIPE end the process, with the status 130, 143 or 141.
    A KeyboardInterrupt might not end the process, because trimesh discards this exception."""
    for name in ("SIGINT", "SIGTERM", "SIGPIPE"):
        if hasattr(signal, name):  # Windows lacks some of these signals
            signal.signal(getattr(signal, name), _end)


def heed_the_coordinator() -> None:
    """Let SIGTERM end the process as by default, after unfinished output is removed. Ignore SIGINT:
    the coordinator of the batch also receives SIGINT, and then sends SIGTERM to this process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _end_silently)


def hold() -> None:
    """If the process is ending, block the calling thread forever before it starts new work."""
    if _ending:
        from threading import Event

        Event().wait()


@contextmanager
def if_ended(action: Callable[[], str | None]) -> Iterator[None]:
    """Call ``action`` if a signal ends the process within the context. The final message includes
    the text that ``action`` returns."""
    hold()
    _actions.append(action)
    try:
        yield
    finally:
        _actions.remove(action)


@contextmanager
def temporary_folder() -> Iterator[str]:
    """Create a private temporary folder, and remove it at the end of the context."""
    import shutil
    import tempfile

    folder = os.path.join(tempfile.gettempdir(), f"facerender-{os.urandom(8).hex()}")

    def remove() -> None:
        shutil.rmtree(folder, ignore_errors=True)

    with if_ended(remove):
        try:
            os.mkdir(folder, 0o700)
            yield folder
        finally:
            remove()


def _end(number: int, frame: FrameType | None) -> None:
    reports = _undo()
    if number in _WORDS:
        with suppress(Exception):  # the main thread may be writing to standard output
            sys.stdout.flush()
        line = ": ".join(filter(None, [_WORDS[signal.Signals(number)], *reports]))
        with suppress(OSError):
            os.write(2, f"facerender: {line}\n".encode(errors="backslashreplace"))
    os._exit(128 + number)


def _end_silently(number: int, frame: FrameType | None) -> None:
    _undo()
    signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)


def _undo() -> list[str | None]:
    """End the children, then call the registered actions; return the texts of the actions."""
    global _ending
    _ending = True
    with suppress(Exception):
        _end_children()
    reports = []
    for action in reversed(_actions):
        with suppress(Exception):
            reports.append(action())
    return reports


def _end_children() -> None:
    """Send SIGTERM to all descendants listed in /proc, and wait for the direct children."""
    parents = {}
    for name in filter(str.isdecimal, os.listdir("/proc")):
        with suppress(OSError), open(f"/proc/{name}/stat", "rb") as file:
            # The parent follows the last parenthesis: a process name may contain any character.
            parents[int(name)] = int(file.read().rpartition(b")")[2].split()[1])
    below = {os.getpid()}
    while generation := {child for child, parent in parents.items() if parent in below} - below:
        below |= generation
    children = [child for child in below if parents.get(child) == os.getpid()]
    for child in below - {os.getpid()}:
        with suppress(OSError):
            os.kill(child, signal.SIGTERM)
    until = time.monotonic() + _PATIENCE
    while children and time.monotonic() < until:
        children = [child for child in children if _runs(child)]
        time.sleep(0.01)


def _runs(child: int) -> bool:
    try:
        return os.waitpid(child, os.WNOHANG) == (0, 0)
    except ChildProcessError:  # other code has waited for the child
        return False


_LOCK = threading.Lock()


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


Progress = Callable[[str, float], object]


def no_progress(what: str, done: float) -> None:
    """Ignore progress; used if the caller gives no progress function."""


def shows_bars(quiet: bool) -> bool:
    """Return whether progress bars are shown: on a terminal, unless ``quiet``."""
    return not quiet and sys.stderr.isatty()


class Bar(ExitStack):
    """A tqdm bar on standard error that shows the current step and disappears at the end. If a
    signal ends the process, a line reports the progress, also without a terminal.

    quiet : whether to hide the bar
    on_step : function called with the name of each step when it starts; replaces the bar
    """

    def __init__(self, quiet: bool = False, on_step: Callable[[str], object] | None = None) -> None:
        super().__init__()
        self._on_step = on_step
        self._shown = on_step is None and shows_bars(quiet)
        self._bar: Any = None
        self._steps: list[str] = []
        self._fraction = 0.0
        self.enter_context(if_ended(self._ended))
        self.callback(self._close)

    def __call__(self, step: str, fraction: float) -> None:
        if self._steps[-1:] != [step]:
            self._begin(step)
        self._fraction = fraction
        if self._bar is not None:
            self._bar.update(fraction - self._bar.n)

    def _begin(self, step: str) -> None:
        self._steps.append(step)
        self._close()
        if self._on_step:
            self._on_step(step)
        if self._shown:
            from tqdm import tqdm

            form = "{desc} {percentage:3.0f}%|{bar:24}| {elapsed}<{remaining}"
            self._bar = tqdm(desc=step, total=1.0, bar_format=form, leave=False)

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.close()

    def _ended(self) -> str:
        self._close()
        if not self._steps:
            return "before the first step"
        *done, step = self._steps
        return f"done: {', '.join([*done, f'{100.0 * self._fraction:.0f} % of {step}'])}"
