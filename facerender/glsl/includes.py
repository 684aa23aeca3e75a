"""Resolves ``#include`` in GLSL as a preprocessor would, into flat text; it knows no library."""

from __future__ import annotations

import operator
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

from facerender.errors import InputError, reason

DEEPEST = 64  # files within each other

_COMMENT_OR_STRING = re.compile(r'"[^"\n]*"|//(?:\\\n|[^\n])*|/\*.*?(?:\*/|\Z)', re.DOTALL)
_DIRECTIVE = re.compile(r"\s*#\s*(\w+)\s*(.*?)\s*")
_INCLUDE = re.compile(r'"([^"]+)"|<([^>]+)>')
_GUARD = re.compile(r"\s*#[ \t]*ifndef[ \t]+(\w+)\s*#[ \t]*define[ \t]+\1\b")
_DEFINED = re.compile(r"(!?)\s*defined\s*(?:\(\s*(\w+)\s*\)|\s(\w+))")
_MACRO = re.compile(r"(\w+)(?:\([^)]*\))?\s*(.*)")
_COMPARISON = re.compile(r"(\w+)\s*(==|!=|<=|>=|<|>)\s*(\w+)")
_COMPARE = {
    "==": operator.eq,
    "!=": operator.ne,
    "<=": operator.le,
    ">=": operator.ge,
    "<": operator.lt,
    ">": operator.gt,
}


@dataclass
class _Conditional:
    """An #if up to its #endif; it stays in the text unless the macros that are known decide it."""

    files: int  # that were included before it
    over: bool  # no branch that comes can be taken
    guard: bool  # it is a file's include guard
    active: bool = False  # the branch that is being read may be taken
    stays: bool = False
    included: set[Path] = field(default_factory=set)  # by the branch that is being read

    @property
    def open(self) -> bool:
        """Whether a compiler may skip what is being read."""
        return self.stays and not self.guard


class Expansion:
    """Flat text from files that include each other, each of them once.

    Branches of ``#if`` that known macros decide are left out; of the conditions, those are
    understood that are made of comparisons, ``defined`` and names, with ``!``, ``&&`` and ``||``.

    Attributes
    ----------
    lines : the text
    version : the ``#version`` line, where the text is not numbered; it is not among the lines
    files : what was included, as include lines name it
    """

    def __init__(
        self,
        root: Path,
        chosen: Mapping[str, str] | None = None,
        numbered: bool = False,
        guards: bool = True,
        closed: bool = False,
    ) -> None:
        """root : of ``<file>``, and of a ``"file"`` that is not beside its includer, nor beside
        what that links to; chosen : macros that are set from outside; numbered : lines keep their
        numbers, by ``#line``; guards : the files' include guards stay; closed : what is not
        defined here is undefined, so that no conditional stays"""
        self.lines: list[str] = []
        self.version = ""
        self.files: list[str] = []
        self._root = root.resolve()
        self._chosen = dict(chosen or {})
        self._macros = dict(self._chosen)
        self._numbered = numbered
        self._guards = guards
        self._closed = closed
        self._chain: list[Path] = []
        self._conditionals: list[_Conditional] = []
        self._included: set[Path] = set()

    def knows(self, macro: str) -> bool:
        """Whether the text, or the choice, defines a macro."""
        return macro in self._macros

    def file(self, path: Path) -> None:
        """Append a file.

        Raises
        ------
        InputError : it, or what it includes, cannot be read; it includes itself; conditionals that
            do not match, or a macro that was chosen; with file and line
        """
        try:
            text = path.read_text(encoding="utf-8-sig")
        except OSError as error:
            raise InputError(f"cannot read {path}: {reason(error)}") from None
        except UnicodeDecodeError:
            raise InputError(f"cannot read {path}: it is not UTF-8 text") from None
        self.files.append(self._name(path))
        if self._numbered:
            self.lines.append(f"#line 1 {len(self.files)}  // {self.files[-1]}")
        self._chain.append(path.resolve())
        self.text(text, path)
        self._chain.pop()

    def text(self, text: str, path: Path | None = None) -> None:
        """Append text, that of the file at path if it is any's; errors as of :meth:`file`."""
        source, depth = len(self.files), len(self._conditionals)
        lines, guard = _scanned(text)
        for number, (line, directive, rest) in enumerate(lines, 1):
            if directive in ("if", "ifdef", "ifndef"):
                own = directive == "ifndef" and rest == guard
                conditional = _Conditional(len(self.files), not self._active, own)
                self._conditionals.append(conditional)
                self._branch(directive, rest, line)
            elif directive in ("elif", "else", "endif"):
                if len(self._conditionals) == depth:
                    raise self._error(path, number, f"#{directive} without #if")
                conditional = self._conditionals[-1]
                if directive == "endif":
                    self._put(line if self._conditionals.pop().stays else None)
                else:
                    self._branch(directive, rest, line)
                if self._numbered and len(self.files) > conditional.files:
                    self.lines.append(f"#line {number + 1} {source}")
            elif not self._active:
                self._put(None)
            elif directive == "include":
                self._include(rest, path, number)
                if self._numbered:
                    self.lines.append(f"#line {number + 1} {source}")
            elif directive == "version" and not self._numbered:
                if self.version:
                    raise self._error(path, number, "a second #version")
                self.version = line.strip()
            else:
                if directive in ("define", "undef"):
                    self._learn(directive, rest, path, number)
                self.lines.append(line)
        if len(self._conditionals) > depth:
            raise InputError(f"{self._name(path) if path else 'text'}: #if without #endif")

    @property
    def _active(self) -> bool:
        return all(conditional.active for conditional in self._conditionals)

    def _name(self, path: Path) -> str:
        """Name a file as an include line does, or by its path."""
        whole = path.resolve()
        inside = whole.is_relative_to(self._root)
        return whole.relative_to(self._root).as_posix() if inside else str(path)

    def _place(self, path: Path | None, number: int) -> str:
        return f"{self._name(path)}:{number}" if path else f"line {number}"

    def _error(self, path: Path | None, number: int, what: str) -> InputError:
        return InputError(f"{self._place(path, number)}: {what}")

    def _put(self, line: str | None) -> None:
        """Append a line; None stands for one that is left out."""
        if line is not None or self._numbered:
            self.lines.append(line or "")

    def _include(self, rest: str, path: Path | None, number: int) -> None:
        match = _INCLUDE.fullmatch(rest)
        if match is None:
            what = f'#include {rest}: write #include "FILE" or <FILE>'
            raise self._error(path, number, what)
        name = match[1] or match[2]
        folders = [path.parent, path.resolve().parent] if path and match[1] else []
        folders.append(self._root)
        try:
            found = next((file for folder in folders if (file := folder / name).is_file()), None)
        except OSError as error:
            raise self._error(path, number, f"cannot read {name}: {reason(error)}") from None
        if found is None:
            what = f"no file {name} in {' or '.join(dict.fromkeys(map(str, folders)))}"
            raise self._error(path, number, what)
        key = found.resolve()
        if key in self._chain:
            cycle = [*self._chain[self._chain.index(key) :], key]
            what = f"include cycle {' -> '.join(map(self._name, cycle))}"
            raise self._error(path, number, what)
        if len(self._chain) == DEEPEST:
            raise self._error(path, number, f"more than {DEEPEST} files within each other")
        branches = [conditional.included for conditional in self._conditionals if conditional.open]
        scopes = [self._included, *branches]
        if not any(key in scope for scope in scopes):
            scopes[-1].add(key)
            self.file(found)

    def _branch(self, directive: str, rest: str, line: str) -> None:
        """Begin a branch of the last conditional."""
        current = self._conditionals[-1]
        bare = current.guard and not self._guards
        truth = False if current.over else bare or self._truth(directive, rest)
        if truth is None and self._closed:
            raise InputError(
                f"cannot decide {line.strip()}: write comparisons of macros, or defined()"
            )
        current.active = truth is not False
        current.over |= truth is True
        current.included = set()
        if truth is None:
            self._put(line if current.stays or directive != "elif" else f"#if {rest}")
            current.stays = True
        else:
            self._put("#else" if truth and current.stays else None)

    def _truth(self, directive: str, condition: str) -> bool | None:
        """Decide a condition of comparisons, defined() and single names; None where it is open."""
        if directive == "else":
            return True
        if directive in ("ifdef", "ifndef"):
            return (
                (directive == "ifdef")
                if condition in self._macros
                else self._undefined(directive == "ifndef")
            )
        condition = _DEFINED.sub(
            lambda match: f" {match[1]}defined {match[2] or match[3]} ", condition
        )
        if re.search(r"[()\\]", condition):
            return None
        either = {
            _all(self._comparison(term.strip()) for term in terms.split("&&"))
            for terms in condition.split("||")
        }
        return True if True in either else None if None in either else False

    def _comparison(self, term: str) -> bool | None:
        if match := _DEFINED.fullmatch(term):
            return (not match[1]) if match[3] in self._macros else self._undefined(bool(match[1]))
        match = _COMPARISON.fullmatch(term)
        a, sign, b = match.groups() if match else (term, "!=", "0")
        left, right = self._value(a), self._value(b)
        return None if left is None or right is None else bool(_COMPARE[sign](left, right))

    def _undefined(self, truth: bool) -> bool | None:
        """Return a condition's truth where a macro is not defined, if none is to come."""
        return truth if self._closed else None

    def _value(self, word: str) -> int | None:
        for _ in self._macros:
            word = self._macros.get(word, word)
        if self._closed and not word[:1].isdigit():
            return 0
        return int(word) if re.fullmatch("0|[1-9][0-9]*", word) else None

    def _learn(self, directive: str, rest: str, path: Path | None, number: int) -> None:
        """Note a macro's value, if the line is sure to be compiled."""
        match = _MACRO.match(rest)
        if match and match[1] in self._chosen:
            where = self._place(path, number)
            raise InputError(f"{where} defines {match[1]}: leave the line, or that choice, out")
        if match and directive == "undef":
            self._macros.pop(match[1], None)
        elif match and not any(conditional.open for conditional in self._conditionals):
            self._macros[match[1]] = match[2]


@lru_cache(maxsize=128)
def _scanned(text: str) -> tuple[tuple[tuple[str, str, str], ...], str | None]:
    """Return each line with its directive and what follows it, and the macro of the include guard
    that all of the text stands in; a program's stages, and many programs, include the same."""
    text = _without_comments_behind_directives(text)
    code = _COMMENT_OR_STRING.sub(_blank, text)
    lines = []
    for line, bare in zip(text.split("\n"), code.split("\n"), strict=True):
        directive, rest = match.groups() if (match := _DIRECTIVE.fullmatch(bare)) else ("", "")
        lines.append((line, directive, rest))
    return tuple(lines), _guard(code)


def _blank(match: re.Match[str]) -> str:
    """Overwrite a comment with spaces; a string stays."""
    return match[0] if match[0].startswith('"') else re.sub(r"[^\n]", " ", match[0])


def _without_comments_behind_directives(text: str) -> str:
    """Blank comments that begin on a directive's line and end on a later one: when the directive
    goes, their rest must not become code."""

    def blank(match: re.Match[str]) -> str:
        line = text[text.rfind("\n", 0, match.start()) + 1 : match.start()]
        behind = "\n" in match[0] and line.lstrip().startswith("#")
        return _blank(match) if behind else match[0]

    return _COMMENT_OR_STRING.sub(blank, text)


def _guard(code: str) -> str | None:
    """Return the macro of the include guard that all of the code stands in."""
    match = _GUARD.match(code)
    lines = code.strip().split("\n")
    depth = 0
    for number, line in enumerate(lines, 1):
        directive = _DIRECTIVE.fullmatch(line)
        depth += directive is not None and directive[1] in ("if", "ifdef", "ifndef")
        depth -= directive is not None and directive[1] == "endif"
        if depth == 0 and number < len(lines):
            return None
    return match[1] if match else None


def _all(values: Iterable[bool | None]) -> bool | None:
    found = set(values)
    return False if False in found else None if None in found else True
