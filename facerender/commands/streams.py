"""Standard output, which carries results, and standard error, which carries all else. Closed, full
or of few letters, neither costs more than a line."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from typing import Any, TextIO

from facerender.errors import FacerenderError, reason


def make_usable() -> None:
    """Open what is closed, so that no file gets its number, and have text escaped that a stream has
    no letters for."""
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
    FacerenderError : standard output takes no more
    """
    try:
        _print("\n".join(map(str, lines)) + end, sys.stdout)
    except OSError as error:
        _mute(sys.stdout)
        raise FacerenderError(
            f"cannot write standard output: {reason(error)}; send it elsewhere"
        ) from None


def print_bytes(content: bytes) -> None:
    """Write a result that is no text; raises as :func:`print_result`."""
    try:
        sys.stdout.buffer.write(content)
        sys.stdout.buffer.flush()
    except OSError as error:
        _mute(sys.stdout)
        raise FacerenderError(
            f"cannot write standard output: {reason(error)}; send it elsewhere"
        ) from None


def print_message(*lines: object) -> None:
    """Print what is no result on standard error, if it can be."""
    try:
        _print("\n".join(map(str, lines)) + "\n", sys.stderr)
    except OSError:
        _mute(sys.stderr)


def _print(text: str, stream: TextIO) -> None:
    bars: Any = sys.modules.get("tqdm")  # where they stand, text would run into them
    if bars is None:
        stream.write(text)
    else:
        bars.tqdm.write(text, file=stream, end="")
    stream.flush()


def _mute(stream: TextIO) -> None:
    """Have what is left of a stream's buffer go nowhere, or the interpreter would complain."""
    with suppress(OSError), open(os.devnull, "wb") as nothing:
        os.dup2(nothing.fileno(), stream.fileno())
