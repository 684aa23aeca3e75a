"""Output storage of a batch: a local folder, or a URL that fsspec supports (s3://...).

Files are written atomically: each file is either complete or missing.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Any
from uuid import uuid4

from facerender.errors import InputError

_UNFINISHED = ".unfinished"


class Storage:
    """Files below a root, addressed by relative paths with slashes.

    Parameters
    ----------
    root : path of a folder, or a URL that fsspec supports

    Raises
    ------
    InputError : the protocol of the URL is unknown, or the Python package for it is missing
    """

    def __init__(self, root: str) -> None:
        self.root, self.remote = root.rstrip("/"), "://" in root
        if self.remote:
            self._system, self._path = _remote(self.root)

    def put(self, name: str, content: bytes) -> None:
        """Write a file atomically; raise OSError on failure."""
        if self.remote:
            self._system.pipe_file(f"{self._path}/{name}", content)
            return
        temporary = self.unfinished()
        temporary.write_bytes(content)
        self.move(temporary, name)

    def move(self, source: Path, name: str) -> None:
        """Move a local file, usually from :meth:`unfinished`, to a name in this storage."""
        if self.remote:
            self._system.put_file(str(source), f"{self._path}/{name}")
            source.unlink()
            return
        target = Path(self.root, name)
        try:
            os.replace(source, target)
        except FileNotFoundError:
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(source, target)

    def has(self, name: str) -> bool:
        """Return whether a file exists."""
        if self.remote:
            return bool(self._system.exists(f"{self._path}/{name}"))
        return os.path.exists(Path(self.root, name))

    def rename(self, name: str, other: str) -> None:
        """Rename a file."""
        if self.remote:
            self._system.mv(f"{self._path}/{name}", f"{self._path}/{other}")
        else:
            self.move(Path(self.root, name), other)

    def unfinished(self) -> Path:
        """Return a unique local path for a temporary file, and create the folder of the path."""
        folder = Path(tempfile.gettempdir() if self.remote else self.root, _UNFINISHED)
        folder.mkdir(parents=True, exist_ok=True)
        return folder / uuid4().hex

    def get(self, name: str, most: int | None = None) -> bytes:
        """Return a file's content, or its first `most` bytes; raise FileNotFoundError if absent."""
        if self.remote:
            return bytes(self._system.cat_file(f"{self._path}/{name}", end=most))
        with open(f"{self.root}/{name}", "rb") as file:
            return file.read(-1 if most is None else most)

    def names(self, folder: str) -> list[str]:
        """Return the names of the files in a folder; empty if the folder does not exist."""
        try:
            if self.remote:
                found = self._system.ls(f"{self._path}/{folder}", detail=False)
                return [each.rpartition("/")[2] for each in found]
            return os.listdir(Path(self.root, folder))
        except FileNotFoundError:
            return []

    def drop(self, name: str) -> None:
        """Remove a file if it exists."""
        if not self.remote:
            Path(self.root, name).unlink(missing_ok=True)
        elif self._system.exists(f"{self._path}/{name}"):
            self._system.rm_file(f"{self._path}/{name}")

    def prune(self, name: str) -> None:
        """Remove the folder of a file if the folder is empty. Call only while no worker writes."""
        with suppress(OSError):
            if not self.remote:
                Path(self.root, name).parent.rmdir()

    def sweep(self) -> None:
        """Remove temporary files of interrupted writers. Call this only while no worker writes."""
        if not self.remote:
            shutil.rmtree(Path(self.root, _UNFINISHED), ignore_errors=True)


def _remote(root: str) -> tuple[Any, str]:
    try:
        import fsspec
    except ImportError:
        raise InputError(f"{root} needs fsspec: pip install 'facerender[batch]'") from None
    try:
        # A cached listing would miss files that other processes have written since.
        system, path = fsspec.core.url_to_fs(root, use_listings_cache=False)
    except (ValueError, ImportError) as error:
        raise InputError(f"{root} cannot be reached ({error}); give a folder or a URL") from None
    return system, str(path)
