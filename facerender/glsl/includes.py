"""GLSL from files that include each other, each of them once. Conditions stay for the compiler;
``preprocessor.py`` evaluates them. Nothing here knows the library."""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from facerender.errors import InputError, reason

DEEPEST = 64  # files within each other
IF = ("if", "ifdef", "ifndef")

_COMMENT_OR_STRING = re.compile(r'"[^"\n]*"|//(?:\\\n|[^\n])*|/\*.*?(?:\*/|\Z)', re.DOTALL)
_DIRECTIVE = re.compile(r"^[ \t]*#[ \t]*(\w+)[ \t]*([^\n]*)", re.MULTILINE)
_INCLUDE = re.compile(r'"([^"]+)"|<([^>]+)>')
_NOTHING = re.compile(r"(?:\s|//[^\n]*)*")
_Identity = tuple[int, int]  # of a file: its device and number


class Directive(NamedTuple):
    """A line that begins with #.

    Attributes
    ----------
    start, end : of the line in its text, without the newline
    name, rest : such as "define" and "FR_LOBE 1", without comments
    """

    start: int
    end: int
    name: str
    rest: str


class Scan(NamedTuple):
    """A text and its directives.

    Attributes
    ----------
    text : in which no comment leads from a directive's line to a later one
    directives : in their order
    guarded : whether the first and the last directive are an include guard of the whole text
    """

    text: str
    directives: tuple[Directive, ...]
    guarded: bool


@lru_cache(maxsize=256)
def scan(text: str) -> Scan:
    """Find the directives of a text. A program's stages, and many programs, include the same
    files, which are therefore scanned once."""
    code = text
    if "/*" in text or "\\\n" in text:
        text = _COMMENT_OR_STRING.sub(_blank_behind_directive, text)
        code = _blanked(text)
    found = []
    for match in _DIRECTIVE.finditer(code):
        rest = _blanked(match[2]) if "//" in match[2] else match[2]
        found.append(Directive(match.start(), match.end(), match[1], rest.strip()))
    return Scan(text, tuple(found), _guarded(code, found))


def _guarded(code: str, directives: list[Directive]) -> bool:
    if len(directives) < 3:
        return False
    first, second, *_, last = directives
    names = first.name, second.name, second.rest.split()[:1]
    around = code[: first.start] + code[last.end :]
    if names != ("ifndef", "define", [first.rest]) or not _NOTHING.fullmatch(around):
        return False
    depth = 0
    for each in directives[:-1]:
        depth += (each.name in IF) - (each.name == "endif")
        if depth == 0:
            return False
    return last.name == "endif"


def _blanked(text: str) -> str:
    return _COMMENT_OR_STRING.sub(_blank, text)


def _blank(match: re.Match[str]) -> str:
    """Overwrite a comment with spaces; a string stays."""
    return match[0] if match[0].startswith('"') else re.sub(r"[^\n]", " ", match[0])


def _blank_behind_directive(match: re.Match[str]) -> str:
    """Overwrite a comment that begins on a directive's line and ends on a later one: when the
    directive goes, the rest of the comment must not become code."""
    line = match.string[match.string.rfind("\n", 0, match.start()) + 1 : match.start()]
    return _blank(match) if "\n" in match[0] and line.lstrip().startswith("#") else match[0]


class Includes:
    """Text from files that include each other, each of them once; an include in a branch of a
    condition does not stand for one outside. Lines keep their numbers, by ``#line``.

    Attributes
    ----------
    files : what was included, as include lines name it
    """

    def __init__(self, root: Path) -> None:
        """root : of ``<file>``, and of a ``"file"`` that is not beside its includer, nor beside
        what that links to"""
        self.files: list[str] = []
        self._parts: list[str] = []
        self._root = os.path.realpath(root)
        self._chain: list[tuple[_Identity, str]] = []  # of the files that are being read, and paths
        self._scopes: list[set[_Identity]] = [set()]  # included for certain, and by open branches

    @property
    def text(self) -> str:
        """What was appended."""
        return "".join(self._parts)

    def append_file(self, path: str | Path) -> None:
        """Append a file.

        Raises
        ------
        InputError : it, or what it includes, cannot be read; it includes itself; conditions that
            do not match; with file and line
        """
        path = str(path)
        try:
            with open(path, encoding="utf-8") as file:
                text = file.read().removeprefix("\ufeff")
            identity = _identity(os.stat(path))
        except OSError as error:
            raise InputError(f"cannot read {path}: {reason(error)}") from None
        except UnicodeDecodeError:
            raise InputError(f"cannot read {path}: it is not UTF-8 text") from None
        self.files.append(self._name(path))
        self._chain.append((identity, path))
        self.append(text, path)
        self._chain.pop()

    def append(self, text: str, path: str = "") -> None:
        """Append text, that of the file at path if it has one; errors as of
        :meth:`append_file`."""
        text, directives, guarded = scan(text)
        source, at = len(self.files), 0
        counts: list[int] = []  # of files before each open condition
        if path:
            self._parts.append(f"#line 1 {source}  // {self.files[-1]}\n")
        for each in directives[1:-1] if guarded else directives:
            if each.name in IF:
                self._scopes.append(set())
                counts.append(len(self.files))
            elif each.name in ("elif", "else", "endif"):
                self._check_open(bool(counts), each, text, path)
                self._scopes[-1] = set()
                before = counts[-1]
                if each.name == "endif":
                    self._scopes.pop()
                    counts.pop()
                if len(self.files) > before:  # a compiler reads no #line in a branch that it skips
                    self._parts += text[at : each.end], f"\n#line {_line(text, each) + 1} {source}"
                    at = each.end
            elif each.name == "include":
                self._parts.append(text[at : each.start])
                if found := self._found(each, text, path):
                    self.append_file(found)
                    self._parts.append(f"\n#line {_line(text, each) + 1} {source}")
                at = each.end
        self._parts.append(text[at:])
        self._check_closed(not counts, path)

    def _found(self, include: Directive, text: str, path: str) -> str:
        """Return the path of the file that a line includes; "" where it is there already."""
        match = _INCLUDE.fullmatch(include.rest)
        if match is None:
            what = f'#include {include.rest}: write #include "FILE" or <FILE>'
            raise self._error(include, text, path, what)
        name = match[1] or match[2]
        beside = [os.path.dirname(path) or "."] if path and match[1] else []
        folders = [*beside, self._root]
        try:
            found = _first(name, folders)
            if found is None and beside:
                folders.insert(1, os.path.dirname(os.path.realpath(path)))
                found = _first(name, folders)
        except OSError as error:
            raise self._error(include, text, path, f"cannot read {name}: {reason(error)}") from None
        if found is None:
            what = f"no file {name} in {' or '.join(dict.fromkeys(folders))}"
            raise self._error(include, text, path, what)
        place, identity = found
        being_read = [each for each, _ in self._chain]
        if identity in being_read:
            cycle = [each for _, each in self._chain[being_read.index(identity) :]]
            what = f"include cycle {' -> '.join(map(self._name, [*cycle, place]))}"
            raise self._error(include, text, path, what)
        if len(self._chain) == DEEPEST:
            what = f"more than {DEEPEST} files within each other"
            raise self._error(include, text, path, what)
        if any(identity in scope for scope in self._scopes):
            return ""
        self._scopes[-1].add(identity)
        return place

    def _name(self, path: str) -> str:
        """Name a file as an include line does, or by its path."""
        root = os.path.join(self._root, "")
        whole = os.path.normpath(path)
        if not whole.startswith(root):
            whole = os.path.realpath(path)  # a link may lead into the library
        inside = whole.startswith(root)
        return whole.removeprefix(root).replace(os.sep, "/") if inside else path

    def _place(self, at: Directive, text: str, path: str) -> str:
        line = _line(text, at)
        return f"{self._name(path)}:{line}" if path else f"line {line}"

    def _error(self, at: Directive, text: str, path: str, what: str) -> InputError:
        return InputError(f"{self._place(at, text, path)}: {what}")

    def _check_open(self, is_open: bool, each: Directive, text: str, path: str) -> None:
        if not is_open:
            raise self._error(each, text, path, f"#{each.name} without #if")

    def _check_closed(self, closed: bool, path: str) -> None:
        if not closed:
            raise InputError(f"{self._name(path) if path else 'text'}: #if without #endif")


def _line(text: str, directive: Directive) -> int:
    return text.count("\n", 0, directive.start) + 1


def _identity(status: os.stat_result) -> _Identity:
    """Tell files apart, whatever links lead to them: cheaper than to resolve their paths."""
    return status.st_dev, status.st_ino


def _first(name: str, folders: Sequence[str]) -> tuple[str, _Identity] | None:
    """Return path and identity of the first file of this name."""
    for folder in folders:
        path = os.path.join(folder, name)
        try:
            status = os.stat(path)
        except (FileNotFoundError, NotADirectoryError):
            continue
        if stat.S_ISREG(status.st_mode):
            return path, _identity(status)
    return None
