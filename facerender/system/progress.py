"""Progress of long operations. An operation calls a function with the name of the current step and
the completed fraction of this step."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

from facerender.system.signals import if_ended

Progress = Callable[[str, float], object]


def no_progress(what: str, done: float) -> None:
    """Ignore progress; used if the caller gives no progress function."""


def shows_bars(quiet: bool) -> bool:
    """Return whether progress bars are shown: on a terminal, unless ``quiet``."""
    return not quiet and sys.stderr.isatty()


class Bar(ExitStack):
    """A tqdm bar on standard error that shows the current step and disappears at the end. If a
    signal ends the process, a line reports the progress, also without a terminal.

    quiet : whether to hide the bar
    on_step : function called with the name of each step when it starts; replaces the bar
    """

    def __init__(self, quiet: bool = False, on_step: Callable[[str], object] | None = None) -> None:
        super().__init__()
        self._on_step = on_step
        self._shown = on_step is None and shows_bars(quiet)
        self._bar: Any = None
        self._steps: list[str] = []
        self._fraction = 0.0
        self.enter_context(if_ended(self._ended))
        self.callback(self._close)

    def __call__(self, step: str, fraction: float) -> None:
        if self._steps[-1:] != [step]:
            self._begin(step)
        self._fraction = fraction
        if self._bar is not None:
            self._bar.update(fraction - self._bar.n)

    def _begin(self, step: str) -> None:
        self._steps.append(step)
        self._close()
        if self._on_step:
            self._on_step(step)
        if self._shown:
            from tqdm import tqdm

            form = "{desc} {percentage:3.0f}%|{bar:24}| {elapsed}<{remaining}"
            self._bar = tqdm(desc=step, total=1.0, bar_format=form, leave=False)

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.close()

    def _ended(self) -> str:
        self._close()
        if not self._steps:
            return "before the first step"
        *done, step = self._steps
        return f"done: {', '.join([*done, f'{100.0 * self._fraction:.0f} % of {step}'])}"
