"""The cache of meshes, which a thread writes."""

from __future__ import annotations

import threading


def wait_for_cache() -> None:
    """Wait until all loaded meshes are written to the cache."""
    for thread in threading.enumerate():
        if thread.name == "facerender-cache":
            thread.join()
