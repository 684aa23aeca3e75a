"""The command line, one module per command. Results go to standard output. Warnings and errors go
to standard error. An error prints one line and sets exit status 2."""

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
from contextlib import nullcontext
from importlib import import_module
from typing import Any, NoReturn

from facerender import __version__
from facerender.commands import output
from facerender.errors import FacerenderError, FacerenderWarning, InputError, clipped, withheld

COMMANDS = {
    "render": "render a mesh to one image, several images or an animation",
    "views": "render the standard views of scans of a face, with sheets",
    "info": "list the parts, materials, maps and size of a mesh file",
    "batch": "render a table of jobs on all cores or a Dask cluster",
    "plan": "find a cheaper frame within an error budget",
    "measure": "measure cost and error of each specular approximation",
    "compare": "compare two images, or two folders of images",
    "explore": "write a web page that compares two shadings of a mesh",
    "shaders": "list and flatten files of the GLSL library",
    "doctor": "check the OpenGL drivers and packages of this machine",
}
INTERNAL_ERROR = 70  # exit status EX_SOFTWARE of sysexits.h; all statuses: see main()


class _Formatter(argparse.RawDescriptionHelpFormatter):
    """A formatter that keeps the line breaks of descriptions and examples."""

    def add_argument(self, action: argparse.Action) -> None:
        super().add_argument(action)
        if action.nargs == argparse.PARSER:
            # Python 3.11 ignores the indentation of command names, and wraps the longest of them.
            longest = 4 + max(map(len, action.choices or ("",)))
            self._action_max_length = max(self._action_max_length, longest)


class _Parser(argparse.ArgumentParser):
    def __init__(self, **keywords: Any) -> None:
        super().__init__(allow_abbrev=False, formatter_class=_Formatter, **keywords)
        # argparse takes -35 as a value, but -35,10 and -z as options unless this pattern matches.
        self._negative_number_matcher = re.compile(r"-([\d.]|[xyz]$)")

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Raise the error for an unknown argument in the parser of the subcommand, so that the
        message refers to the help of the subcommand."""
        options, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return options, unknown

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message}; see {self.prog} --help")


class _TrimeshAlone:
    """An import hook that hides scipy and networkx from trimesh, which imports both if they are
    installed. Reading a PLY or STL file needs neither, and takes 1.3 s with both, 0.4 s without."""

    @staticmethod
    def find_spec(name: str, *_: object) -> None:
        spec = getattr(sys.modules.get("trimesh"), "__spec__", None)
        if name in ("scipy", "networkx") and getattr(spec, "_initializing", False):
            raise ModuleNotFoundError(name)


def console() -> NoReturn:
    """Run the command of this process, then end the process."""
    output.make_usable()
    sys.meta_path.insert(0, _TrimeshAlone)
    gc.set_threshold(100_000)  # saves 40 ms of a cold start, as imports leave no garbage
    status: int | str | None = 2
    # This exit handler runs after all threads and all other exit handlers. It skips the finalizers
    # of the interpreter, because no handler would catch a signal during these.
    atexit.register(lambda: os._exit(int(status or 0)))
    try:
        status = main()
    except SystemExit as end:  # --help, --version
        status = end.code
    try:
        output.print_result(end="")
    except FacerenderError as error:
        output.print_message(f"facerender: error: {error}")
        status = 2
    sys.exit(status)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status: 0 done, 1 images differ, 2 bad input or no OpenGL,
    3 some jobs failed, 70 internal error, 130 interrupted."""
    words = sys.argv[1:] if arguments is None else arguments
    # Options that cannot be parsed may contain names, too.
    anonymous = any(word.startswith("--anonymous") for word in words)
    messages: list[str] = []
    with output.silenced() if anonymous else nullcontext():
        status = _run(words, messages, _warning_printer(messages, anonymous))
    if anonymous:
        for message in messages:
            output.print_message(f"facerender: warning: {message}")
        if status in (2, INTERNAL_ERROR):
            output.print_message(f"facerender: error: {withheld(1, 'message')}")
    return status


def _run(words: Sequence[str], messages: list[str], show_warning: Callable[..., None]) -> int:
    """Run a command; ``messages`` has the texts of its warnings for its JSON output."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", FacerenderWarning)
        warnings.showwarning = show_warning
        try:
            _check_words(words)
            options = parser_of(words).parse_args(words)
            options.warnings = messages
            options.anonymous = _id(options)
            command: Callable[[argparse.Namespace], int] = options.command
            return command(options)
        except FacerenderError as error:
            output.print_message(f"facerender: error: {' '.join(str(error).split())}")
            return 2
        except KeyboardInterrupt:
            return 130
        except MemoryError:
            output.print_message("facerender: error: out of memory: make maps or images smaller")
            return 2
        except Exception as error:
            if os.environ.get("FACERENDER_DEBUG"):
                traceback.print_exception(error)
            notes = " ".join(["", *getattr(error, "__notes__", ())])  # such as the file's name
            cause = f"{type(error).__name__}: {clipped(str(error))}".removesuffix(": ") + notes
            remedy = "please report it with the traceback that FACERENDER_DEBUG=1 prints"
            output.print_message(f"facerender: error: internal error ({cause}): {remedy}")
            return INTERNAL_ERROR


def _id(options: argparse.Namespace) -> str | None:
    """Return the text that replaces all names; None without --anonymous."""
    name = getattr(options, "id", None)
    if getattr(options, "anonymous", False):
        return name or "anonymous"
    if name is not None:
        raise InputError(f"--id {name} is for --anonymous: add it, or leave --id out")
    return None


def _check_words(words: Sequence[str]) -> None:
    """Raise InputError for an empty argument, such as a shell variable that is not set."""
    for previous_word, word in zip(["", *words], words, strict=False):
        option = word[:-1] if re.fullmatch(r"--[\w-]+=", word) else previous_word
        if not word or option != previous_word:
            subject = f"the value of {option}" if option.startswith("-") else "an argument"
            raise InputError(f"{subject} is empty: give a value, or leave it out")


def _warning_printer(messages: list[str], anonymous: bool) -> Callable[..., None]:
    """Return a function that prints a new warning and adds it to the messages, which are only one
    message with the number of warnings if they must not contain names."""
    texts: list[str] = []

    def show(message: Warning | str, category: type[Warning], *_: object) -> None:
        if issubclass(category, FacerenderWarning) and str(message) not in texts:
            texts.append(str(message))
            messages[:] = [withheld(len(texts), "warning")] if anonymous else texts
            output.print_message(f"facerender: warning: {message}")

    return show


def parser_of(arguments: Sequence[str]) -> argparse.ArgumentParser:
    """Return the command line's parser. Only commands in `arguments` are imported, with options."""
    parser = _Parser(
        prog="facerender",
        description="Render face meshes without a display, with Cook-Torrance or Ward highlights.",
        epilog="facerender COMMAND --help describes a command. Defaults are in parentheses.",
    )
    parser.add_argument("--version", action="version", version=f"facerender {__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for name, text in COMMANDS.items():
        command = commands.add_parser(name, help=text)
        if name in arguments:
            import_module(f"facerender.commands.{name}").add(command)
            _complete(name, command)
    return parser


def _complete(name: str, command: argparse.ArgumentParser) -> None:
    """Add a usage line and examples to the help of a command and of its subcommands."""
    command.epilog = "\n  ".join(["examples:", *output.EXAMPLES[name]])
    subcommands = output.commands_of(command)
    if not subcommands:
        command.usage = output.usage_of(command)
    for action, subcommand in subcommands.items():
        _complete(f"{name} {action}", subcommand)
