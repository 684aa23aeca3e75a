"""The worker process, which draws chunks; only this process uses OpenGL."""

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

from facerender.batch.jobs import Record, code_version, forget_files, key_of
from facerender.batch.outputs import Drawn, draw
from facerender.batch.records import NO_MEMORY, Message, Order, Writer, failure
from facerender.drawing.context import Backend
from facerender.drawing.renderer import Renderer
from facerender.errors import ContextError, FacerenderWarning, InputError, noting, withheld
from facerender.loading import MeshFile, load_mesh
from facerender.mesh.mesh import Mesh
from facerender.scene.job import ImageSettings, Job
from facerender.system.files import CannotUse
from facerender.system.signals import heed_the_coordinator

_MAX_PIXELS = 1 << 20  # Two jobs with larger images would take much memory at a time.
_MESHES = _RENDERERS = 2  # Maximum number of meshes, and of renderers, in a worker's caches.


def main(handle: int) -> None:
    """Draw chunks from the socket with file descriptor `handle` until the socket is closed."""
    if sys.platform == "linux":
        # PR_SET_PDEATHSIG: the worker dies with its parent, also if the parent is killed.
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)
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
        # On a cluster, a worker outlives a run, and files may change before the next run.
        if order.settings.run != run:
            forget_files()
            _mesh.cache_clear()
            run = order.settings.run
        try:
            for message in _draw(order):
                connection.send(message)
        except CannotUse as error:  # For example a full disk: no job is the cause.
            connection.send(Message("cannot", text=str(error)))


def _draw(order: Order) -> Iterator[Message]:
    """Draw the jobs of an order, and yield a message before each step starts."""
    # If the worker crashes or hangs, its last message identifies the responsible job.
    # While a thread encodes and writes the files of a job, the next job is drawn.
    chunk, settings = order.chunk, order.settings
    writer = Writer(settings, chunk, order.tar, order.size)
    pending: list[Future[Message]] = []

    def finished(max_pending: int = 0) -> Iterator[Message]:
        while len(pending) > max_pending:
            yield pending.pop(0).result()

    with ThreadPoolExecutor(1) as executor:
        for position in order.left:
            if position in chunk.kept:
                yield from finished()  # the thread uses the writer
                if (record := writer.keep(position)) is not None:
                    yield Message("kept", position, record, writer.size)
                    continue
            yield Message("loads", position)
            row, description = chunk.rows[position], Record()
            result: Drawn | Exception
            try:
                job = Job.from_dict(row.tables)
                mesh, warnings_of_mesh = _mesh(job.mesh, not row.anonymous)
                if key_of(row) != chunk.keys[position]:
                    problem = "differ from the files that the coordinator read"
                    remedy = "give all machines the same files, and run the same command again"
                    raise InputError(f"its mesh, maps or environment {problem}: {remedy}")
                yield Message("draws", position)
                with noting() as warned:
                    renderer = _renderer(job.image, settings.backend)
                    result = draw(job, mesh, renderer, row.outputs, row.exposure, row.tone)
                description = {**row.inputs, **result.details}
                if texts := [*dict.fromkeys([*warnings_of_mesh, *warned])]:
                    hidden = [withheld(len(texts), "warning")]
                    description["warnings"] = hidden if row.anonymous else texts
            except Exception as error:
                if isinstance(error, ContextError) and (why := _no_context(settings.backend)):
                    yield Message("cannot", text=why)
                    return
                result = error
            pending.append(executor.submit(_finished, writer, position, result, description))
            large = isinstance(result, Drawn) and math.prod(job.image.size) > _MAX_PIXELS
            yield from finished(0 if large or not order.ahead else 1)
        yield from finished()
    yield Message("end")


def _finished(
    writer: Writer, position: int, result: Drawn | Exception, description: Record
) -> Message:
    """Encode and write the frames of a job, and return the message that it is done or failed."""
    try:
        if isinstance(result, Exception):
            raise result
        record = writer.write(position, result.files, description)
        return Message("done", position, record, writer.size)
    except CannotUse:
        raise
    except MemoryError:
        # A new process may have enough memory.
        os._exit(NO_MEMORY)
    except Exception as error:
        notes = (str(error), *getattr(error, "__notes__", ()))
        text = " ".join(" ".join(notes).split()) or type(error).__name__
        record = failure(writer.chunk, position, type(error).__name__, text)
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
def _mesh(file: MeshFile, named: bool) -> tuple[Mesh, list[str]]:
    """Return a mesh, and the warnings emitted while it was loaded."""
    # Only the first mesh is written to the disk cache, which contains names: all meshes of a batch
    # could fill the disk.
    with noting() as warned:
        first = named and _mesh.cache_info().misses == 1
        mesh = load_mesh(file, cache=True if first else "read")
    return mesh, warned


if __name__ == "__main__":
    with suppress(ConnectionError):  # The coordinator has ended.
        main(int(sys.argv[1]))
