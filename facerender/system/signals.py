"""How the command ends when a signal tells it to: children first, then what is half done is undone,
and nothing of Python goes on. A program that imports the package keeps its own signals."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType

_WORDS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}
_PATIENCE = 2.0  # seconds that children have to end
_ending = False
_actions: list[Callable[[], str | None]] = []


def heed_signals() -> None:
    """Have SIGINT, SIGTERM and a reader of the output that has gone end the process, with status
    130, 143 and 141. An exception would not: trimesh catches and forgets a KeyboardInterrupt."""
    for name in ("SIGINT", "SIGTERM", "SIGPIPE"):
        if hasattr(signal, name):  # not all of them on Windows
            signal.signal(getattr(signal, name), _end)


def heed_the_coordinator() -> None:
    """Have SIGTERM end the process as it does by default, once what is half done is undone. SIGINT
    is for the driver, which passes it on as SIGTERM."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _end_unsaid)


def hold() -> None:
    """Keep a thread from what it is about to begin, once the process is being ended."""
    if _ending:
        from threading import Event

        Event().wait()


@contextmanager
def if_ended(action: Callable[[], str | None]) -> Iterator[None]:
    """Call action if a signal ends the process meanwhile; what it returns is said."""
    hold()
    _actions.append(action)
    try:
        yield
    finally:
        _actions.remove(action)


@contextmanager
def temporary_folder() -> Iterator[str]:
    """A folder of its own, which is removed at the end."""
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
    said = _undo()
    if number in _WORDS:
        with suppress(Exception):  # whatever the main thread was about to do with it
            sys.stdout.flush()
        line = ": ".join(filter(None, [_WORDS[signal.Signals(number)], *said]))
        with suppress(OSError):
            os.write(2, f"facerender: {line}\n".encode(errors="backslashreplace"))
    os._exit(128 + number)


def _end_unsaid(number: int, frame: FrameType | None) -> None:
    _undo()
    signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)


def _undo() -> list[str | None]:
    """End the children, then undo what is half done; return what is said of it."""
    global _ending
    _ending = True
    with suppress(Exception):
        _end_children()
    said = []
    for action in reversed(_actions):
        with suppress(Exception):
            said.append(action())
    return said


def _end_children() -> None:
    """End the processes below this one, as far as /proc knows them, and wait for them."""
    parents = {}
    for name in filter(str.isdecimal, os.listdir("/proc")):
        with suppress(OSError), open(f"/proc/{name}/stat", "rb") as file:
            # Behind the name, which may hold anything: state, parent.
            parents[int(name)] = int(file.read().rpartition(b")")[2].split()[1])
    below = {os.getpid()}
    while more := {child for child, parent in parents.items() if parent in below} - below:
        below |= more
    own = [child for child in below if parents.get(child) == os.getpid()]
    for child in below - {os.getpid()}:
        with suppress(OSError):
            os.kill(child, signal.SIGTERM)
    until = time.monotonic() + _PATIENCE
    while own and time.monotonic() < until:
        own = [child for child in own if _runs(child)]
        time.sleep(0.01)


def _runs(child: int) -> bool:
    try:
        return os.waitpid(child, os.WNOHANG) == (0, 0)
    except ChildProcessError:  # somebody else has waited for it
        return False
