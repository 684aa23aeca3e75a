"""Resolution of GLSL ``#include`` lines. This module leaves conditions to the compiler;
``preprocessor.py`` evaluates conditions. This module is independent of the shader library."""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from facerender.errors import InputError, reason
from facerender.system.files import read_file

DEEPEST = 64  # Largest number of nested includes.
IF = ("if", "ifdef", "ifndef")

_COMMENT_OR_STRING = re.compile(r'"[^"\n]*"|//(?:\\\n|[^\n])*|/\*.*?(?:\*/|\Z)', re.DOTALL)
_DIRECTIVE = re.compile(r"^[ \t]*#[ \t]*(\w+)[ \t]*([^\n]*)", re.MULTILINE)
_INCLUDE = re.compile(r'"([^"]+)"|<([^>]+)>')
_LAST_LINE = re.compile(r"\n#line \d+ \d+\s*\Z")
_NOTHING = re.compile(r"(?:\s|//[^\n]*)*")
_Identity = tuple[int, int]  # Device and inode number of a file.


class Directive(NamedTuple):
    """A preprocessor line.

    Attributes
    ----------
    start, end : indices in the text at which the line starts and ends, without the newline
    name, rest : words of the line, without comments, such as "define" and "FR_LOBE 1"
    """

    start: int
    end: int
    name: str
    rest: str


class Scan(NamedTuple):
    """A text and its directives.

    Attributes
    ----------
    text : the text, without comments that begin on the line of a directive and end on a later line
    directives : directives in the order of the text
    guarded : whether the first and the last directive form an include guard around the whole text
    """

    text: str
    directives: tuple[Directive, ...]
    guarded: bool


@lru_cache(maxsize=256)
def scan(text: str) -> Scan:
    """Find the directives of a text. Results are cached, since many programs include the same
    files."""
    code = text
    if "/*" in text or "\\\n" in text:
        text = _COMMENT_OR_STRING.sub(_blank_behind_directive, text)
        code = _blanked(text)
    directives = []
    for match in _DIRECTIVE.finditer(code):
        words = _blanked(match[2]) if "//" in match[2] else match[2]
        directives.append(Directive(match.start(), match.end(), match[1], words.strip()))
    return Scan(text, tuple(directives), _guarded(code, directives))


def _guarded(code: str, directives: list[Directive]) -> bool:
    if len(directives) < 3:
        return False
    first, second, *_, last = directives
    names = first.name, second.name, second.rest.split()[:1]
    around = code[: first.start] + code[last.end :]
    if names != ("ifndef", "define", [first.rest]) or not _NOTHING.fullmatch(around):
        return False
    depth = 0
    for directive in directives[:-1]:
        depth += (directive.name in IF) - (directive.name == "endif")
        if depth == 0:
            return False
    return last.name == "endif"


def _blanked(text: str) -> str:
    return _COMMENT_OR_STRING.sub(_blank, text)


def _blank(match: re.Match[str]) -> str:
    """Replace a comment by spaces; return a string literal unchanged."""
    return match[0] if match[0].startswith('"') else re.sub(r"[^\n]", " ", match[0])


def _blank_behind_directive(match: re.Match[str]) -> str:
    """Replace a comment by spaces if it begins on a directive's line and ends on a later one.
    Otherwise the later lines of the comment would become code when the directive is removed."""
    line = match.string[match.string.rfind("\n", 0, match.start()) + 1 : match.start()]
    return _blank(match) if "\n" in match[0] and line.lstrip().startswith("#") else match[0]


class Includes:
    """Text from files that include each other.

    Each file is inserted once, with one exception. If a file was inserted within a branch of a
    condition, an include outside the branch inserts it again, because the compiler may skip the
    branch. ``#line`` directives preserve line numbers.

    Attributes
    ----------
    files : included files, as named in include lines
    """

    def __init__(self, root: Path) -> None:
        """Create an empty text.

        root : include directory, where ``<file>`` is searched. ``"file"`` is searched in the folder
            of the including file, then in the folder of its link target, then in root
        """
        self.files: list[str] = []
        self._parts: list[str] = []
        self._root = os.path.realpath(root)
        self._chain: list[tuple[_Identity, str]] = []  # Files being read, outermost first.
        # The first set holds the files included outside all conditions. Each further set holds the
        # files included in one open branch.
        self._scopes: list[set[_Identity]] = [set()]

    @property
    def text(self) -> str:
        """The resolved text."""
        # NVIDIA's compiler rejects #line at the end of the text.
        return _LAST_LINE.sub("\n", "".join(self._parts))

    def append_file(self, path: str | Path) -> None:
        """Append a file with its includes.

        Raises
        ------
        InputError : a file cannot be read or includes itself, or #if and #endif do not match; the
            message gives file and line
        """
        path = str(path)
        try:
            text = read_file(path, "a GLSL file").decode("utf-8-sig")
            text = text.replace("\r\n", "\n").replace("\r", "\n")
        except UnicodeDecodeError:
            raise InputError(f"cannot read {path}: it is not UTF-8 text; give GLSL") from None
        identity = _identity(os.stat(path))
        self.files.append(self._name(path))
        self._chain.append((identity, path))
        self.append(text, path)
        self._chain.pop()

    def append(self, text: str, path: str = "") -> None:
        """Append text with its includes. For errors see :meth:`append_file`.

        path : path of the text's file; "" for text without a file
        """
        text, directives, guarded = scan(text)
        source, position = len(self.files), 0
        counts: list[int] = []  # Number of inserted files before each open condition.
        if path:
            self._parts.append(f"#line 1 {source}  // {self.files[-1]}\n")
        for directive in directives[1:-1] if guarded else directives:
            if directive.name in IF:
                self._scopes.append(set())
                counts.append(len(self.files))
            elif directive.name in ("elif", "else", "endif"):
                self._check_open(bool(counts), directive, text, path)
                self._scopes[-1] = set()
                count = counts[-1]
                if directive.name == "endif":
                    self._scopes.pop()
                    counts.pop()
                if len(self.files) > count:  # Compilers ignore #line in a skipped branch.
                    self._parts += (
                        text[position : directive.end],
                        f"\n#line {_line(text, directive) + 1} {source}",
                    )
                    position = directive.end
            elif directive.name == "include":
                self._parts.append(text[position : directive.start])
                if file := self._found(directive, text, path):
                    self.append_file(file)
                    self._parts.append(f"\n#line {_line(text, directive) + 1} {source}")
                position = directive.end
        self._parts.append(text[position:])
        self._check_closed(not counts, path)

    def _found(self, include: Directive, text: str, path: str) -> str:
        """Return the path of an included file; "" if the text already contains the file."""
        match = _INCLUDE.fullmatch(include.rest)
        if match is None:
            message = f'#include {include.rest}: write #include "FILE" or <FILE>'
            raise self._error(include, text, path, message)
        name = match[1] or match[2]
        beside = [os.path.dirname(path) or "."] if path and match[1] else []
        folders = [*beside, self._root]
        try:
            file = _first(name, folders)
            if file is None and beside:
                folders.insert(1, os.path.dirname(os.path.realpath(path)))
                file = _first(name, folders)
        except OSError as error:
            raise self._error(include, text, path, f"cannot read {name}: {reason(error)}") from None
        if file is None:
            message = f"no file {name} in {' or '.join(dict.fromkeys(folders))}"
            raise self._error(include, text, path, message)
        place, identity = file
        being_read = [file_identity for file_identity, _ in self._chain]
        if identity in being_read:
            cycle = [file_path for _, file_path in self._chain[being_read.index(identity) :]]
            message = f"include cycle {' -> '.join(map(self._name, [*cycle, place]))}"
            raise self._error(include, text, path, message)
        if len(self._chain) == DEEPEST:
            message = f"more than {DEEPEST} nested includes"
            raise self._error(include, text, path, message)
        if any(identity in scope for scope in self._scopes):
            return ""
        self._scopes[-1].add(identity)
        return place

    def _name(self, path: str) -> str:
        """Return a file's path below the include directory, or `path` if the file is elsewhere."""
        root = os.path.join(self._root, "")
        location = os.path.normpath(path)
        if not location.startswith(root):
            location = os.path.realpath(path)  # A link may lead into the library.
        inside = location.startswith(root)
        return location.removeprefix(root).replace(os.sep, "/") if inside else path

    def _place(self, directive: Directive, text: str, path: str) -> str:
        line = _line(text, directive)
        return f"{self._name(path)}:{line}" if path else f"line {line}"

    def _error(self, directive: Directive, text: str, path: str, message: str) -> InputError:
        return InputError(f"{self._place(directive, text, path)}: {message}")

    def _check_open(self, is_open: bool, directive: Directive, text: str, path: str) -> None:
        if not is_open:
            raise self._error(directive, text, path, f"#{directive.name} without #if")

    def _check_closed(self, closed: bool, path: str) -> None:
        if not closed:
            raise InputError(f"{self._name(path) if path else 'text'}: #if without #endif")


def _line(text: str, directive: Directive) -> int:
    return text.count("\n", 0, directive.start) + 1


def _identity(status: os.stat_result) -> _Identity:
    """Return device and inode number, which are equal for all links to a file. Comparing these
    numbers is faster than resolving paths."""
    return status.st_dev, status.st_ino


def _first(name: str, folders: Sequence[str]) -> tuple[str, _Identity] | None:
    """Return path and identity of the first file with this name in these folders, or None."""
    for folder in folders:
        path = os.path.join(folder, name)
        try:
            status = os.stat(path)
        except (FileNotFoundError, NotADirectoryError):
            continue
        if stat.S_ISREG(status.st_mode):
            return path, _identity(status)
    return None
