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

from facerender.commands import options as common
from facerender.commands.options import PARTS, add_options
from facerender.commands.output import print_message, print_result
from facerender.commands.scene import part_materials, values_of
from facerender.errors import InputError
from facerender.loading import MeshFile
from facerender.scene.job import ImageSettings
from facerender.scene.scene import ONLY
from facerender.values.fields import IntegerRange, Range, build

if TYPE_CHECKING:
    from facerender.batch.jobs import JobTable
    from facerender.batch.supervisor import Engine

_FAILED = 3
_MAX_FILES = 100  # maximum number of invalid input files that --check names
_TIMEOUT, _TRIES = 300.0, 3
_BACKENDS = ("auto", "egl", "osmesa", "native")
_BACKEND_NOTE = common.BACKEND["note"].partition(". current")[0]
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
    changes: dict[str, Any] = {name: {"limits": limits} for name, limits in _LIMITS.items()}
    changes["timeout"]["default"], changes["tries"]["default"] = _TIMEOUT, _TRIES
    for name, *choices in (("layout", "files", "shards"), ("table", "jsonl", "parquet")):
        changes[name] = {"choices": choices, "default": choices[0]}
    add_options(
        batch,
        _OPTIONS,
        **changes,
        jobs={"nargs": "?"},
        part=common.SCENE_CHANGES["part"],
        size={"unset": common.SIDE},
        samples={"note": ""},
        backend=common.BACKEND | {"choices": _BACKENDS, "note": _BACKEND_NOTE},
    )


_OPTIONS = f"""
JOBS | table of jobs: .jsonl, .csv, .parquet, .toml or .py | required to draw or check
-o --output OUT | output folder, or a URL such as s3://bucket/heads | required to draw
[values for jobs that do not set them]
--scene FILE.toml | scene file, for example of facerender plan | none
--mesh FILE | mesh file | the built-in head
{PARTS} size samples
--outputs LIST | outputs of each job, separated by commas | image
    | Give some of image, {", ".join(ONLY)}, layers
[workers]
--workers N | worker processes on this machine | depends on cores and free memory
--scheduler ADDRESS | address of a Dask scheduler, whose workers draw | none
    | Requires pip install 'facerender[batch]'
backend
--timeout SECONDS | time without output before a job counts as hung | {_TIMEOUT:g}
--tries N | maximum attempts per crashing or hanging job | {_TRIES}
--chunk N | jobs per chunk | 1 to 128, in shards 32 to 128, depends on the number of jobs
[output]
--layout | a folder per job, or a tar file per chunk | files
--table | format of the table of drawn jobs | jsonl
--transforms | also write the cameras as transforms.json for nerfstudio
--retry-failed | also redraw jobs that failed in an earlier run
--prune | delete the files of drawn jobs that the table lacks
--json | print a line of JSON per chunk, per failed job and at the end
anonymous id quiet
[instead of drawing]
--check | check all rows of the table, and read each of their files once
--status OUT | count the drawn, failed and remaining jobs of the batch in this folder or URL | none
"""


def run(options: argparse.Namespace) -> int:
    if options.status:
        return _print_status(options.status, options.json)
    if options.jobs is None:
        raise InputError("no jobs: give a table of jobs, such as jobs.csv")
    table = _table(options)
    if options.check:
        from facerender.batch.outputs import file_faults

        _check_faults(table, file_faults(table.valid()))
        name = options.anonymous or options.jobs
        print_result(f"{name}: {table.rows} jobs of {table.meshes} meshes")
        return 0
    if options.output is None:
        raise InputError("no output: add -o FOLDER")
    for name, limits in _LIMITS.items():
        value = getattr(options, name)
        if value is not None and value not in limits:
            raise InputError(f"--{name} {value}: give {limits}")
    return _draw(options, table)


def _table(options: argparse.Namespace) -> JobTable:
    """Return the table of jobs. The values of the options are defaults of the rows. Raise
    InputError if a result table of the batch would replace an input file."""
    from facerender.batch.jobs import JobTable
    from facerender.batch.records import ABOUT, TABLES

    if options.output is not None and "://" not in options.output and not options.check:
        written = (Path(options.output, name) for name in (*TABLES, ABOUT))
        read = [options.jobs, options.scene, options.mesh]
        common.check_outputs([path for path in written if os.path.isfile(path)], read)
    defaults = {"mesh.path": options.mesh, "outputs": options.outputs, "scene": options.scene}
    names = ("parts", "hide", "as_is", "double_sided", "up", "rotate")
    mesh, image = values_of(options, *names), values_of(options, "size", "samples")
    # Bad options end the command before the table is read.
    build(MeshFile, mesh, "mesh")
    build(ImageSettings, image, "image")
    defaults |= {f"mesh.{name}": value for name, value in mesh.items()}
    defaults |= {f"image.{name}": value for name, value in image.items()}
    defaults |= {"parts": part_materials(options) or None, "anonymous": options.anonymous or None}
    return JobTable(options.jobs, defaults)


def _check_faults(table: JobTable, files: Sequence[str] = ()) -> None:
    """If rows or input files are invalid, print their errors, but raise the last as InputError."""
    if faults := [*table.faults, *files[:_MAX_FILES]]:
        for fault in faults[:-1]:
            print_message(f"facerender: error: {fault}")
        remainder = f"; and {table.more} more rows" if table.more else ""
        if (more := len(files) - _MAX_FILES) > 0:
            remainder += f"; and {more} more files"
        raise InputError(f"{faults[-1]}{remainder}")


def _draw(options: argparse.Namespace, table: JobTable) -> int:
    from facerender.batch import records, supervisor
    from facerender.batch.jobs import Settings, code_version
    from facerender.batch.supervisor import NAMED, Progress, failed_line
    from facerender.batch.tables import check_parquet

    if options.table == "parquet":
        check_parquet()
    output = options.output if "://" in options.output else os.path.abspath(options.output)
    settings = Settings(
        output, options.layout, options.backend, options.timeout, options.tries, code_version()
    )
    began = time.monotonic()
    with ExitStack() as stack:
        work = stack.enter_context(records.spooled(table, settings, options.chunk))
        _check_faults(table)
        storage = stack.enter_context(records.locked(output))
        name = options.anonymous or options.jobs
        records.start(work, storage, settings, name, options.prune, options.retry_failed)
        # An ended worker or scheduler must raise an error: the handler of SIGPIPE ends the process.
        handler = signal.signal(signal.SIGPIPE, signal.SIG_IGN)
        stack.callback(signal.signal, signal.SIGPIPE, handler)
        drawn = named = deaths = 0
        if work.todo:
            engine = stack.enter_context(_engine(options))
            with Progress(work, engine.workers, options.json, print_message, options.quiet) as bars:
                drawn = supervisor.run(work, settings, engine, bars)
            named, deaths = bars.failed, bars.deaths
        records.finish(storage, options.table, options.transforms)
        if not options.json:
            # The run itself has printed the first failed jobs and the first deaths, if any.
            for record in islice(records.failures(storage), 0 if named else NAMED):
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


def _print_status(output: str, as_json: bool, drawn: int | None = None, took: float = 0.0) -> int:
    """Print the number of done, failed and remaining jobs, and return the exit status."""
    from facerender.batch.records import FAILED, status

    counts = status(output)
    done, failed, left = counts["done"], counts["failed"], counts["left"]
    result: dict[str, Any] = {"output": output, **counts}
    text = f"{output}: {done} of {counts['jobs']} jobs are done, {failed} failed"
    if failed and not left:
        text += f" ({output}/{FAILED} has the reasons)"
    text += f", {left} remain" if left else ""
    if drawn is not None:
        result |= {"drawn": drawn, "seconds": round(took, 3)}
        text += f"; this run drew {drawn}, {drawn / took:.1f} per second"
    print_result(json.dumps({"event": "end", **result}) if as_json else text)
    return _FAILED if failed else 0
