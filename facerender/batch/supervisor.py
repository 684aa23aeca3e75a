"""The supervisor of a worker process; the engines call this supervisor.

The supervisor restarts a worker that crashes or hangs, identifies the responsible job, and commits
the chunk. It does not use OpenGL.
"""

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
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

from facerender.batch.chunk import Chunk, Record, Settings
from facerender.batch.protocol import NO_MEMORY, Message, Order, failure
from facerender.batch.records import begin, commit
from facerender.batch.storage import Storage
from facerender.errors import FacerenderError
from facerender.system.signals import hold

Report = Callable[[str, str, str], None]  # Worker, step, job id.

# One thread per worker: one process per core is faster than threads, and gives the same pixels.
_ALONE = {"LP_NUM_THREADS": "0", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
_THREAD = threading.local()
_NO_JOB = -1
_MEMORY = "ran out of memory"


class CannotDraw(FacerenderError, RuntimeError):
    """No job can be drawn or written by a worker."""


@dataclass(frozen=True)
class Death:
    """The end of a worker: its host and process ID, how it ended, its last step and job."""

    worker: str
    how: str
    step: str
    job: str

    def __str__(self) -> str:
        action = {"loads": "loaded the mesh of job", "draws": "drew job"}.get(self.step)
        job = f"while it {action} {self.job}" if action else "before or after a job"
        return f"worker {self.worker} {self.how} {job}"


@dataclass(frozen=True)
class Outcome:
    """The result of a chunk."""

    chunk: int  # Number of the chunk.
    drawn: int
    kept: int  # Number of jobs whose files from an earlier run were reused.
    failed: tuple[Record, ...]
    seconds: float  # Time to draw, write and commit the chunk.
    deaths: tuple[Death, ...]  # The workers that ended or hung.
    renderer: str  # GL_RENDERER and GL_VERSION; "" if no job was drawn.
    worker: str  # Host and process ID of the last worker.


def draw_chunk(settings: Settings, chunk: Chunk, report: Report | None = None) -> Outcome:
    """Draw, write and commit a chunk with this thread's worker.

    Raises
    ------
    CannotDraw : no job can be drawn, for example without OpenGL
    CannotUse : a file cannot be written, for example on a full disk
    """
    if not hasattr(_THREAD, "supervisor"):
        _THREAD.supervisor = Supervisor()
    outcome: Outcome = _THREAD.supervisor.run(settings, chunk, report or (lambda *_: None))
    return outcome


class _WorkerEnded(Exception):
    """A worker died or hung. Arguments: its host and process ID, and how it ended."""


class Supervisor:
    """Runs one worker process at a time, and starts a new one after a crash or a hang.

    Pebble 5.2.3 was tried instead of this class. Its pool uses multiprocessing, which cannot start
    processes in Dask workers ("daemonic processes are not allowed to have children"). If an idle
    worker is killed, the pool ends with "Unexpected error within the Pool", without the exit
    status. A worker that hangs while it starts has no time limit. With 30 kills in 400 jobs, Pebble
    wrote the same files as this class. Pebble would save about 25 lines.
    """

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._connection: Connection | None = None
        self._patience = 0.0  # Minimum time limit of the next message, in seconds.
        self._kills = 0  # _kills_for_memory() at the start of the worker.

    def __del__(self) -> None:
        self.stop()

    def stop(self) -> None:
        """Kill the worker, if there is one."""
        if self._process is not None and self._connection is not None:
            self._process.kill()
            self._process.wait()
            self._connection.close()
        self._process = self._connection = None

    def run(self, settings: Settings, chunk: Chunk, report: Report) -> Outcome:
        """Draw, write and commit a chunk; see :func:`draw_chunk`."""
        began = time.perf_counter()
        with ExitStack() as stack:
            tar = None
            if settings.layout == "shards":
                tar = stack.enter_context(Storage(settings.output).temporary())
            begin(settings, chunk)
            records, steps, deaths = self._draw(settings, chunk, tar, report)
            commit(settings, chunk, tar, records)
        return Outcome(
            chunk.number,
            drawn=steps["done"],
            kept=steps["kept"],
            failed=tuple(record for record in records if "error" in record),
            seconds=time.perf_counter() - began,
            deaths=tuple(deaths),
            renderer=next(
                (f"{r['GL_RENDERER']}; {r['GL_VERSION']}" for r in records if "GL_RENDERER" in r),
                "",
            ),
            worker=self.worker,
        )

    def _draw(
        self, settings: Settings, chunk: Chunk, tar: Path | None, report: Report
    ) -> tuple[list[Record], Counter[str], list[Death]]:
        """Draw the jobs of a chunk, and return their records in order, the number of jobs per final
        step ("done", "kept", "failed"), and the workers that ended or hung."""
        records: dict[int, Record] = {}
        attempts, steps, size = Counter[int](), Counter[str](), 0
        deaths: list[Death] = []
        while True:
            positions = [position for position in range(len(chunk.rows)) if position not in records]
            message = Message("starts")
            try:
                for message in self._answers(Order(settings, chunk, tuple(positions), tar, size)):
                    if message.record is not None:
                        records[message.position], size = message.record, message.size
                        steps[message.step] += 1
                        attempts[_NO_JOB] = 0
                    report(self.worker, message.step, _id(chunk, message))
                return [records[position] for position in sorted(records)], steps, deaths
            except _WorkerEnded as ended:
                worker, how = ended.args
                deaths.append(Death(worker, how, message.step, _id(chunk, message)))
            job = message.position if message.step in ("loads", "draws") else _NO_JOB
            attempts[job] += 1
            if attempts[job] < settings.tries:
                continue
            text = f"the worker {how}, {attempts[job]} times"
            if _MEMORY in how:
                text += ": give fewer --workers, or make maps or images smaller"
            if job == _NO_JOB:
                raise CannotDraw(f"{chunk}: {text}, before or after a job")
            for position in _at_fault(chunk, message) - set(records):
                records[position] = failure(chunk, position, "WorkerDied", text)
                report(self.worker, "failed", chunk.rows[position].id)

    def _answers(self, order: Order) -> Iterator[Message]:
        """Send an order, and yield the worker's messages until the end of the chunk."""
        try:
            connection = self._started(order.settings.timeout)
            connection.send(order)
            message = Message("starts")
            while message.step != "end":
                if not connection.poll(max(order.settings.timeout, self._patience)):
                    raise TimeoutError
                message, self._patience = connection.recv(), 0.0
                if message.step == "cannot":
                    raise CannotDraw(message.text)
                yield message
            return
        except (TimeoutError, BlockingIOError):
            how = f"sent no message for {order.settings.timeout:g} s"
        except (EOFError, ConnectionError):
            how = self._exit()
        worker = self.worker
        self.stop()
        raise _WorkerEnded(worker, how)

    @property
    def worker(self) -> str:
        """Host name and process ID of the worker."""
        return f"{socket.gethostname()}:{self._process.pid if self._process else 0}"

    def _started(self, timeout: float) -> Connection:
        """Return the connection to the worker; start a worker if none runs."""
        if self._connection is None or self._process is None or self._process.poll() is not None:
            self.stop()
            # A socket, unlike a pipe, has time limits. Without time limits, a worker that stops in
            # the middle of a message would block this thread for ever.
            ours, theirs = socket.socketpair()
            limit = struct.pack("ll", math.ceil(timeout), 0)
            ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, limit)
            ours.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, limit)
            hold()
            self._kills = _kills_for_memory()
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "facerender.batch.worker", str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                env=os.environ | _ALONE | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
            )
            theirs.close()
            self._connection = Connection(ours.detach())
            self._patience = 60.0
        return self._connection

    def _exit(self) -> str:
        """Wait for the worker to end, and return how it ended."""
        assert self._process is not None
        code = self._process.wait()
        if code == NO_MEMORY:
            return _MEMORY
        if code >= 0:
            return f"ended with exit status {code}"
        names = {member.value: member.name for member in signal.Signals}
        how = f"was killed by {names.get(-code, f'signal {-code}')}"
        # The kernel kills with SIGKILL if memory is short, and counts these kills.
        if -code == signal.SIGKILL and _kills_for_memory() > self._kills:
            how += f" after the machine {_MEMORY}"
        return how


def _kills_for_memory() -> int:
    """Return how many processes the kernel has killed because memory was short; 0 if unknown."""
    with suppress(OSError, ValueError):
        facts = dict(line.split() for line in Path("/proc/vmstat").read_text().splitlines())
        return int(facts.get("oom_kill", 0))
    return 0


def _id(chunk: Chunk, message: Message) -> str:
    """Return the ID of a message's job, or "" if the message is about no job."""
    return chunk.rows[message.position].id if message.position >= 0 else ""


def _at_fault(chunk: Chunk, message: Message) -> set[int]:
    """Return the indices of the jobs that may have ended the worker.

    These are the job that was being drawn, or all jobs with the mesh that was being loaded.
    """
    if message.step != "loads":
        return {message.position}
    mesh = chunk.rows[message.position].tables.get("mesh")
    return {i for i, row in enumerate(chunk.rows) if row.tables.get("mesh") == mesh}
