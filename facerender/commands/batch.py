"""``facerender batch``."""

from __future__ import annotations

import argparse
import json
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facerender.commands.common import add_parts, add_quiet, check_outputs
from facerender.commands.streams import say, tell
from facerender.errors import InputError

if TYPE_CHECKING:
    from facerender.batch.chunk import Settings
    from facerender.batch.engine import Engine
    from facerender.batch.jobs import Row
    from facerender.batch.place import Place
    from facerender.batch.plans import Plans

_FAILED = 3
_EPILOG = "exit status: 0 all jobs are drawn, 3 some failed, 2 nothing could start or go on"


def add(batch: argparse.ArgumentParser) -> None:
    batch.set_defaults(command=run)
    batch.epilog = _EPILOG
    batch.add_argument("jobs", nargs="?", metavar="JOBS", help=".jsonl .csv .parquet .toml .py")
    batch.add_argument("-o", "--output", metavar="OUT", help="a folder, or a URL such as s3://...")
    common = batch.add_argument_group("what jobs have that do not say otherwise")
    common.add_argument("--scene", metavar="FILE.toml", help="tables of a job")
    common.add_argument("--mesh", metavar="FILE", help="(the built-in head)")
    add_parts(common)
    common.add_argument("--size", help="N or WxH in pixels (1024)")
    common.add_argument("--samples", type=int, help="per pixel (4)")
    common.add_argument("--passes", metavar="LIST", help="image,mask,depth,layers,... (image)")

    planned = batch.add_argument_group("plans")
    planned.add_argument(
        "--budget",
        metavar="ERROR",
        help="of image.png: plan once for jobs that differ in their cameras, within 1/255, 0.5%% "
        "or '0.02 flip'",
    )
    planned.add_argument(
        "--within", metavar="SHARE", help="of the pixels: where --budget must hold (100%%)"
    )

    drawing = batch.add_argument_group("workers")
    drawing.add_argument("--workers", type=int, metavar="N", help="processes here (those that pay)")
    drawing.add_argument("--scheduler", metavar="ADDRESS", help="of Dask, in place of workers here")
    drawing.add_argument("--backend", choices=("auto", "egl", "osmesa", "native"), default="auto")
    drawing.add_argument(
        "--timeout", type=float, default=300.0, help="seconds of silence: a job hangs (300)"
    )
    drawing.add_argument(
        "--tries", type=int, default=3, help="of a job that ends or hangs its worker (3)"
    )
    drawing.add_argument("--chunk", type=int, metavar="N", help="jobs that are done together")

    written = batch.add_argument_group("output")
    written.add_argument(
        "--layout", choices=("files", "shards"), default="files", help="a folder a job, or tars"
    )
    written.add_argument("--table", choices=("jsonl", "parquet"), default="jsonl", help="(jsonl)")
    written.add_argument("--transforms", action="store_true", help="write transforms.json as well")
    written.add_argument("--retry-failed", action="store_true", help="draw failed jobs again")
    written.add_argument("--json", action="store_true", help="tell each step as a line of JSON")
    add_quiet(written)

    ask = batch.add_argument_group("instead of drawing")
    ask.add_argument("--check", action="store_true", help="read and check all jobs")
    ask.add_argument("--status", metavar="OUT", help="what became of a batch so far")
    ask.add_argument("--schema", action="store_true", help="JSON Schema of a job")


def run(options: argparse.Namespace) -> int:
    if options.schema:
        from facerender.batch.schema import schema

        tell(json.dumps(schema(), indent=2))
        return 0
    if options.status:
        return _tell(options.status, options.json)
    if options.within is not None and options.budget is None:
        raise InputError(f"--within {options.within} is of a budget: say --budget ERROR")
    if options.budget is not None:
        from facerender.planning.budget import Budget

        Budget.parse(options.budget, within=options.within or 1.0)
    if options.jobs is None:
        raise InputError("no jobs: give a table of them, such as jobs.csv")
    _check_read(options)
    common = _common(options)
    jobs = _checked(options, common)
    if options.check:
        return 0
    if options.output is None:
        raise InputError("no output: say -o FOLDER")
    return _draw(options, common, jobs)


def _check_read(options: argparse.Namespace) -> None:
    """A table that is read is not replaced by one of the batch."""
    if options.output is None or "://" in options.output or options.check:
        return
    from facerender.batch.folder import TABLES
    from facerender.batch.output import ABOUT

    written = (Path(options.output, name) for name in (*TABLES, ABOUT))
    read = [options.jobs, options.scene, options.mesh]
    check_outputs([path for path in written if os.path.isfile(path)], read)


def _draw(options: argparse.Namespace, common: dict[str, Any], jobs: int) -> int:
    from facerender.batch import driver, folder
    from facerender.batch.chunk import Settings, painter
    from facerender.batch.jobs import read_jobs
    from facerender.batch.parquet import check_parquet
    from facerender.batch.progress import Progress
    from facerender.batch.work import work_of

    for name, least in (("workers", 1), ("tries", 1), ("timeout", 1.0), ("chunk", 1)):
        value = getattr(options, name)
        if value is not None and not value >= least:
            raise InputError(f"--{name} {value}: give at least {least:g}")
    if options.table == "parquet":
        check_parquet()
    output = options.output if "://" in options.output else os.path.abspath(options.output)
    settings = Settings(
        output, options.layout, options.backend, options.timeout, options.tries, painter()
    )
    began = time.monotonic()
    about: dict[str, Any] = {"table": options.jobs, "jobs": jobs}
    read = partial(read_jobs, options.jobs, common)
    with ExitStack() as stack:
        place = stack.enter_context(folder.driving(settings, about))
        stack.enter_context(_surviving_pipes())
        engine = cache(lambda: stack.enter_context(_engine(options)))
        if options.budget is not None:
            plans = _plans(options, read, place, settings, engine)
            folder.tell(place, settings, {**about, "plans": plans.about})
            read = partial(_with_plans, read, plans)
        work = work_of(read(), jobs, settings, options.chunk, options.retry_failed)
        folder.set_aside(place, work)
        drawn = 0
        if work.todo:
            with Progress(work, engine().workers, options.json, options.quiet) as told:
                drawn = driver.run(read(), work, settings, engine(), told)
        folder.finish(place, options.table, options.transforms)
    return _tell(output, options.json, drawn, time.monotonic() - began)


def _plans(
    options: argparse.Namespace,
    read: Callable[[], Iterator[Row]],
    place: Place,
    settings: Settings,
    engine: Callable[[], Engine],
) -> Plans:
    from facerender.batch.groups import grouped
    from facerender.batch.plans import planned

    groups = grouped(read, options.budget, options.within or "100%")
    return planned(groups, place, settings, engine, options.retry_failed, _saying(options))


def _saying(options: argparse.Namespace) -> Callable[[str], None]:
    """What informs, unless nobody wants to know."""
    return (lambda text: None) if options.quiet else (lambda text: say(f"facerender: {text}"))


def _with_plans(read: Callable[[], Iterator[Row]], plans: Plans) -> Iterator[Row]:
    from facerender.batch.groups import with_plans

    return with_plans(read(), plans.of)


@contextmanager
def _surviving_pipes() -> Iterator[None]:
    """Have a worker or a scheduler that ends raise an error where it is written to, and not end
    this process as the command line has it."""
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
    workers, why = engine.workers_that_pay()
    _saying(options)(f"{workers} worker{'s' if workers > 1 else ''}: {why}")
    return engine.local(workers)


def _tell(output: str, as_json: bool, drawn: int | None = None, seconds: float = 0.0) -> int:
    """Print what became of a batch, and return its exit status."""
    from facerender.batch.folder import status

    found = status(output)
    left = found.jobs - found.done - found.failed
    facts = {"output": output, "jobs": found.jobs, "done": found.done, "failed": found.failed}
    facts |= {"left": left}
    text = f"{output}: {found.done} of {found.jobs} jobs are done, {found.failed} have failed"
    if left:
        text += f", {left} are left"
    if plans := found.about.get("plans"):
        from facerender.batch.plans import text as plans_text

        facts |= {"plans": plans}
    if drawn is not None:
        facts |= {"drawn": drawn, "seconds": round(seconds, 3)}
        text += f"; {drawn} drawn now, {drawn / seconds:.1f} a second"
    if plans:
        text += f"; {plans_text(plans)}"
    tell(json.dumps({"event": "end", **facts}) if as_json else text)
    return _FAILED if found.failed else 0


def _checked(options: argparse.Namespace, common: dict[str, Any]) -> int:
    """How many jobs there are; InputError with the faults of the first bad ones."""
    from facerender.batch.jobs import check_jobs

    checked = check_jobs(options.jobs, common)
    if checked.faults:
        for fault in checked.faults[:-1]:
            say(f"facerender: error: {fault}")
        more = f"; and {checked.more} more rows" if checked.more else ""
        raise InputError(f"{checked.faults[-1]}{more}")
    if options.check:
        tell(f"{options.jobs}: {checked.rows} jobs of {checked.meshes} meshes")
    return checked.rows


def _common(options: argparse.Namespace) -> dict[str, Any]:
    """What rows have that do not say otherwise."""
    from facerender.batch.forms import read_toml

    common = read_toml(Path(options.scene)) if options.scene else {}
    given = {"mesh.path": options.mesh, "passes": options.passes}
    given |= {f"mesh.{name}": getattr(options, name) for name in ("parts", "hide")}
    given |= {f"image.{name}": getattr(options, name) for name in ("size", "samples")}
    given = {key: value for key, value in given.items() if value is not None}
    return common | given
