"""Progress of a batch: bars on standard error, JSON lines on standard output."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

from tqdm import tqdm

from facerender.batch.chunk import Record
from facerender.batch.supervisor import Outcome
from facerender.batch.work import Work
from facerender.errors import clipped
from facerender.system.progress import shows_bars
from facerender.system.signals import if_ended

NAMED = 5  # maximum number of failed jobs, and of workers that ended, that are named


def failed_line(record: Record) -> str:
    """Return a message that names a failed job and the reason."""
    return f"facerender: job {record['id']} failed: {clipped(record['error'], 400)}"


class Progress(ExitStack):
    """Progress bars on a terminal, names of failed jobs and ended workers, or JSON lines.

    The bars show jobs done, rate, time left and failures, and the current step of each worker. If
    a signal ends the process, the number of finished jobs is printed. `failed` and `deaths` are the
    numbers of failed jobs, and of workers that ended or hung.

    Parameters
    ----------
    workers : number of local workers, which report every step; 0 for a cluster
    lines : whether to print a JSON line for each chunk, failed job and ended worker. Otherwise,
        the first NAMED failed jobs and ended workers are messages
    message : prints a message on standard error
    quiet : whether to hide the bars
    """

    def __init__(
        self,
        work: Work,
        workers: int,
        lines: bool,
        message: Callable[[str], None],
        quiet: bool = False,
    ) -> None:
        super().__init__()
        terminal = shows_bars(quiet)
        self._bar = tqdm(
            total=work.jobs,
            initial=work.jobs - work.left,
            unit=" jobs",
            mininterval=0.2,
            disable=not terminal,
            smoothing=0.05,
        )
        positions = range(1, 1 + workers) if terminal else ()
        self._free = [
            tqdm(bar_format="{desc}", position=position, leave=False) for position in positions
        ]
        for bar in (self._bar, *self._free):
            self.callback(bar.close)
        self._of: dict[int, tqdm[Any]] = {}  # keyed by the supervisor's thread ID
        self._workers, self._lines = workers, lines
        self._message = None if lines else message
        self.failed = self.deaths = 0
        self._jobs, self._done = work.jobs, work.jobs - work.left
        self.enter_context(if_ended(self._ended))

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
        jobs = outcome.drawn + outcome.kept + len(outcome.failed)
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
        self.say(
            "chunk",
            chunk=outcome.chunk,
            drawn=outcome.drawn,
            kept=outcome.kept,
            failed=len(outcome.failed),
            seconds=round(outcome.seconds, 3),
            deaths=len(outcome.deaths),
            worker=outcome.worker,
        )

    def say(self, event: str, **facts: Any) -> None:
        """Print a JSON line if `lines` is set."""
        if not self._lines:
            return
        try:
            print(json.dumps({"time": round(time.time(), 3), "event": event, **facts}), flush=True)
        except OSError:  # the reader has closed the pipe, or the disk is full
            self._lines = False

    def _ended(self) -> str:
        return f"{self._done} of {self._jobs} jobs are done; run the same command to resume"
