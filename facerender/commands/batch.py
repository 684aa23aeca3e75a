"""``facerender batch``."""

from __future__ import annotations

import argparse
import json
import os
import signal
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facerender.commands.common import add_parts, add_quiet, check_outputs
from facerender.commands.streams import print_message, print_result
from facerender.errors import InputError

if TYPE_CHECKING:
    from facerender.batch.engine import Engine
    from facerender.batch.jobs import JobTable

_FAILED = 3
_EPILOG = "exit status: 0 all jobs are drawn, 3 some failed, 2 nothing could start or go on"


def add(batch: argparse.ArgumentParser) -> None:
    batch.set_defaults(command=run)
    batch.epilog = _EPILOG
    batch.add_argument("jobs", nargs="?", metavar="JOBS", help=".jsonl .csv .parquet .toml .py")
    batch.add_argument("-o", "--output", metavar="OUT", help="a folder, or a URL such as s3://...")
    common = batch.add_argument_group("values of jobs that do not have their own")
    common.add_argument("--scene", metavar="FILE.toml", help="a scene, also of facerender plan")
    common.add_argument("--mesh", metavar="FILE", help="(the built-in head)")
    add_parts(common)
    common.add_argument("--size", help="N or WxH in pixels (1024)")
    common.add_argument("--samples", type=int, help="per pixel (4)")
    common.add_argument("--outputs", metavar="LIST", help="image,mask,depth,layers,... (image)")

    drawing = batch.add_argument_group("workers")
    drawing.add_argument(
        "--workers", type=int, metavar="N", help="processes here (by cores and memory)"
    )
    drawing.add_argument(
        "--scheduler", metavar="ADDRESS", help="of a Dask scheduler, instead of workers here"
    )
    drawing.add_argument("--backend", choices=("auto", "egl", "osmesa", "native"), default="auto")
    drawing.add_argument(
        "--timeout",
        type=float,
        default=300.0,
        help="seconds without output before a job counts as hung (300)",
    )
    drawing.add_argument(
        "--tries", type=int, default=3, help="maximum attempts per crashing or hanging job (3)"
    )
    drawing.add_argument(
        "--chunk", type=int, metavar="N", help="jobs of a chunk (1 to 128, by their number)"
    )

    written = batch.add_argument_group("output")
    written.add_argument(
        "--layout",
        choices=("files", "shards"),
        default="files",
        help="a folder per job, or a tar per chunk (files)",
    )
    written.add_argument("--table", choices=("jsonl", "parquet"), default="jsonl", help="(jsonl)")
    written.add_argument("--transforms", action="store_true", help="write transforms.json as well")
    written.add_argument("--retry-failed", action="store_true", help="draw failed jobs again")
    written.add_argument("--json", action="store_true", help="print each step as a line of JSON")
    add_quiet(written)

    ask = batch.add_argument_group("instead of drawing")
    ask.add_argument("--check", action="store_true", help="read and check all jobs")
    ask.add_argument("--status", metavar="OUT", help="count the jobs done, failed and left")
    ask.add_argument("--schema", action="store_true", help="JSON Schema of a job")


def run(options: argparse.Namespace) -> int:
    if options.schema:
        from facerender.batch.schema import schema

        print_result(json.dumps(schema(), indent=2))
        return 0
    if options.status:
        return _print_status(options.status, options.json)
    if options.jobs is None:
        raise InputError("no jobs: give a table of them, such as jobs.csv")
    _check_read(options)
    table = _table(options)
    if options.check:
        _check_faults(table.check())
        print_result(f"{options.jobs}: {table.rows} jobs of {table.meshes} meshes")
        return 0
    if options.output is None:
        raise InputError("no output: say -o FOLDER")
    for name, least in (("workers", 1), ("tries", 1), ("timeout", 1.0), ("chunk", 1)):
        value = getattr(options, name)
        if value is not None and not value >= least:
            raise InputError(f"--{name} {value}: give at least {least:g}")
    return _draw(options, table)


def _check_read(options: argparse.Namespace) -> None:
    """Raise InputError if a table of the batch would replace a file that is read."""
    if options.output is None or "://" in options.output or options.check:
        return
    from facerender.batch.folder import TABLES
    from facerender.batch.records import ABOUT

    written = (Path(options.output, name) for name in (*TABLES, ABOUT))
    read = [options.jobs, options.scene, options.mesh]
    check_outputs([path for path in written if os.path.isfile(path)], read)


def _table(options: argparse.Namespace) -> JobTable:
    """Return the table of jobs, with the values that the options give to all rows."""
    from facerender.batch.jobs import JobTable

    common = {"mesh.path": options.mesh, "outputs": options.outputs, "scene": options.scene}
    common |= {f"mesh.{name}": getattr(options, name) for name in ("parts", "hide")}
    common |= {f"image.{name}": getattr(options, name) for name in ("size", "samples")}
    return JobTable(options.jobs, common)


def _check_faults(table: JobTable) -> None:
    """Raise InputError with the faults of the first bad rows."""
    if table.faults:
        for fault in table.faults[:-1]:
            print_message(f"facerender: error: {fault}")
        more = f"; and {table.more} more rows" if table.more else ""
        raise InputError(f"{table.faults[-1]}{more}")


def _draw(options: argparse.Namespace, table: JobTable) -> int:
    from facerender.batch import coordinator, folder
    from facerender.batch.chunk import Settings, code_version
    from facerender.batch.parquet import check_parquet
    from facerender.batch.progress import Progress
    from facerender.batch.work import spooled, work_of

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
        about = {"table": options.jobs, "jobs": table.rows}
        storage = stack.enter_context(folder.locked(settings, about))
        stack.enter_context(_surviving_pipes())
        work = work_of(spool, storage, options.retry_failed)
        folder.set_aside(storage, work)
        drawn = 0
        if work.todo:
            engine = stack.enter_context(_engine(options))
            with Progress(work, engine.workers, options.json, options.quiet) as progress:
                drawn = coordinator.run(work, settings, engine, progress)
        folder.finish(storage, options.table, options.transforms)
    return _print_status(output, options.json, drawn, time.monotonic() - began)


@contextmanager
def _surviving_pipes() -> Iterator[None]:
    """Raise an error when this process writes to a worker or a scheduler that has ended: the
    command line's handler of SIGPIPE would end it with status 141."""
    before = signal.signal(signal.SIGPIPE, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGPIPE, before)


def _engine(options: argparse.Namespace) -> AbstractContextManager[Engine]:
    from facerender.batch import engine

    if options.scheduler is not None:
        return engine.dask(options.scheduler)
    if options.workers is not None:
        return engine.local(options.workers)
    workers, why = engine.default_workers()
    if not options.quiet:
        print_message(f"facerender: {workers} worker{'s' if workers > 1 else ''}: {why}")
    return engine.local(workers)


def _print_status(
    output: str, as_json: bool, drawn: int | None = None, seconds: float = 0.0
) -> int:
    """Print the status of a batch, and return the exit status."""
    from facerender.batch.folder import status

    counts = status(output)
    facts: dict[str, Any] = {"output": output, **counts}
    text = f"{output}: {counts['done']} of {counts['jobs']} jobs are done, {counts['failed']} have"
    text += f" failed, {counts['left']} are left" if counts["left"] else " failed"
    if drawn is not None:
        facts |= {"drawn": drawn, "seconds": round(seconds, 3)}
        text += f"; {drawn} drawn now, {drawn / seconds:.1f} a second"
    print_result(json.dumps({"event": "end", **facts}) if as_json else text)
    return _FAILED if counts["failed"] else 0
