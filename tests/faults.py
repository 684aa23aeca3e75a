"""Makes one file operation fail, as on a full, broken or read-only disk."""

from __future__ import annotations

import io
import os
from collections.abc import Callable
from errno import ENOSPC
from itertools import count
from typing import IO, Any


class _Full(io.FileIO):
    def write(self, data: Any) -> int:
        raise OSError(ENOSPC, os.strerror(ENOSPC))


def _full(path: Any, mode: str) -> IO[Any]:
    """Open a file as on a full disk: it can be created, but not written."""
    file = _Full(path, mode.replace("b", ""))
    buffered = io.BufferedRandom(file) if "+" in mode else io.BufferedWriter(file)
    return buffered if "b" in mode else io.TextIOWrapper(buffered)


def failing(place: str, turn: int, number: int) -> dict[tuple[Any, str], Callable[..., Any]]:
    """Return functions to put in the place of os.replace, os.mkdir, os.unlink and io.open, keyed by
    module and name. The turn-th call that changes a path below ``place`` fails with an error
    number, and so do all later calls, except that files can be removed from a full disk."""
    calls = count()

    def wrapped(module: Any, name: str) -> Callable[..., Any]:
        real = getattr(module, name)

        def call(path: Any, *more: Any, **named: Any) -> Any:
            mode = more[0] if more else named.get("mode", "r")
            changes = name != "open" or not {*"wax+"}.isdisjoint(mode)
            if name == "unlink" and number == ENOSPC:
                changes = False
            if changes and str(path).startswith(place) and next(calls) >= turn:
                if name == "open" and number == ENOSPC:
                    return _full(path, mode)
                raise OSError(number, os.strerror(number))
            return real(path, *more, **named)

        return call

    names = ((os, "replace"), (os, "mkdir"), (os, "unlink"), (io, "open"))
    return {(module, name): wrapped(module, name) for module, name in names}
