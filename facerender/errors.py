"""The exceptions that facerender raises for causes outside its own code; each message is one line
that names the thing, the value and the remedy."""

from __future__ import annotations

import numbers
import os
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

_LONGEST = 500  # characters of a message, where what others have written makes it long
_noted: ContextVar[list[str] | None] = ContextVar("_noted", default=None)


class FacerenderError(Exception):
    """Base of all of them: what the command line reports as ``facerender: error: ...``."""


class InputError(FacerenderError, ValueError):
    """A file, a value or a combination of options that cannot be used."""

    def __init__(self, message: str) -> None:
        super().__init__(clipped(message, _LONGEST))


class ContextError(FacerenderError, RuntimeError):
    """No OpenGL context, or one that cannot do what was asked."""


class NotMeasured(FacerenderError, RuntimeError):
    """A tool that a measurement needs is missing here, or refuses to work."""


class FacerenderWarning(UserWarning):
    """Something in the input was missing or mended, and the result can still be used."""


def warn(message: str) -> None:
    """Warn of something that was missing or mended."""
    if (noted := _noted.get()) is not None:
        noted.append(message)
    warnings.warn(message, FacerenderWarning, stacklevel=3)


@contextmanager
def noting() -> Iterator[list[str]]:
    """Gather in a list what is warned of here, in this thread, to be told again another time."""
    messages: list[str] = []
    token = _noted.set(messages)
    try:
        yield messages
    finally:
        _noted.reset(token)


def clipped(text: str, most: int = 160) -> str:
    """Return a text of others on one line that can be printed, its middle left out where it is
    longer than ``most`` characters."""
    line = "".join(each if each.isprintable() else "?" for each in " ".join(text.split()))
    return line if len(line) <= most else f"{line[: most // 2]} ... {line[-(most // 2) :]}"


def shown(value: Any) -> str:
    """Return a value as a message tells it: on one line, and not at length."""
    try:
        return clipped(repr(value), 120)
    except (ValueError, RecursionError):  # Python does not print numbers of 5000 digits
        return f"a {type(value).__name__} that is too long to print"


def reason(error: Exception) -> str:
    """Return what an error of the operating system or of a library says, for the middle of a
    sentence; its kind where it says nothing."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror.lower()
    return clipped(str(error)) or type(error).__name__


def check_range(name: str, value: Any, low: float, high: float) -> None:
    """Raise InputError where a value is no number, or outside [low, high]."""
    number = isinstance(value, numbers.Real) and not isinstance(value, bool)
    if not (number and low <= value <= high):
        raise InputError(f"{name} = {shown(value)} is outside [{low:g}, {high:g}]")


def check_type(name: str, value: Any, kinds: Any, remedy: str) -> None:
    """Raise InputError where a value is of none of these types, as isinstance takes them."""
    if not isinstance(value, kinds):
        raise InputError(f"{name} = {shown(value)}: give {remedy}")


def check_switch(name: str, value: Any) -> None:
    """Raise InputError where a value is neither true nor false."""
    check_type(name, value, bool, "true or false")


def check_path(name: str, value: Any) -> None:
    """Raise InputError where a value is no path."""
    check_type(name, value, str | os.PathLike, "a path as text")


def each_of(name: str, values: Any, kind: Any, remedy: str) -> tuple[Any, ...]:
    """Return values as a tuple.

    Raises
    ------
    InputError : one of them is not of this type, as isinstance takes it
    """
    found = tuple(values) if isinstance(values, Iterable) else (values,)
    if not all(isinstance(each, kind) for each in found):
        raise InputError(f"{name} = {shown(values)}: give {remedy}")
    return found
