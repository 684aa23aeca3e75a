"""Redirect standard error of the whole process, including C libraries and child processes."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO, Any

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
