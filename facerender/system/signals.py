"""End the command on signals: end child processes, remove unfinished output, and exit without
running more Python code. A program that imports the package keeps its own signal handlers.

The entry point imports this module before all others, so it imports little."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType

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
def if_ended(action: Callable[[], str | None], always: bool = False) -> Iterator[None]:
    """Call ``action`` if a signal ends the process within the context, or ``always`` at its end.
    The final message includes the text that ``action`` returns."""
    hold()
    _actions.append(action)
    try:
        yield
    finally:
        if always:
            action()
        _actions.remove(action)


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
