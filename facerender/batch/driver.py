"""Sends every chunk without a record to an engine, a few for each worker at a time, and gathers
what became of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from itertools import islice
from typing import TypeVar

from facerender.batch.chunk import Chunk, Settings, chunks
from facerender.batch.engine import Engine, scheduler_gone
from facerender.batch.jobs import Row
from facerender.batch.place import Place
from facerender.batch.progress import Progress
from facerender.batch.supervisor import Outcome, draw_chunk
from facerender.batch.work import Work, with_kept
from facerender.errors import FacerenderError, InputError, warn

Item = TypeVar("Item")
Result = TypeVar("Result")

_AHEAD = 2  # chunks that wait for each worker
_TRIES = 3  # of a chunk whose supervisor was lost


def run(
    rows: Iterable[Row], work: Work, settings: Settings, engine: Engine, progress: Progress
) -> int:
    """Draw the chunks that are to do, and return how many jobs were drawn.

    Parameters
    ----------
    rows : the jobs, as :func:`work_of` has seen them

    Raises
    ------
    CannotDraw : nothing can be drawn or written
    InputError : the jobs are others than they were
    FacerenderError : the scheduler is gone, or workers are lost again and again
    """
    drawn, renderers = 0, set[str]()
    waiting = with_kept(_to_do(rows, work), Place(settings.output))
    heard = progress.heard if engine.workers else None
    for _, outcome in carried(engine, draw_chunk, settings, waiting, heard):
        drawn += outcome.drawn
        _check_same(outcome, renderers)
        progress.finished(outcome)
    return drawn


def carried(
    engine: Engine,
    call: Callable[..., Result],
    settings: Settings,
    items: Iterator[Item],
    *rest: object,
) -> Iterator[tuple[Item, Result]]:
    """Have an engine call something with each item, between the settings and the rest, a few for
    each worker ahead, and yield items with their results as they come; those of a lost supervisor
    are sent again. Errors as of :func:`run`."""

    def submit(item: Item, tries: int) -> None:
        flying[engine.executor.submit(call, settings, item, *rest)] = item, tries

    flying: dict[Future[Result], tuple[Item, int]] = {}
    while True:
        room = (1 + _AHEAD) * engine.slots() - len(flying)
        for item in islice(items, max(room, 0)):
            submit(item, 1)
        if not flying:
            return
        for future in wait(flying, return_when=FIRST_COMPLETED).done:
            item, tries = flying.pop(future)
            try:
                result = future.result()
            except FacerenderError:
                raise
            except CancelledError:
                raise scheduler_gone() from None
            except Exception as error:
                if tries >= _TRIES:
                    raise FacerenderError(
                        f"{item} was lost {_TRIES} times ({error!r}); run the same command again"
                    ) from error
                submit(item, tries + 1)
                continue
            yield item, result


def _to_do(rows: Iterable[Row], work: Work) -> Iterator[Chunk]:
    """Yield the chunks that are to do; InputError where they are others than those that were."""
    count = 0
    for chunk in chunks(rows, work.size):
        if work.todo.get(chunk.number, chunk.name) != chunk.name:
            break
        if chunk.number in work.todo:
            count += 1
            yield chunk
    if count < len(work.todo):
        raise InputError(
            "the table of jobs, or a file that it names, has changed since it was read; run the "
            "same command again, or give a table that says the same each time"
        )


def _check_same(outcome: Outcome, known: set[str]) -> None:
    """Warn of a driver that is not the others'."""
    if outcome.renderer and known and outcome.renderer not in known:
        warn(
            f"{outcome.worker} draws with {outcome.renderer}, others with {min(known)}: their "
            "pixels may differ in the last digits"
        )
    known |= {outcome.renderer} - {""}
