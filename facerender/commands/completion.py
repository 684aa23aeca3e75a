"""``facerender completion``."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from importlib import import_module

from facerender.commands import parser_of
from facerender.commands.examples import EXAMPLES
from facerender.commands.streams import print_result
from facerender.errors import InputError

_FILES = ("FILE", "FILE.toml", "JOBS", "IN", "A", "B")  # and what begins with OUT


def add(completion: argparse.ArgumentParser) -> None:
    completion.set_defaults(command=run)
    completion.description = (
        "Print what completes facerender's commands, options and file names in a shell: run it "
        "there, or keep it where the shell looks for such."
    )
    completion.add_argument("shell", choices=("bash", "zsh", "tcsh"))


def run(options: argparse.Namespace) -> int:
    try:
        shtab = import_module("shtab")
    except ImportError:
        raise InputError(
            "completion needs the package shtab; pip install 'facerender[completion]'"
        ) from None
    parser = parser_of([*EXAMPLES])
    for action in _actions(parser):
        words = str(action.metavar or ""), action.dest
        if action.choices is None and (
            words[0] in _FILES or words[0].startswith("OUT") or "mesh" in words
        ):
            action.complete = shtab.FILE  # type: ignore[attr-defined]
        elif words[0] == "DIR":
            action.complete = shtab.DIRECTORY  # type: ignore[attr-defined]
    print_result(shtab.complete(parser, shell=options.shell))
    return 0


def _actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    for action in parser._actions:
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for each in action.choices.values():
                yield from _actions(each)
