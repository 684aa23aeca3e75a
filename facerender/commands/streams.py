"""Functions that print results on standard output and messages on standard error, even if a stream
is closed, is full or cannot encode a character."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO

from facerender.errors import FacerenderError, reason


def make_usable() -> None:
    """Open closed standard streams, so that no other file gets their descriptors (0, 1 and 2), and
    escape characters that a stream cannot encode."""
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(number, True)
    os.close(number)
    sys.stdout = sys.stdout or open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
    sys.stderr = sys.stderr or open(2, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")


def print_result(*lines: object, end: str = "\n") -> None:
    """Print results.

    Raises
    ------
    FacerenderError : standard output cannot be written
    """
    with _reported():
        _print("\n".join(map(str, lines)) + end, sys.stdout)


def print_bytes(content: bytes) -> None:
    """Write bytes to standard output. For errors see :func:`print_result`."""
    with _reported():
        sys.stdout.buffer.write(content)
        sys.stdout.buffer.flush()


@contextmanager
def _reported() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        _mute(sys.stdout)
        raise FacerenderError(
            f"cannot write standard output: {reason(error)}; redirect it to another place"
        ) from None


def print_message(*lines: object) -> None:
    """Print messages on standard error, and ignore errors of this stream."""
    try:
        _print("\n".join(map(str, lines)) + "\n", sys.stderr)
    except OSError:
        _mute(sys.stderr)


def _print(text: str, stream: TextIO) -> None:
    bars: Any = sys.modules.get("tqdm")  # tqdm.write() prints without breaking progress bars
    if bars is None:
        stream.write(text)
    else:
        bars.tqdm.write(text, file=stream, end="")
    stream.flush()


def _mute(stream: TextIO) -> None:
    """Discard the buffer of a stream, so that the interpreter does not fail to flush it at exit."""
    with suppress(OSError), open(os.devnull, "wb") as nothing:
        os.dup2(nothing.fileno(), stream.fileno())
