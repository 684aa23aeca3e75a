"""The run of a batch: a coordinator submits chunks to an engine (threads of this process, or a Dask
cluster), whose supervisors start worker processes; they report the progress as bars or JSON lines.

A supervisor restarts a worker that crashes or hangs, identifies the responsible job, and commits
the chunk."""

from __future__ import annotations

import json
import logging
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
from concurrent import futures
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field
from itertools import islice
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from tqdm import tqdm

from facerender.batch import records
from facerender.batch.jobs import Chunk, Record, Settings
from facerender.batch.records import Message, Order, Storage, Work
from facerender.errors import FacerenderError, InputError, clipped, warn
from facerender.system.process import available, optional, shows_bars
from facerender.system.signals import hold, if_ended

NAMED = 5  # maximum number of failed jobs, and of workers that ended, that are named


def failed_line(record: Record) -> str:
    """Return a message that names a failed job and the reason."""
    return f"facerender: job {record['id']} failed: {clipped(record['error'], 400)}"


class Progress(ExitStack):
    """Progress bars on a terminal, names of failed jobs and ended workers, or JSON lines.

    workers : number of local workers, which report every step; 0 for a cluster
    lines : whether to print a JSON line for each chunk, failed job and ended worker. Otherwise,
        `message` prints the first NAMED failed jobs and ended workers
    quiet : whether to hide the bars
    """

    def __init__(
        self, work: Work, workers: int, lines: bool, message: Callable[[str], None], quiet: bool
    ) -> None:
        super().__init__()
        has_bars, jobs = shows_bars(quiet), len(work.ids)
        self._done = jobs - work.left
        options = {"unit": " jobs", "disable": not has_bars, "mininterval": 0.2, "smoothing": 0.05}
        self._bar = tqdm(total=jobs, initial=self._done, **options)
        positions = range(1, 1 + workers * has_bars)
        self._free = [tqdm(bar_format="{desc}", position=i, leave=False) for i in positions]
        for bar in (self._bar, *self._free):
            self.callback(bar.close)
        self._of: dict[int, tqdm[Any]] = {}  # keyed by the supervisor's thread ID
        self._workers, self._lines = workers, lines
        self._message = None if lines else message
        self.failed = self.deaths = 0  # numbers of failed jobs, and of workers that ended or hung
        total = f"of {jobs} jobs are done; run the same command to resume"
        self.enter_context(if_ended(lambda: f"{self._done} {total}"))

    def report(self, worker: str, step: str, job: str) -> None:
        """Show the step of a local worker. The thread of the worker's supervisor calls this."""
        if step in ("done", "kept", "failed"):
            self._bar.update()
        thread = threading.get_ident()
        if thread not in self._of and self._free:
            self._of[thread] = self._free.pop(0)
        if thread in self._of:
            self._of[thread].set_description_str(f"{worker}  {step} {job}")

    def finished(self, outcome: Outcome) -> None:
        """Count the jobs of a finished chunk, and print its JSON lines."""
        drawn, kept = outcome.steps["done"], outcome.steps["kept"]
        counts = {"drawn": drawn, "kept": kept, "failed": len(outcome.failed)}
        jobs = sum(counts.values())
        self._done += jobs
        if not self._workers:
            self._bar.update(jobs)
        for death in outcome.deaths:
            self.deaths += 1
            self.say("died", worker=death.worker, how=death.how, id=death.job)
            if self._message and self.deaths <= NAMED:
                self._message(f"facerender: {death}")
        for record in outcome.failed:
            self.failed += 1
            self.say("failed", id=record["id"], error=record["error"])
            if self._message and self.failed <= NAMED:
                self._message(failed_line(record))
        if self.failed:
            self._bar.set_postfix_str(f"{self.failed} failed", refresh=False)
        run = {"seconds": round(outcome.seconds, 3), "deaths": len(outcome.deaths)}
        self.say("chunk", chunk=outcome.chunk, **counts, **run, worker=outcome.worker)

    def say(self, event: str, **values: Any) -> None:
        """Print a JSON line if `lines` is set."""
        if not self._lines:
            return
        line = json.dumps({"time": round(time.time(), 3), "event": event, **values})
        try:
            print(line, flush=True)
        except OSError:
            # The reader has closed the pipe, or the disk is full: the batch goes on.
            self._lines = False


Report = Callable[[str, str, str], None]  # Worker, step, job id.

# One thread per worker: one process per core is faster than threads, and gives the same pixels.
_ALONE = {"LP_NUM_THREADS": "0", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
_THREAD = threading.local()
_NO_JOB = -1
_MEMORY = "ran out of memory"


class CannotDraw(FacerenderError, RuntimeError):
    """No job can be drawn or written by a worker."""


@dataclass(eq=False)
class Death(Exception):
    """The end of a worker: its host and process ID, how it ended, its last step and job."""

    worker: str
    how: str
    step: str
    job: str

    def __str__(self) -> str:
        action = {"loads": "loaded the mesh of job", "draws": "drew job"}.get(self.step)
        job = f"while it {action} {self.job}" if action else "before or after a job"
        return f"worker {self.worker} {self.how} {job}"


@dataclass
class Outcome:
    """The result of a chunk."""

    chunk: int  # Number of the chunk.
    # Number of jobs per final step of workers: "done", "kept" or "failed".
    steps: Counter[str] = field(default_factory=Counter)
    failed: tuple[Record, ...] = ()  # Also of jobs that ended their worker.
    seconds: float = 0.0  # Time to draw, write and commit the chunk.
    deaths: list[Death] = field(default_factory=list)  # The workers that ended or hung.
    renderer: str = ""  # GL_RENDERER and GL_VERSION; "" if no job was drawn.
    worker: str = ""  # Host and process ID of the last worker.


def draw_chunk(settings: Settings, chunk: Chunk, report: Report | None = None) -> Outcome:
    """Draw, write and commit a chunk with this thread's worker. Raise CannotDraw if no job can be
    drawn, for example without OpenGL, and CannotUse if a file cannot be written."""
    if not hasattr(_THREAD, "supervisor"):
        _THREAD.supervisor = Supervisor()
    outcome: Outcome = _THREAD.supervisor.run(settings, chunk, report or (lambda *_: None))
    return outcome


class Supervisor:
    """Runs one worker process at a time, and starts a new one after a crash or a hang."""

    # Pebble 5.2.3 would save 25 lines, but its pool cannot start processes in workers of Dask. It
    # loses the exit status of a killed idle worker, and lets a worker hang while it starts.

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
        began, outcome = time.perf_counter(), Outcome(chunk.number)
        with ExitStack() as stack:
            tar = None
            if settings.layout == "shards":
                tar = stack.enter_context(Storage(settings.output).temporary())
            records.begin(settings, chunk)
            results = self._draw(settings, chunk, tar, report, outcome)
            records.commit(settings, chunk, tar, results)
        drivers = (f"{r['GL_RENDERER']}; {r['GL_VERSION']}" for r in results if "GL_RENDERER" in r)
        outcome.failed = tuple(record for record in results if "error" in record)
        outcome.seconds = time.perf_counter() - began
        outcome.renderer, outcome.worker = next(drivers, ""), self.worker
        return outcome

    def _draw(
        self, settings: Settings, chunk: Chunk, tar: Path | None, report: Report, outcome: Outcome
    ) -> list[Record]:
        """Draw the jobs of a chunk, and return their records in order. Add steps and deaths to the
        outcome."""
        results: dict[int, Record] = {}
        attempts, size = Counter[int](), 0
        while True:
            left = tuple(i for i in range(len(chunk.rows)) if i not in results)
            message = Message("starts")
            try:
                # After a death, the last message must name the job that causes the next one.
                order = Order(settings, chunk, left, tar, size, ahead=not outcome.deaths)
                for message in self._answers(order):
                    if message.record is not None:
                        results[message.position], size = message.record, message.size
                        outcome.steps[message.step] += 1
                        attempts[_NO_JOB] = 0
                    report(self.worker, message.step, _id(chunk, message))
                return [results[position] for position in sorted(results)]
            except Death as death:
                outcome.deaths.append(death)
                how = death.how
            job = message.position if message.step in ("loads", "draws") else _NO_JOB
            attempts[job] += 1
            if attempts[job] < settings.tries:
                continue
            text = f"the worker {how}, {attempts[job]} times"
            if _MEMORY in how:
                text += ": give fewer --workers, or make maps or images smaller"
            if job == _NO_JOB:
                raise CannotDraw(f"chunk {chunk.number}: {text}, before or after a job")
            # One of the jobs with the mesh that was being loaded, or the job that was being drawn.
            mesh = chunk.rows[job].tables.get("mesh")
            of_mesh = {i for i, row in enumerate(chunk.rows) if row.tables.get("mesh") == mesh}
            for position in (of_mesh if message.step == "loads" else {job}) - results.keys():
                results[position] = records.failure(chunk, position, "WorkerDied", text)
                report(self.worker, "failed", chunk.rows[position].id)

    def _answers(self, order: Order) -> Iterator[Message]:
        """Send an order, and yield the worker's messages until the end of the chunk. Raise Death if
        the worker ends or hangs."""
        message = Message("starts")
        try:
            connection = self._started(order.settings.timeout)
            connection.send(order)
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
        death = Death(self.worker, how, message.step, _id(order.chunk, message))
        self.stop()
        raise death

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
            # A worker that started now would outlive the signal that ends this process.
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
            # On a busy machine, imports and the OpenGL driver take longer than a short timeout.
            self._patience = 60.0
        return self._connection

    def _exit(self) -> str:
        """Wait for the worker to end, and return how it ended."""
        assert self._process is not None
        code = self._process.wait()
        if code == records.NO_MEMORY:
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
        counters = dict(line.split() for line in Path("/proc/vmstat").read_text().splitlines())
        return int(counters.get("oom_kill", 0))
    return 0


def _id(chunk: Chunk, message: Message) -> str:
    """Return the ID of a message's job, or "" if the message is about no job."""
    return chunk.rows[message.position].id if message.position >= 0 else ""


_WORKER_MIB = 700  # least memory per worker
_ENDED = "the scheduler has ended: restart it, and run the same command again"
_SECONDS = 30  # timeout of the connection to a scheduler, and of the wait for its first worker


@dataclass(frozen=True)
class Engine:
    """An executor of chunks."""

    executor: futures.Executor
    slots: Callable[[], int]  # Returns the number of chunks that can be drawn at the same time.
    workers: int  # Number of supervisor threads in this process; 0 on a cluster.


@contextmanager
def local(workers: int) -> Iterator[Engine]:
    """Yield an engine of `workers` threads in this process, each with its own worker process."""
    executor = futures.ThreadPoolExecutor(workers)
    try:
        yield Engine(executor, lambda: workers, workers)
    finally:
        executor.shutdown(cancel_futures=True)


@contextmanager
def dask(address: str) -> Iterator[Engine]:
    """Yield an engine on a Dask scheduler, whose workers may join and leave. Raise InputError if
    there is no scheduler or no worker, or dask.distributed is missing."""
    need = f"--scheduler {address} needs dask.distributed"
    distributed = optional("distributed", f"{need}: pip install 'facerender[batch]'")
    # This module reports Dask's errors.
    for name in [*logging.getLogger().manager.loggerDict]:
        if name.startswith("distributed"):
            logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        client = distributed.Client(address, timeout=_SECONDS)
    except (OSError, ValueError) as error:
        raise InputError(f"no scheduler at {address} ({error}); run: dask scheduler") from None

    def slots() -> int:
        try:
            return max(1, sum(map(int, client.nthreads().values())))
        except OSError:
            raise FacerenderError(_ENDED) from None

    with closing(client):
        try:
            client.wait_for_workers(1, timeout=_SECONDS)
        except TimeoutError:
            remedy = f"dask worker {address}"
            raise InputError(f"the scheduler at {address} has no worker; run: {remedy}") from None
        # With pure=True, Dask would reuse the result of a chunk whose files have been deleted.
        executor = client.get_executor(pure=False, retries=2)
        yield Engine(executor, slots, 0)


def default_workers() -> tuple[int, str]:
    """Return the default number of workers, and a text that gives the reason: one worker per core
    that this process may use, or fewer if memory is too small."""
    cores, memory = len(os.sched_getaffinity(0)), available()
    with suppress(OSError, ValueError):  # without a quota, "max" is no number
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text().split()
        cores = max(1, round(min(cores, float(quota) / float(period))))
    fit = max(1, int(memory // _WORKER_MIB))
    if fit < cores:
        return fit, f"{memory:.0f} MiB of free memory, {_WORKER_MIB} MiB per worker"
    return cores, f"one per core ({cores} cores)"


_AHEAD = 2  # queued chunks per worker
_TRIES = 3  # attempts for a chunk whose supervisor was lost


def run(work: Work, settings: Settings, engine: Engine, progress: Progress) -> int:
    """Draw the remaining chunks, and return the number of drawn jobs. Raise FacerenderError if the
    scheduler has ended, or a chunk was lost _TRIES times; other errors as in :func:`draw_chunk`."""
    drawn_count, renderers = 0, set[str]()
    waiting = work.chunks(Storage(settings.output))
    report = progress.report if engine.workers else None
    sent: dict[futures.Future[Outcome], tuple[Chunk, int]] = {}

    def send(chunk: Chunk, tries: int) -> None:
        sent[engine.executor.submit(draw_chunk, settings, chunk, report)] = chunk, tries

    while True:
        free = (1 + _AHEAD) * engine.slots() - len(sent)
        for chunk in islice(waiting, max(free, 0)):
            send(chunk, 1)
        if not sent:
            return drawn_count
        for future in futures.wait(sent, return_when=futures.FIRST_COMPLETED).done:
            chunk, tries = sent.pop(future)
            try:
                outcome = future.result()
            except FacerenderError:
                raise
            except futures.CancelledError:
                raise FacerenderError(_ENDED) from None
            except Exception as error:
                if tries >= _TRIES:
                    problem = f"chunk {chunk.number} was lost {_TRIES} times ({error!r})"
                    raise FacerenderError(f"{problem}; run the same command again") from error
                send(chunk, tries + 1)
                continue
            drawn_count += outcome.steps["done"]
            if outcome.renderer and renderers and outcome.renderer not in renderers:
                drivers = f"with {outcome.renderer}, others with {min(renderers)}"
                warn(f"{outcome.worker} draws {drivers}: pixels may differ in the last digits")
            renderers |= {outcome.renderer} - {""}
            progress.finished(outcome)
