"""``facerender batch``."""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager, ExitStack
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facerender.commands.common import SIDE, Options, check_outputs, part_materials
from facerender.commands.output import Help, print_message, print_result
from facerender.errors import InputError
from facerender.scene.file import ImageSettings
from facerender.scene.scene import ONLY
from facerender.values.ranges import IntegerRange, Range

if TYPE_CHECKING:
    from facerender.batch.jobs import JobTable
    from facerender.batch.supervisor import Engine

_FAILED = 3
_MOST_FILES = 100  # maximum number of invalid input files that --check names
_TIMEOUT, _TRIES = 300.0, 3
_LIMITS = {
    "workers": IntegerRange(1, math.inf),
    "tries": IntegerRange(1, math.inf),
    "timeout": Range(1.0, math.inf, "s"),
    "chunk": IntegerRange(1, math.inf),
}


def add(batch: argparse.ArgumentParser) -> None:
    batch.set_defaults(command=run)
    batch.description = (
        "Render every job of a table on all cores of this machine or on a Dask cluster.\n"
        "The same command resumes an interrupted batch, and redraws changed jobs. Exit\n"
        "status: 0 all jobs are drawn, 3 some failed, 2 the batch cannot start or continue."
    )
    kinds = "table of jobs: .jsonl, .csv, .parquet, .toml or .py"
    table = Help(kinds, "required to draw or check")
    batch.add_argument("jobs", nargs="?", metavar="JOBS", help=table)
    output = "output folder, or a URL such as s3://bucket/heads"
    Options(batch).add_option("-o --output OUT", output, "required to draw")
    jobs = Options(batch, "values for jobs that do not set them")
    jobs.add_option("--scene FILE.toml", "scene file, for example of facerender plan", "none")
    jobs.add_option("--mesh FILE", "mesh file", "the built-in head")
    jobs.add_parts()
    jobs.add_size(SIDE)
    jobs.add_field(ImageSettings, "samples N", "samples per pixel")
    note = f"Give some of image, {', '.join(ONLY)}, layers"
    jobs.add_option("--outputs LIST", "outputs of each job, separated by commas", "image", note)

    drawing = Options(batch, "workers")

    def add_limited(name: str, text: str, without: str, **keywords: Any) -> None:
        drawing.add_number(name, text, _LIMITS[name.split()[0]], without, **keywords)

    add_limited("workers N", "worker processes on this machine", "depends on cores and free memory")
    note = "Requires pip install 'facerender[batch]'"
    scheduler = "address of a Dask scheduler, whose workers draw"
    drawing.add_option("--scheduler ADDRESS", scheduler, "none", note)
    drawing.add_backend(("auto", "egl", "osmesa", "native"))
    silence = "time without output before a job counts as hung"
    add_limited("timeout SECONDS", silence, f"{_TIMEOUT:g}", default=_TIMEOUT)
    attempts = "maximum attempts per crashing or hanging job"
    add_limited("tries N", attempts, f"{_TRIES}", default=_TRIES)
    sizes = "1 to 128, in shards 32 to 128, depends on the number of jobs"
    add_limited("chunk N", "jobs per chunk", sizes)

    written = Options(batch, "output")

    def add_choice(name: str, text: str, *choices: str) -> None:
        written.add_option(f"--{name}", text, choices[0], choices=choices, default=choices[0])

    add_choice("layout", "a folder per job, or a tar file per chunk", "files", "shards")
    add_choice("table", "format of the table of drawn jobs", "jsonl", "parquet")
    written.add_flag("transforms", "also write the cameras as transforms.json for nerfstudio")
    written.add_flag("retry-failed", "also redraw jobs that failed in an earlier run")
    written.add_flag("prune", "delete the files of drawn jobs that the table lacks")
    written.add_flag("json", "print a line of JSON per chunk, per failed job and at the end")
    written.add_quiet()

    ask = Options(batch, "instead of drawing")
    ask.add_flag("check", "check all rows of the table, and read each of their files once")
    counts = "count the drawn, failed and remaining jobs of the batch in this folder or URL"
    ask.add_option("--status OUT", counts, "none")


def run(options: argparse.Namespace) -> int:
    if options.status:
        return _print_status(options.status, options.json)
    if options.jobs is None:
        raise InputError("no jobs: give a table of jobs, such as jobs.csv")
    _check_read(options)
    table = _table(options)
    if options.check:
        from facerender.batch.outputs import file_faults

        _check_faults(table, file_faults(table.valid()))
        print_result(f"{options.jobs}: {table.rows} jobs of {table.meshes} meshes")
        return 0
    if options.output is None:
        raise InputError("no output: add -o FOLDER")
    for name, limits in _LIMITS.items():
        value = getattr(options, name)
        if value is not None and value not in limits:
            raise InputError(f"--{name} {value}: give {limits}")
    return _draw(options, table)


def _check_read(options: argparse.Namespace) -> None:
    """Raise InputError if a result table of the batch would replace an input file."""
    if options.output is None or "://" in options.output or options.check:
        return
    from facerender.batch.folder import TABLES
    from facerender.batch.records import ABOUT

    written = (Path(options.output, name) for name in (*TABLES, ABOUT))
    read = [options.jobs, options.scene, options.mesh]
    check_outputs([path for path in written if os.path.isfile(path)], read)


def _table(options: argparse.Namespace) -> JobTable:
    """Return the table of jobs. The values of the options are defaults of the rows."""
    from facerender.batch.jobs import JobTable

    defaults = {"mesh.path": options.mesh, "outputs": options.outputs, "scene": options.scene}
    names = ("parts", "hide", "as_is", "double_sided", "up", "rotate")
    defaults |= {f"mesh.{name}": getattr(options, name) or None for name in names}
    defaults |= {"parts": part_materials(options) or None}
    defaults |= {f"image.{name}": getattr(options, name) for name in ("size", "samples")}
    return JobTable(options.jobs, defaults)


def _check_faults(table: JobTable, files: Sequence[str] = ()) -> None:
    """If rows or files are invalid, print the errors, but raise the last one as InputError.

    files : errors of input files
    """
    if faults := [*table.faults, *files[:_MOST_FILES]]:
        for fault in faults[:-1]:
            print_message(f"facerender: error: {fault}")
        remainder = f"; and {table.more} more rows" if table.more else ""
        if (more := len(files) - _MOST_FILES) > 0:
            remainder += f"; and {more} more files"
        raise InputError(f"{faults[-1]}{remainder}")


def _draw(options: argparse.Namespace, table: JobTable) -> int:
    from facerender.batch import folder, supervisor
    from facerender.batch.folder import check_removed, spooled, work_of
    from facerender.batch.formats import check_parquet
    from facerender.batch.records import Settings, code_version
    from facerender.batch.supervisor import NAMED, Progress, failed_line

    if options.table == "parquet":
        check_parquet()
    output = options.output if "://" in options.output else os.path.abspath(options.output)
    settings = Settings(
        output, options.layout, options.backend, options.timeout, options.tries, code_version()
    )
    began = time.monotonic()
    with ExitStack() as stack:
        spool = stack.enter_context(spooled(table, settings, options.chunk))
        _check_faults(table)
        storage = stack.enter_context(folder.locked(output))
        if not options.prune:
            check_removed(spool, storage, options.jobs)
        folder.start(storage, settings, {"table": options.jobs, "jobs": table.rows})
        # An ended worker or scheduler must raise an error: the handler of SIGPIPE ends the process.
        handler = signal.signal(signal.SIGPIPE, signal.SIG_IGN)
        stack.callback(signal.signal, signal.SIGPIPE, handler)
        work = work_of(spool, storage, options.retry_failed)
        folder.set_aside(storage, work)
        drawn = named = deaths = 0
        if work.todo:
            engine = stack.enter_context(_engine(options))
            with Progress(
                work, engine.workers, options.json, print_message, options.quiet
            ) as progress:
                drawn = supervisor.run(work, settings, engine, progress)
            named, deaths = progress.failed, progress.deaths
        folder.finish(storage, options.table, options.transforms)
        if not options.json:
            # The run itself has printed the first failed jobs and the first deaths, if any.
            for record in islice(folder.failures(storage), 0 if named else NAMED):
                print_message(failed_line(record))
            if deaths > NAMED:
                print_message(f"facerender: {deaths} workers ended or hung")
    return _print_status(output, options.json, drawn, time.monotonic() - began)


def _engine(options: argparse.Namespace) -> AbstractContextManager[Engine]:
    from facerender.batch import supervisor

    if options.scheduler is not None:
        return supervisor.dask(options.scheduler)
    if options.workers is not None:
        return supervisor.local(options.workers)
    workers, why = supervisor.default_workers()
    if not options.quiet:
        print_message(f"facerender: {workers} worker{'s' if workers > 1 else ''}: {why}")
    return supervisor.local(workers)


def _print_status(
    output: str, as_json: bool, drawn: int | None = None, seconds: float = 0.0
) -> int:
    """Print the number of done, failed and remaining jobs, and return the exit status."""
    from facerender.batch.folder import FAILED, status

    counts = status(output)
    facts: dict[str, Any] = {"output": output, **counts}
    text = "{}: {done} of {jobs} jobs are done, {failed} failed".format(output, **counts)
    if counts["failed"] and not counts["left"]:
        text += f" ({output}/{FAILED} has the reasons)"
    text += f", {counts['left']} remain" if counts["left"] else ""
    if drawn is not None:
        facts |= {"drawn": drawn, "seconds": round(seconds, 3)}
        text += f"; this run drew {drawn}, {drawn / seconds:.1f} per second"
    print_result(json.dumps({"event": "end", **facts}) if as_json else text)
    return _FAILED if counts["failed"] else 0
