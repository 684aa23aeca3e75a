"""Standard error of the whole process: what C libraries and child processes write, too."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO, Any

_LOCK = threading.Lock()


@contextmanager
def redirected_stderr(file: IO[Any]) -> Iterator[None]:
    """Write file descriptor 2 to an open file meanwhile, one thread after another."""
    with _LOCK:
        try:
            original = os.dup(2)
        except OSError:  # closed
            yield
            return
        try:
            os.dup2(file.fileno(), 2)
            yield
        finally:
            os.dup2(original, 2)
            os.close(original)
