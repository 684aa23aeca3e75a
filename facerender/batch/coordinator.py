"""The coordinator of a batch, which submits chunks to an engine and collects their outcomes."""

from __future__ import annotations

from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from itertools import islice

from facerender.batch.chunk import Chunk, Settings
from facerender.batch.engine import Engine, scheduler_gone
from facerender.batch.progress import Progress
from facerender.batch.storage import Storage
from facerender.batch.supervisor import Outcome, draw_chunk
from facerender.batch.work import Work, with_kept
from facerender.errors import FacerenderError, warn

_AHEAD = 2  # queued chunks per worker
_TRIES = 3  # attempts for a chunk whose supervisor was lost


def run(work: Work, settings: Settings, engine: Engine, progress: Progress) -> int:
    """Draw the remaining chunks, and return the number of drawn jobs.

    Raises
    ------
    CannotDraw : nothing can be drawn or written
    FacerenderError : the scheduler has ended, or a chunk was lost _TRIES times
    """
    drawn, renderers = 0, set[str]()
    waiting = with_kept(work, Storage(settings.output))
    report = progress.report if engine.workers else None
    sent: dict[Future[Outcome], tuple[Chunk, int]] = {}

    def send(chunk: Chunk, tries: int) -> None:
        sent[engine.executor.submit(draw_chunk, settings, chunk, report)] = chunk, tries

    while True:
        free = (1 + _AHEAD) * engine.slots() - len(sent)
        for chunk in islice(waiting, max(free, 0)):
            send(chunk, 1)
        if not sent:
            return drawn
        for future in wait(sent, return_when=FIRST_COMPLETED).done:
            chunk, tries = sent.pop(future)
            try:
                outcome = future.result()
            except FacerenderError:
                raise
            except CancelledError:
                raise scheduler_gone() from None
            except Exception as error:
                if tries >= _TRIES:
                    raise FacerenderError(
                        f"{chunk} was lost {_TRIES} times ({error!r}); run the same command again"
                    ) from error
                send(chunk, tries + 1)
                continue
            drawn += outcome.drawn
            if outcome.renderer and renderers and outcome.renderer not in renderers:
                warn(
                    f"{outcome.worker} draws with {outcome.renderer}, others with "
                    f"{min(renderers)}: pixels may differ in the last digits"
                )
            renderers |= {outcome.renderer} - {""}
            progress.finished(outcome)
