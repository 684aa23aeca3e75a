"""The worker process, which draws chunks; only this process uses OpenGL.

The worker reports each step before the step starts: if the worker crashes or hangs, the supervisor
can identify the responsible job.
"""

from __future__ import annotations

import ctypes
import math
import os
import signal
import sys
import warnings
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from functools import lru_cache
from multiprocessing.connection import Connection
from pathlib import Path

from facerender.batch.outputs import Drawn, draw
from facerender.batch.records import (
    NO_MEMORY,
    Chunk,
    Message,
    Order,
    Record,
    Writer,
    code_version,
    failure,
    forget_files,
    key_of,
    meta_of,
)
from facerender.drawing.context import Backend
from facerender.drawing.renderer import Renderer
from facerender.errors import ContextError, FacerenderWarning, InputError, noting
from facerender.loading.source import named_files
from facerender.mesh.mesh import Mesh
from facerender.scene.file import ImageSettings
from facerender.scene.job import MESH_PATHS, Job, MeshFile
from facerender.system.files import CannotUse
from facerender.system.signals import heed_the_coordinator

_MOST_PIXELS = 1 << 20  # Two jobs with larger images would take much memory at a time.
_MESHES = _RENDERERS = 2  # Maximum number of meshes, and of renderers, in a worker's caches.


def main(handle: int) -> None:
    """Draw chunks from the socket with file descriptor `handle` until the socket is closed."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG: die with the parent.
    heed_the_coordinator()
    warnings.simplefilter("ignore", FacerenderWarning)  # The records contain the warnings.
    connection = Connection(handle)
    run = ""
    while True:
        try:
            order: Order = connection.recv()
        except (EOFError, ConnectionError):
            return
        if order.settings.code_version != code_version():
            text = "this worker needs the coordinator's version of facerender: install it"
            connection.send(Message("cannot", text=text))
            continue
        if order.settings.run != run:  # Files may have changed since the last run.
            forget_files()
            _mesh.cache_clear()
            run = order.settings.run
        try:
            for message in _draw(order):
                connection.send(message)
        except CannotUse as error:  # For example a full disk: no job is the cause.
            connection.send(Message("cannot", text=str(error)))


def _draw(order: Order) -> Iterator[Message]:
    """Draw the jobs of an order. While a thread encodes and writes the files of a job, the next job
    is drawn, unless images are large."""
    chunk, settings = order.chunk, order.settings
    writer = Writer(settings, chunk, order.tar, order.size)
    writing: Future[Message] | None = None
    with ThreadPoolExecutor(1) as executor:
        for position in order.left:
            if position in chunk.kept:
                if writing:  # the thread uses the writer
                    yield writing.result()
                    writing = None
                if (record := writer.keep(position)) is not None:
                    yield Message("kept", position, record, writer.size)
                    continue
            yield Message("loads", position)
            row, facts = chunk.rows[position], Record()
            result: Drawn | Exception
            try:
                job = Job.from_dict(row.tables)
                if job.environment:
                    _check_file(job.environment.file)
                mesh, warnings_of_mesh = _mesh(job.mesh)
                if key_of(row) != chunk.keys[position]:
                    raise InputError(
                        "its mesh, maps or environment differ from the files that the coordinator "
                        "read: give all machines the same files, and run the same command again"
                    )
                yield Message("draws", position)
                with noting() as warned:
                    renderer = _renderer(job.image, settings.backend)
                    result = draw(job, mesh, renderer, row.outputs, row.exposure)
                facts = {"job": row.tables, **meta_of(row), **result.facts}
                if texts := [*dict.fromkeys([*warnings_of_mesh, *warned])]:
                    facts["warnings"] = texts
            except Exception as error:
                if isinstance(error, ContextError) and (why := _no_context(settings.backend)):
                    yield Message("cannot", text=why)
                    return
                result = error
            future = executor.submit(_finished, chunk, writer, position, result, facts)
            if writing:
                yield writing.result()
            writing = future
            large = isinstance(result, Drawn) and math.prod(job.image.size) > _MOST_PIXELS
            if large or not order.ahead:
                yield writing.result()
                writing = None
        if writing:
            yield writing.result()
    yield Message("end")


def _finished(
    chunk: Chunk, writer: Writer, position: int, result: Drawn | Exception, facts: Record
) -> Message:
    """Encode and write the files of a job, and return the message that it is done or failed.

    result : the frames of the job, or the error of its drawing
    """
    try:
        if isinstance(result, Exception):
            raise result
        return Message("done", position, writer.write(position, result.files, facts), writer.size)
    except CannotUse:
        raise
    except MemoryError:
        os._exit(NO_MEMORY)  # A new process may have enough memory.
    except Exception as error:
        notes = (str(error), *getattr(error, "__notes__", ()))
        text = " ".join(" ".join(notes).split()) or type(error).__name__
        record = failure(chunk, position, type(error).__name__, text)
        return Message("failed", position, record, writer.size)


@lru_cache(_RENDERERS)
def _renderer(image: ImageSettings, backend: Backend) -> Renderer:
    return Renderer.of(Job(image=image), backend)


def _no_context(backend: Backend) -> str:
    """Return why this process cannot create an OpenGL context, or "" if it can."""
    if not _renderer.cache_info().currsize:
        try:
            Renderer((1, 1), samples=1, backend=backend).release()
        except ContextError as error:
            return str(error)
    return ""


@lru_cache(_MESHES)
def _mesh(file: MeshFile) -> tuple[Mesh, list[str]]:
    """Return a mesh, and the warnings emitted while it was loaded.

    Only the worker's first mesh is written to the disk cache: all meshes of a large batch could
    fill the disk.
    """
    paths = [getattr(file, name) for name in MESH_PATHS]
    for path in filter(None, paths):
        _check_file(path)
    for path in named_files(file.source) if file.path else ():
        _check_file(path)
    with noting() as warned:
        mesh = file.load(True if _mesh.cache_info().misses == 1 else "read")
    return mesh, warned


def _check_file(path: str | Path) -> None:
    """Raise InputError for a pipe or a device, because reading it may never end."""
    if os.path.exists(path) and not (os.path.isfile(path) or os.path.isdir(path)):
        raise InputError(f"{path} is a pipe or a device: give a file")


if __name__ == "__main__":
    with suppress(ConnectionError):  # The coordinator has ended.
        main(int(sys.argv[1]))
