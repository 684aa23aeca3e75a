"""How long work tells of itself: it calls a function with what it does now and the share of that
which is done. Without one nothing is said; a bar on a terminal is one."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import ExitStack
from types import TracebackType
from typing import Any

from facerender.ending import if_ended

Progress = Callable[[str, float], object]


def unheard(what: str, done: float) -> None:
    """Where nobody asks."""


def shown(quiet: bool) -> bool:
    """Whether bars are: on a terminal."""
    return not quiet and sys.stderr.isatty()


class Bar:
    """A bar of tqdm on standard error, of what is done now; it vanishes at the end. Where a signal
    ends the process it is said how far it has come, on a terminal or not.

    quiet : no bar
    """

    def __init__(self, quiet: bool = False) -> None:
        self._bar: Any = None
        if shown(quiet):
            from tqdm import tqdm

            form = "{desc} {percentage:3.0f}%|{bar:24}| {elapsed}<{remaining}"
            self._bar = tqdm(total=1.0, bar_format=form, leave=False, dynamic_ncols=True)
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
        if self._bar is not None:
            self._bar.close()

    def __call__(self, what: str, done: float) -> None:
        begins = what != self._what
        if begins and self._what:
            self._done.append(self._what)
        self._what, self._share = what, done
        if self._bar is not None:
            if begins:
                self._bar.reset()
                self._bar.set_description_str(what, refresh=False)
            self._bar.update(done - self._bar.n)
            if begins:
                self._bar.refresh()

    def _ended(self) -> str:
        if self._bar is not None:
            self._bar.close()
        if not self._what:
            return "before it began"
        now = f"{100.0 * self._share:.0f} % of {self._what}"
        return f"done: {', '.join([*self._done, now])}"
