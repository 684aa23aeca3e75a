"""How long work tells of itself: it calls a function with what it does now and the share of that
which is done. Without one nothing is said; a bar on a terminal is one."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import ExitStack
from types import TracebackType
from typing import Any

from facerender.system.signals import if_ended

Progress = Callable[[str, float], object]


def no_progress(what: str, done: float) -> None:
    """Where nobody asks."""


def shows_bars(quiet: bool) -> bool:
    """Whether bars are: on a terminal."""
    return not quiet and sys.stderr.isatty()


class Bar:
    """A bar of tqdm on standard error, of what is done now; it vanishes at the end. Where a signal
    ends the process it is said how far it has come, on a terminal or not.

    quiet : no bar
    told : is called with each step as it begins, in place of a bar
    """

    def __init__(self, quiet: bool = False, told: Callable[[str], object] | None = None) -> None:
        self._told = told
        self._shown = told is None and shows_bars(quiet)
        self._bar: Any = None
        self._done: list[str] = []
        self._what, self._share = "", 0.0
        self._held = ExitStack()

    def __enter__(self) -> Bar:
        self._held.enter_context(if_ended(self._ended))
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._held.close()
        self._close()

    def __call__(self, what: str, done: float) -> None:
        if what != self._what:
            self._begin(what)
        self._share = done
        if self._bar is not None:
            self._bar.update(done - self._bar.n)

    def _begin(self, what: str) -> None:
        if self._what:
            self._done.append(self._what)
        self._what = what
        self._close()
        if self._told:
            self._told(what)
        if self._shown:
            from tqdm import tqdm

            form = "{desc} {percentage:3.0f}%|{bar:24}| {elapsed}<{remaining}"
            self._bar = tqdm(desc=what, total=1.0, bar_format=form, leave=False)

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.close()

    def _ended(self) -> str:
        self._close()
        if not self._what:
            return "before it began"
        now = f"{100.0 * self._share:.0f} % of {self._what}"
        return f"done: {', '.join([*self._done, now])}"
