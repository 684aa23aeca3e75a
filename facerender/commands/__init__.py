"""The command line: arguments to calls, results to standard output; a module for each command. An
error is one line on standard error and exit status 2; warnings go to standard error as well."""

from __future__ import annotations

import argparse
import atexit
import gc
import os
import re
import sys
import traceback
import warnings
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any, NoReturn, TextIO

from facerender import __version__
from facerender.commands.examples import EXAMPLES
from facerender.commands.streams import make_usable, print_message, print_result
from facerender.errors import FacerenderError, FacerenderWarning, InputError, clipped

_COMMANDS = {
    "render": "render a mesh file, or the built-in head",
    "info": "what a mesh file holds: parts, materials, maps, size, what was mended",
    "batch": "many images: on all cores, or on a Dask cluster",
    "plan": "a cheaper frame within a budget, with its proof",
    "measure": "what each approximation costs and loses, here",
    "compare": "whether two renders are the same",
    "explore": "a page to compare two shadings in, on the reader's own GPU",
    "shaders": "the GLSL library, for programs of your own",
    "doctor": "what OpenGL is found here, what is missing",
    "completion": "what completes commands and options in bash, zsh or tcsh",
}
FAULT = 70  # EX_SOFTWARE of sysexits.h; 1 is of images that differ, 3 of jobs that failed


class _Formatter(argparse.HelpFormatter):
    """Keeps the lines of what is indented: examples."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        blocks = text.split("\n\n")
        filled = (super(_Formatter, self)._fill_text(each, width, indent) for each in blocks)
        pairs = zip(blocks, filled, strict=True)
        return "\n\n".join(raw if "\n  " in raw else block for raw, block in pairs)


class _Parser(argparse.ArgumentParser):
    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        own = {"allow_abbrev": False, "formatter_class": _Formatter}
        super().__init__(*arguments, **{**own, **keywords})
        # Values such as -35,10 are no options either.
        self._negative_number_matcher = re.compile(r"-[\d.]")

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Has the command that does not know an argument say so, and not the one above it."""
        found, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return found, unknown

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message}; see {self.prog} --help")


def console() -> NoReturn:
    """Run the command of this process, and end it."""
    make_usable()
    gc.set_threshold(100_000)  # imports leave nothing to collect: 40 ms of a cold start
    status: int | str | None = 2
    # Behind threads and what others have registered: no finalizer has more to do, and a signal
    # among them would find no handler.
    atexit.register(lambda: os._exit(int(status or 0)))
    try:
        status = main()
    except SystemExit as asked:  # --help, --version
        status = asked.code
    try:
        print_result(end="")
    except FacerenderError as error:
        print_message(f"facerender: error: {error}")
        status = 2
    sys.exit(status)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status: 0 done, 1 images differ, 2 bad input, no OpenGL,
    70 a fault of facerender itself."""
    caught: list[str] = []
    with warnings.catch_warnings():
        warnings.simplefilter("always", FacerenderWarning)
        warnings.showwarning = _warning_printer(caught)
        try:
            words = sys.argv[1:] if arguments is None else arguments
            options = parser_of(words).parse_args(words)
            options.warnings = caught
            command: Callable[[argparse.Namespace], int] = options.command
            return command(options)
        except FacerenderError as error:
            print_message(f"facerender: error: {' '.join(str(error).split())}")
            return 2
        except KeyboardInterrupt:
            return 130
        except MemoryError:
            print_message("facerender: error: out of memory: make maps or images smaller")
            return 2
        except Exception as error:
            if os.environ.get("FACERENDER_DEBUG"):
                traceback.print_exception(error)
            what = f"{type(error).__name__}: {clipped(str(error))}".removesuffix(": ")
            print_message(
                f"facerender: error: this is a fault of facerender, please report it ({what}); "
                "FACERENDER_DEBUG=1 shows where"
            )
            return FAULT


def _warning_printer(caught: list[str]) -> Callable[..., None]:
    def show(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        line_number: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        if issubclass(category, FacerenderWarning) and str(message) not in caught:
            caught.append(str(message))
            print_message(f"facerender: warning: {message}")

    return show


def parser_of(arguments: Sequence[str]) -> argparse.ArgumentParser:
    """Return the parser; of the commands, those among the arguments are imported."""
    parser = _Parser(prog="facerender", description="Render face meshes with skin highlights.")
    parser.add_argument("--version", action="version", version=f"facerender {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for name, text in _COMMANDS.items():
        command = commands.add_parser(name, help=text)
        if name in arguments:
            import_module(f"facerender.commands.{name}").add(command)
            lines = "\n  ".join(["examples:", *EXAMPLES[name]])
            command.epilog = "\n\n".join(filter(None, [command.epilog, lines]))
    return parser
