"""Has chunks drawn, and plans made, by a process that may crash or hang, names the job at fault,
and goes on after it: what every engine calls. No OpenGL here."""

from __future__ import annotations

import math
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection

from facerender.batch.chunk import Chunk, Record, Settings
from facerender.batch.groups import Group
from facerender.batch.messages import Order, PlanOrder, Said, failure
from facerender.batch.output import begin, commit
from facerender.batch.place import Place
from facerender.errors import FacerenderError, reason
from facerender.system.signals import hold

Heard = Callable[[str, str, str], None]  # worker, what it says, the job's id

# A worker has one thread: a process for each core outruns threads, and bits are the same.
_ALONE = {"LP_NUM_THREADS": "0", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
_HERE = threading.local()
_BETWEEN = -1  # no job's position
_TO_START = 60.0  # seconds until a worker says something


class CannotDraw(FacerenderError, RuntimeError):
    """No job can be drawn or written here, whichever it is."""


@dataclass(frozen=True)
class Outcome:
    """What became of a chunk.

    Attributes
    ----------
    chunk : its number
    drawn, kept : jobs that were drawn now, and that an earlier run has drawn
    failed : records of jobs that were given up
    size : bytes of all files
    seconds : that it took
    deaths : of workers on the way
    renderer : GL_RENDERER and GL_VERSION; "" where nothing was drawn
    worker : host and process that drew it last
    """

    chunk: int
    drawn: int
    kept: int
    failed: tuple[Record, ...]
    size: int
    seconds: float
    deaths: int
    renderer: str
    worker: str


def draw_chunk(settings: Settings, chunk: Chunk, heard: Heard | None = None) -> Outcome:
    """Draw, write and commit a chunk with this thread's worker, whatever its jobs do.

    Raises
    ------
    CannotDraw : nothing can be drawn here: no OpenGL, a full disk
    """
    return _own().run(settings, chunk, heard or _say_nothing)


def plan_group(settings: Settings, group: Group) -> Record:
    """Plan a group with this thread's worker, as :func:`facerender.batch.planner.planned` tells it,
    or tell in "error" why it cannot be planned; errors as of :func:`draw_chunk`."""
    return _own().plan(settings, group)


def _own() -> Supervisor:
    """The supervisor of this thread."""
    if not hasattr(_HERE, "supervisor"):
        _HERE.supervisor = Supervisor()
    supervisor: Supervisor = _HERE.supervisor
    return supervisor


class _Ended(Exception):
    """A worker that died or hung, and how."""


class Supervisor:
    """One worker after the other."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._connection: Connection | None = None
        self._patience = 0.0  # seconds of silence that are granted besides

    def __del__(self) -> None:
        self.stop()

    def stop(self) -> None:
        """End the worker."""
        if self._process is not None and self._connection is not None:
            self._process.kill()
            self._process.wait()
            self._connection.close()
        self._process = self._connection = None

    def run(self, settings: Settings, chunk: Chunk, heard: Heard) -> Outcome:
        """See :func:`draw_chunk`."""
        began, deaths = time.perf_counter(), 0
        records: dict[int, Record] = {}
        tries: Counter[int] = Counter()
        said: Counter[str] = Counter()
        tar = Place(settings.output).unfinished() if settings.layout == "shards" else None
        size = 0
        try:
            begin(settings, chunk)
            while True:
                left = [each for each in range(len(chunk.rows)) if each not in records]
                order = Order(settings, chunk, tuple(left), tar, size)
                last = Said("starts")
                try:
                    for last in self._answers(order):
                        if last.record is not None:
                            records[last.position], size = last.record, last.size
                            said[last.what] += 1
                            tries[_BETWEEN] = 0
                        heard(self.worker, last.what, _id(chunk, last.position))
                    break
                except _Ended as ended:
                    why = str(ended)
                deaths += 1
                at = last.position if last.what in ("loads", "draws") else _BETWEEN
                tries[at] += 1
                if tries[at] < settings.tries:
                    continue
                text = f"the worker {why}, {tries[at]} times"
                if at == _BETWEEN:
                    raise CannotDraw(f"chunk {chunk.number}: {text}, before a job or behind one")
                for position in _at_fault(chunk, last) - set(records):
                    records[position] = failure(chunk, position, "WorkerDied", text)
                    heard(self.worker, "failed", chunk.rows[position].id)
            ordered = [records[position] for position in sorted(records)]
            commit(settings, chunk, tar, ordered)
        except OSError as error:
            raise CannotDraw(
                f"cannot write to {settings.output}: {reason(error)}; make room, and run the same "
                "command again"
            ) from None
        finally:
            if tar is not None:
                tar.unlink(missing_ok=True)
        failed = tuple(each for each in ordered if "error" in each)
        files = [about for each in ordered for about in each.get("files", {}).values()]
        return Outcome(
            chunk.number,
            drawn=said["done"],
            kept=said["kept"],
            failed=failed,
            size=sum(about["bytes"] for about in files),
            seconds=time.perf_counter() - began,
            deaths=deaths,
            renderer=next((_renderer(each) for each in ordered if "GL_RENDERER" in each), ""),
            worker=self.worker,
        )

    def plan(self, settings: Settings, group: Group) -> Record:
        """See :func:`plan_group`."""
        why, found = "", None
        for _ in range(settings.tries):
            try:
                for said in self._answers(PlanOrder(settings, group)):
                    found = said.record or found
            except _Ended as ended:
                why = str(ended)
            else:
                assert found is not None
                return found
        return {"error": f"the worker {why}, {settings.tries} times"}

    def _answers(self, order: Order | PlanOrder) -> Iterator[Said]:
        """Send an order, and yield what the worker says until it is done with it. CannotDraw where
        it says so, _Ended where it is no more."""
        try:
            connection = self._started(order.settings.timeout)
            connection.send(order)
            said = Said("starts")
            while said.what != "end":
                if not connection.poll(max(order.settings.timeout, self._patience)):
                    raise TimeoutError
                said, self._patience = connection.recv(), 0.0
                if said.what == "cannot":
                    raise CannotDraw(said.text)
                yield said
            return
        except (TimeoutError, BlockingIOError):
            why = f"said nothing for {order.settings.timeout:g} s"
        except (EOFError, ConnectionError):
            why = self._end()
        self.stop()
        raise _Ended(why)

    @property
    def worker(self) -> str:
        """The host and the process that draws."""
        return f"{socket.gethostname()}:{self._process.pid if self._process else 0}"

    def _started(self, timeout: float) -> Connection:
        """The connection to the worker, which is started where there is none."""
        if self._connection is None or self._process is None or self._process.poll() is not None:
            self.stop()
            ours, theirs = socket.socketpair()
            limit = struct.pack("ll", math.ceil(timeout), 0)  # of a worker that stops in a message
            ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, limit)
            ours.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, limit)
            hold()
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "facerender.batch.worker", str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                env=os.environ | _ALONE | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
            )
            theirs.close()
            self._connection = Connection(ours.detach())
            self._patience = _TO_START
        return self._connection

    def _end(self) -> str:
        """How the worker has ended."""
        assert self._process is not None
        code = self._process.wait()
        return f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with {code}"


def _renderer(record: Record) -> str:
    return f"{record['GL_RENDERER']}; {record['GL_VERSION']}"


def _id(chunk: Chunk, position: int) -> str:
    return chunk.rows[position].id if position >= 0 else ""


def _at_fault(chunk: Chunk, last: Said) -> set[int]:
    """The job that was being drawn, or all jobs of the mesh that was being loaded."""
    if last.what != "loads":
        return {last.position}
    mesh = chunk.rows[last.position].tables.get("mesh")
    return {i for i, row in enumerate(chunk.rows) if row.tables.get("mesh") == mesh}


def _say_nothing(worker: str, what: str, job: str) -> None:
    pass
