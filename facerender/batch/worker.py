"""The process that draws chunks and plans groups, and the only one with OpenGL. It says where it is
before and after each job, so that its supervisor knows the job at fault when it dies or hangs."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import warnings
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import suppress
from functools import lru_cache
from multiprocessing.connection import Connection
from pathlib import Path

from facerender.batch.chunk import Record, Settings, forget_files, key_of, painter
from facerender.batch.jobs import Row
from facerender.batch.messages import Order, PlanOrder, Said, failure
from facerender.batch.output import Writer
from facerender.batch.passes import Drawn, draw
from facerender.drawing.context import Backend
from facerender.drawing.renderer import Renderer
from facerender.errors import ContextError, FacerenderWarning, InputError, noting
from facerender.job import MESH_PATHS, ImageSettings, Job, MeshFile
from facerender.loading.references import named_files
from facerender.scenes.lod import simplified
from facerender.scenes.mesh import Mesh
from facerender.system.signals import heed_the_driver

MESHES = 2  # that a worker keeps
_RENDERERS = 2
_NO_MEMORY = 9  # exit status
_DIE_WITH_PARENT = 1  # PR_SET_PDEATHSIG


def main(handle: int) -> None:
    """Draw the chunks that come through a socket, until it is closed."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_DIE_WITH_PARENT, signal.SIGKILL)
    heed_the_driver()
    warnings.simplefilter("ignore", FacerenderWarning)  # they are noted
    connection = Connection(handle)
    renderers, run = _Renderers(), ""
    while True:
        try:
            order: Order | PlanOrder = connection.recv()
        except (EOFError, ConnectionError):
            return
        if order.settings.painter != painter():
            text = "another version of facerender draws here: install the driver's"
            connection.send(Said("cannot", text=text))
            continue
        if order.settings.run != run:  # between two of them files may have changed
            forget_files()
            _mesh.cache_clear()
            run = order.settings.run
        answers = _draw(order, renderers) if isinstance(order, Order) else _plan(order, renderers)
        for said in answers:
            connection.send(said)


class _Renderers:
    """Renderers by what they draw, the last few of them."""

    def __init__(self) -> None:
        self._kept: OrderedDict[tuple[ImageSettings, Backend], Renderer] = OrderedDict()
        self.can_draw = False

    def of(self, job: Job, backend: Backend) -> Renderer:
        key = job.image, backend
        if key not in self._kept:
            while len(self._kept) >= _RENDERERS:
                self._kept.popitem(last=False)[1].release()
            self._kept[key] = Renderer.of(job, backend)
            self.can_draw = True
        self._kept.move_to_end(key)
        return self._kept[key]

    def check(self, backend: Backend) -> None:
        """Raise ContextError where nothing can be drawn at all."""
        if not self.can_draw:
            Renderer((1, 1), samples=1, backend=backend).release()
            self.can_draw = True


def _draw(order: Order, renderers: _Renderers) -> Iterator[Said]:
    chunk, settings = order.chunk, order.settings
    writer = Writer(settings, chunk, order.tar, order.size)
    for position in order.left:
        try:
            if (record := writer.keep(position)) is not None:
                yield Said("kept", position, record, writer.size)
                continue
            yield Said("loads", position)
            row = chunk.rows[position]
            job = Job.from_dict(row.tables)
            if job.environment:
                _check_file(job.environment.file)
            mesh, told = _mesh(job.mesh)
            if key_of(row) != chunk.keys[position]:
                raise InputError(
                    "its mesh, maps or environment are not here what they were where the batch "
                    "was started; give all machines the same files, and run the same command again"
                )
            yield Said("draws", position)
            with noting() as warned:
                renderer = renderers.of(job, settings.backend)
                drawn = _drawn(row, job, mesh, renderer)
            facts: Record = {"job": row.tables, **drawn.facts}
            if told or warned:
                facts["warnings"] = [*dict.fromkeys([*told, *warned])]
            try:
                record = writer.write(position, drawn.files, facts)
            except OSError as error:  # a full disk is no fault of the job
                yield Said("cannot", text=f"cannot write to {settings.output}: {error}")
                return
        except MemoryError:
            os._exit(_NO_MEMORY)  # another process may have enough
        except Exception as error:
            if isinstance(error, ContextError) and (why := _no_context(renderers, settings)):
                yield Said("cannot", text=why)
                return
            record = failure(chunk, position, type(error).__name__, _told(error))
            yield Said("failed", position, record, writer.size)
            continue
        yield Said("done", position, record, writer.size)
    yield Said("end")


def _drawn(row: Row, job: Job, mesh: Mesh, renderer: Renderer) -> Drawn:
    """The passes of a job: the image by its plan, where it has one, the others exactly."""
    if row.plan is None:
        return draw(job, mesh, renderer, row.passes, row.exposure)
    cheap = Job.from_dict({**row.tables, **row.plan})
    assert cheap.planned is not None
    triangles = cheap.planned.triangles
    level = mesh if triangles is None else simplified(mesh, triangles)  # kept with the mesh
    image = draw(cheap, level, renderer, ("image",), row.exposure)
    rest = [name for name in row.passes if name != "image"]
    others = draw(job, mesh, renderer, rest, row.exposure)
    facts = {**image.facts, **others.facts, "plan": row.plan}
    return Drawn({**image.files, **others.files}, facts)


def _plan(order: PlanOrder, renderers: _Renderers) -> Iterator[Said]:
    from facerender.batch.planner import planned

    group, settings = order.group, order.settings
    try:
        yield Said("loads")
        job = Job.from_dict(group.tables)
        mesh, _ = _mesh(job.mesh)
        yield Said("plans")
        for found in planned(group, mesh, renderers.of(job, settings.backend)):
            yield Said("plans", record=found)
    except MemoryError:
        os._exit(_NO_MEMORY)
    except Exception as error:
        if isinstance(error, ContextError) and (why := _no_context(renderers, settings)):
            yield Said("cannot", text=why)
            return
        yield Said("failed", record={"error": _told(error)})
    yield Said("end")


def _told(error: Exception) -> str:
    """What an error says, in one line."""
    return " ".join(str(error).split()) or type(error).__name__


def _no_context(renderers: _Renderers, settings: Settings) -> str:
    """Why nothing can be drawn here at all, if so."""
    try:
        renderers.check(settings.backend)
    except ContextError as error:
        return str(error)
    return ""


@lru_cache(MESHES)
def _mesh(file: MeshFile) -> tuple[Mesh, list[str]]:
    """A mesh, and what was warned of when it was read. The first one is kept for other workers; all
    of a large batch would fill the disk."""
    own = [getattr(file, each) for each in MESH_PATHS]
    for path in [*filter(None, own), *(named_files(Path(file.path)) if file.path else ())]:
        _check_file(path)
    with noting() as warned:
        mesh = file.cached() or file.load(cache=_mesh.cache_info().misses == 1)
    return mesh, warned


def _check_file(path: str | Path) -> None:
    """Raise InputError for what may have no end; what is not there, its reader tells."""
    if os.path.exists(path) and not (os.path.isfile(path) or os.path.isdir(path)):
        raise InputError(f"{path} is a pipe or a device: give a file")


if __name__ == "__main__":
    with suppress(ConnectionError):  # the driver has ended
        main(int(sys.argv[1]))
