"""Text of the command line: help, results and messages, also if a stream is closed, is full or
cannot encode a character.

Every run imports this module, also ``--help`` and ``--version``, so it imports little."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, suppress
from typing import Any, TextIO

from facerender.errors import FacerenderError, reason


def make_usable() -> None:
    """Open closed standard streams, so that no other file gets their descriptors (0, 1 and 2), and
    escape characters that a stream cannot encode."""
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(number, True)
    os.close(number)
    sys.stdout = sys.stdout or open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
    sys.stderr = sys.stderr or open(2, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")


def print_result(*lines: object, end: str = "\n") -> None:
    """Print results. Raise FacerenderError if standard output cannot be written."""
    with _reported():
        _print("\n".join(map(str, lines)) + end, sys.stdout)


def print_bytes(content: bytes) -> None:
    """Write bytes to standard output. For errors see :func:`print_result`."""
    with _reported():
        sys.stdout.buffer.write(content)
        sys.stdout.buffer.flush()


@contextmanager
def _reported() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        _mute(sys.stdout)
        problem = f"cannot write standard output: {reason(error)}"
        raise FacerenderError(f"{problem}; redirect it to another place") from None


@contextmanager
def silenced() -> Iterator[None]:
    """Discard standard error of this process and of new processes within the context. Unlike
    :func:`facerender.system.process.redirected_stderr`, it takes no lock: image readers need it."""
    with open(os.devnull, "w") as nothing, redirect_stderr(nothing):
        original = os.dup(2)
        os.dup2(nothing.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(original, 2)
            os.close(original)


def print_message(*lines: object) -> None:
    """Print messages on standard error, and ignore errors of this stream."""
    try:
        _print("\n".join(map(str, lines)) + "\n", sys.stderr)
    except OSError:
        _mute(sys.stderr)


def _print(text: str, stream: TextIO) -> None:
    bars: Any = sys.modules.get("tqdm")  # tqdm.write() prints without breaking progress bars
    if bars is None:
        stream.write(text)
    else:
        bars.tqdm.write(text, file=stream, end="")
    stream.flush()


def _mute(stream: TextIO) -> None:
    """Discard the buffer of a stream, so that the interpreter does not fail to flush it at exit."""
    with suppress(OSError), open(os.devnull, "wb") as nothing:
        os.dup2(nothing.fileno(), stream.fileno())


EXAMPLES = {
    "render": (
        "facerender render -o head.png",
        "facerender render scan.obj --albedo skin.jpg --camera three-quarter -o scan.png",
        "facerender render head.glb --hide '*lash*,hair' --m 0.25 --light key -o head.exr",
        "facerender render head.obj --part 'eye*=cornea' --part 'lash*,opacity=0.8' -o eyes.png",
        "facerender render --camera front --camera profile -o 'head-{name}.jpg'",
        "facerender render --camera turntable:24 --frame head -o head.gif",
        "facerender render --budget 1/255 --size 512 -o cheap.png",
    ),
    "views": (
        "facerender views scan.obj -o views",
        "facerender views before.obj after.obj --register --mm-per-pixel 0.3 -o views",
    ),
    "info": ("facerender info head.glb", "facerender info scan.obj --json"),
    "batch": (
        "facerender batch jobs.csv -o out --size 256 --outputs image,mask,depth",
        "facerender batch jobs.toml --check",
        "facerender batch --status out",
    ),
    "plan": (
        "facerender plan head.glb --budget 1/255",
        "facerender plan --budget 0.5% --within 99% --camera turntable --size 256..1024",
        "facerender plan --budget 1/255 --save-scene planned.toml --emit cheap.glsl --target 330",
    ),
    "measure": ("facerender measure --quick", "facerender measure head.glb --m 0.25 -o out/head"),
    "compare": (
        "facerender compare golden.exr new.exr",
        "facerender compare goldens out --report report.html",
        "facerender compare --calibrate runs -o limits.toml",
    ),
    "explore": ("facerender explore head.glb -o head.html",),
    "shaders": (
        "facerender shaders list",
        "facerender shaders flatten cook_torrance --target 330 --lobe d16",
    ),
    "shaders list": ("facerender shaders list --json",),
    "shaders path": ("facerender shaders path",),
    "shaders flatten": (
        "facerender shaders flatten cook_torrance --target es300 --lobe d16 --m 0.3 > skin.frag",
        "facerender shaders flatten mine.frag > flat.frag",
    ),
    "doctor": ("facerender doctor",),
}


class Help(str):
    """Help text of an option: "text, values (default). Note."."""

    text: str  # effect of the option
    default: str  # value without the option, or "required"
    values: str  # range, such as "0 to 20"; "" for a file, a switch or a choice
    note: str  # further sentences, without the period at the end
    unit: str  # unit of the values

    def __new__(
        cls, text: str, default: str, values: str = "", note: str = "", unit: str = ""
    ) -> Help:
        limits = f"{values} {unit}".strip()
        line = f"{', '.join(filter(None, [text, limits]))} ({default})"
        line += f". {note}." if note else ""
        help_text = super().__new__(cls, line.replace("%", "%%"))
        help_text.text, help_text.default = text, default
        help_text.values, help_text.note, help_text.unit = values, note, unit
        return help_text


def groups_of(parser: argparse.ArgumentParser) -> Iterator[tuple[str, list[argparse.Action]]]:
    """Yield title and options of each group of a parser, read from private attributes."""
    for group in parser._action_groups:
        yield group.title or "", list(group._group_actions)


def commands_of(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """Return the parsers of a parser's commands, keyed by command name."""
    for _, actions in groups_of(parser):
        for action in actions:
            if isinstance(action.choices, dict):
                return dict(action.choices)
    return {}


def usage_of(parser: argparse.ArgumentParser) -> str:
    """Return a usage line with the positional arguments and the required options."""
    words, optional = [parser.prog], False
    for _, actions in groups_of(parser):
        for action in actions:
            name = str(action.metavar or "|".join(action.choices or ()))
            if action.option_strings and action.required:
                words.append(f"{action.option_strings[0]} {name}")
            elif action.option_strings:
                optional = optional or action.dest != "help"
            else:
                words.append(f"[{name}]" if action.nargs == "?" else name)
    return " ".join([*words, *["[OPTION ...]"] * optional])
