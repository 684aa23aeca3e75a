"""Output storage of a batch: a local folder, or a URL that fsspec supports (s3://...).

Files are written atomically: each file is either complete or missing.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from uuid import uuid4

from facerender.errors import InputError
from facerender.system.atomic import TEMPORARY, reported

_UNFINISHED = ".unfinished"
_AGAIN = "and run the same command again"


class Storage:
    """Files below a root, addressed by relative paths with slashes.

    Parameters
    ----------
    root : path of a folder, or a URL that fsspec supports

    Raises
    ------
    InputError : the protocol of the URL is unknown, or the Python package for it is missing. All
        methods raise CannotUse if a file cannot be written or read
    """

    def __init__(self, root: str) -> None:
        root = root.rstrip("/")
        self.root, self.remote = root, "://" in root
        if not self.remote:
            return
        try:
            import fsspec
        except ImportError:
            raise InputError(f"{root} needs fsspec: pip install 'facerender[batch]'") from None
        try:
            # A cached listing would miss files that other processes have written since.
            self._system, path = fsspec.core.url_to_fs(root, use_listings_cache=False)
        except (ValueError, ImportError) as error:
            raise InputError(
                f"{root} cannot be reached ({error}); give a folder or a URL"
            ) from None
        self._path = str(path)

    def put(self, name: str, content: bytes) -> None:
        """Write a file atomically."""
        if self.remote:
            with self._writing(name):
                self._system.pipe_file(f"{self._path}/{name}", content)
            return
        with self.temporary() as file:
            with self.scratch():
                file.write_bytes(content)
            self.move(file, name)

    def move(self, source: Path, name: str) -> None:
        """Move a local file, usually from :meth:`temporary`, to a name in this storage."""
        with self._writing(name):
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
            with self._reading(name):
                return bool(self._system.exists(f"{self._path}/{name}"))
        return os.path.exists(Path(self.root, name))

    def rename(self, name: str, other: str) -> None:
        """Rename a file."""
        if self.remote:
            with self._writing(other):
                self._system.mv(f"{self._path}/{name}", f"{self._path}/{other}")
        else:
            self.move(Path(self.root, name), other)

    @contextmanager
    def temporary(self) -> Iterator[Path]:
        """Yield a unique local path, whose folder exists. Remove the file at the end of the context
        unless it has been moved."""
        if self.remote:  # Users of a machine share this folder, so it gets no folder of one user.
            file = Path(temporary_folder(), f"{TEMPORARY}{uuid4().hex}")
        else:
            file = Path(self.root, _UNFINISHED, uuid4().hex)
            with self.scratch():
                file.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield file
        finally:
            with suppress(OSError):
                file.unlink()

    def scratch(self) -> AbstractContextManager[None]:
        """Return a context in which an OSError of a temporary file raises CannotUse."""
        return reported("write", temporary_folder() if self.remote else self.root, _AGAIN)

    def get(self, name: str, most: int | None = None) -> bytes:
        """Return a file's content, or its first `most` bytes; raise FileNotFoundError if absent."""
        with self._reading(name):
            if self.remote:
                return bytes(self._system.cat_file(f"{self._path}/{name}", end=most))
            with open(f"{self.root}/{name}", "rb") as file:
                return file.read(-1 if most is None else most)

    def names(self, folder: str) -> list[str]:
        """Return the names of the files in a folder; empty if the folder does not exist."""
        try:
            with self._reading(folder):
                if self.remote:
                    paths = self._system.ls(f"{self._path}/{folder}", detail=False)
                    return [path.rpartition("/")[2] for path in paths]
                return os.listdir(Path(self.root, folder))
        except FileNotFoundError:
            return []

    def drop(self, name: str) -> None:
        """Remove a file if it exists."""
        with self._writing(name):
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

    def _writing(self, name: str) -> AbstractContextManager[None]:
        return reported("write", f"{self.root}/{name}", _AGAIN)

    @contextmanager
    def _reading(self, name: str) -> Iterator[None]:
        try:
            yield
        except FileNotFoundError:
            raise
        except OSError:
            with reported("read", f"{self.root}/{name}", _AGAIN):
                raise


def temporary_folder() -> str:
    """Return the folder of temporary files, which may not be writable."""
    try:
        return tempfile.gettempdir()
    except OSError:
        return os.environ.get("TMPDIR", "/tmp")
