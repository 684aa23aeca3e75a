"""``facerender completion``."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from importlib import import_module

from facerender.commands import parser_of
from facerender.commands.help import EXAMPLES, Help, commands_of, groups_of
from facerender.commands.streams import print_result
from facerender.errors import InputError

# Metavars that stand for a file. Metavars that begin with FILE or OUT also do.
_FILES = ("MESH", "JOBS", "IN", "A", "B")


def add(completion: argparse.ArgumentParser) -> None:
    completion.set_defaults(command=run)
    completion.description = (
        "Print a script that completes commands, options and file names in a shell.\n"
        "Evaluate it, or write it to the shell's directory of completions.\n"
        "Requires pip install 'facerender[completion]'."
    )
    shells = ("bash", "zsh", "tcsh")
    completion.add_argument("shell", choices=shells, help=Help("shell", "required"))


def run(options: argparse.Namespace) -> int:
    try:
        shtab = import_module("shtab")
    except ImportError:
        raise InputError(
            "completion needs the package shtab; pip install 'facerender[completion]'"
        ) from None
    parser = parser_of([*EXAMPLES])
    for action in _actions(parser):
        name = str(action.metavar or "")
        if action.choices is None and (name in _FILES or name.startswith(("FILE", "OUT"))):
            action.complete = shtab.FILE  # type: ignore[attr-defined]
        elif name == "DIR":
            action.complete = shtab.DIRECTORY  # type: ignore[attr-defined]
    print_result(shtab.complete(parser, shell=options.shell))
    return 0


def _actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    """Yield the options of a parser and of its commands."""
    for _, actions in groups_of(parser):
        yield from actions
    for command in commands_of(parser).values():
        yield from _actions(command)
