"""Exceptions and warnings of facerender for causes outside its code, and checks of values. Each
message is one line that names the thing, the value and the remedy."""

from __future__ import annotations

import numbers
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

_LONGEST = 500  # maximum characters of a message, which may quote long texts
_noted: ContextVar[list[str] | None] = ContextVar("_noted", default=None)


class FacerenderError(Exception):
    """Base class of facerender's errors; the command prints them as ``facerender: error: ...``."""


class InputError(FacerenderError, ValueError):
    """An invalid file, value or combination of options."""

    def __init__(self, message: str) -> None:
        super().__init__(clipped(message, _LONGEST))


class ContextError(FacerenderError, RuntimeError):
    """There is no OpenGL context, or the context lacks a required feature."""


class NotMeasured(FacerenderError, RuntimeError):
    """A tool that a measurement requires is missing or fails."""


class FacerenderWarning(UserWarning):
    """A part of the input was missing or repaired; the result can still be used."""


def warn(message: str) -> None:
    """Warn of missing or repaired input."""
    note(message)
    warnings.warn(message, FacerenderWarning, stacklevel=3)


def note(message: str) -> None:
    """Record a message for :func:`noting` without a warning, because the warning was emitted
    before."""
    if (noted := _noted.get()) is not None:
        noted.append(message)


@contextmanager
def noting() -> Iterator[list[str]]:
    """Record the warnings of this thread in a list, so that the caller can repeat them later."""
    messages: list[str] = []
    token = _noted.set(messages)
    try:
        yield messages
    finally:
        _noted.reset(token)
        if (outer := _noted.get()) is not None:
            outer += messages


def clipped(text: str, most: int = 160) -> str:
    """Return a text as one printable line; text beyond ``most`` characters is cut in the middle."""
    line = "".join(char if char.isprintable() else "?" for char in " ".join(text.split()))
    return line if len(line) <= most else f"{line[: most // 2]} ... {line[-(most // 2) :]}"


def number_of(count: int, noun: str) -> str:
    """Return a count with its noun, such as "1 image" or "2 images"."""
    return f"{count} {noun}{'s' * (count != 1)}"


def withheld(count: int, noun: str) -> str:
    """Return the text that stands for a number of messages of an anonymous run."""
    subject = f"{number_of(count, noun)} may contain names"
    return f"{subject}: run without --anonymous to read {'it' if count == 1 else 'them'}"


def quoted(value: Any) -> str:
    """Return the repr of a value for a message: one line of limited length."""
    try:
        return clipped(repr(value), 120)
    except (ValueError, RecursionError):  # Python refuses to print integers of 5000 digits
        return f"a {type(value).__name__} that is too long to print"


def reason(error: Exception) -> str:
    """Return the message of a system or library error, to be used within a sentence. Return the
    type of the error if the message is empty."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror.lower()
    return clipped(str(error)) or type(error).__name__


def closest_name(name: str, known: Iterable[str]) -> str:
    """Return the known name that is most similar to a name, or "" if no name is similar."""
    from difflib import get_close_matches

    return next(iter(get_close_matches(name, [*known], 1, 0.8)), "")


def is_number(value: Any) -> bool:
    """Return whether a value is a real number; true and false are not."""
    return isinstance(value, numbers.Real) and not isinstance(value, bool)


def check_range(name: str, value: Any, low: float, high: float) -> None:
    """Raise InputError unless a value is a number in [low, high]."""
    limits = f"[{low:g}, {high:g}]"
    if not is_number(value):
        raise InputError(f"{name} = {quoted(value)} is not a number: give a number in {limits}")
    if not low <= value <= high:
        raise InputError(
            f"{name} = {quoted(value)} is outside {limits}: give a value in this range"
        )


def check_known(noun: str, value: Any, known: Iterable[str]) -> None:
    """Raise InputError unless a value is one of the known names; ``noun`` names the value."""
    names = [*known]
    if not isinstance(value, str) or value not in names:
        raise InputError(f"unknown {noun} {quoted(value)}; known: {', '.join(names)}")
