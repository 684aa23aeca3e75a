"""Resolution of GLSL ``#include`` lines, independent of the shader library.

``Includes`` leaves conditions to the compiler, except literal numbers. ``Preprocessor`` returns
flat text and evaluates the conditions that known macros decide; it leaves all others in the
text."""

from __future__ import annotations

import operator
import os
import re
import stat
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import accumulate
from pathlib import Path
from typing import NamedTuple

from facerender.errors import InputError, check_path, check_type, reason
from facerender.system.files import read_file

DEEPEST = 64  # Largest number of nested includes.
IF = ("if", "ifdef", "ifndef")

_COMMENT_OR_STRING = re.compile(r'"[^"\n]*"|//(?:\\\n|[^\n])*|/\*.*?(?:\*/|\Z)', re.DOTALL)
_DIRECTIVE = re.compile(r"^[ \t]*#[ \t]*(\w+)[ \t]*([^\n]*)", re.MULTILINE)
_INCLUDE = re.compile(r'"([^"]+)"|<([^>]+)>')
_LAST_LINES = re.compile(r"(?:\n#line \d+ \d+\s*)+\Z")
_NOTHING = re.compile(r"(?:\s|//[^\n]*)*")
_LATE = ("110", "120", "130", "140", "150")  # Versions in which #line numbers the line after next.
_Identity = tuple[int, int]  # Device and inode number of a file.


class Directive(NamedTuple):
    """A preprocessor line."""

    start: int  # index in the text at which the line starts
    end: int  # index in the text at which the line ends, without the newline
    line: int  # number of the line, from 1
    name: str  # first word, such as "define"
    rest: str  # other words, without comments, such as "FR_LOBE 1"


class Scan(NamedTuple):
    """A text and its directives.

    Attributes
    ----------
    text : the text, without comments that begin on the line of a directive and end on a later line,
        and without the includes that literal conditions skip
    directives : directives in the order of the text
    guard : index of the #endif of the include guard, which begins at the first directive; 0 without
        a guard. Only directives and comments may follow the #endif
    """

    text: str
    directives: tuple[Directive, ...]
    guard: int


@lru_cache(maxsize=256)
def scan(text: str) -> Scan:
    """Find the directives of a text. Results are cached, since many programs include the same
    files."""
    code = text
    if "/*" in text or "\\\n" in text:
        text = _COMMENT_OR_STRING.sub(_blank_behind_directive, text)
        code = _blanked(text)
    directives = []
    line, position = 1, 0
    for match in _DIRECTIVE.finditer(code):
        line += code.count("\n", position, match.start())
        position = match.start()
        words = _blanked(match[2]) if "//" in match[2] else match[2]
        directives.append(Directive(position, match.end(), line, match[1], words.strip()))
    skipped = {*_skipped(directives)}
    for start, end, *_ in skipped:  # moderngl would include these files.
        text = text[:start] + " " * (end - start) + text[end:]
    directives = [directive for directive in directives if directive not in skipped]
    return Scan(text, tuple(directives), _guard(code, directives))


def _skipped(directives: Sequence[Directive]) -> Iterator[Directive]:
    """Yield the includes that literal conditions, such as ``#if 0``, skip."""
    # For each open condition: whether a branch is certainly compiled; whether the current may be.
    conditions: list[tuple[bool, bool]] = []
    for directive in directives:
        name, number = directive.name, directive.rest.strip("()")
        truth = bool(int(number)) if name in ("if", "elif") and number.isdigit() else None
        if name in IF:
            conditions.append((truth is True, truth is not False))
        elif conditions and name in ("elif", "else"):
            over, _ = conditions.pop()
            conditions.append((over or truth is True, not over and truth is not False))
        elif conditions and name == "endif":
            conditions.pop()
        if name == "include" and not all(may_compile for _, may_compile in conditions):
            yield directive


def _guard(code: str, directives: list[Directive]) -> int:
    depths = [*accumulate((line.name in IF) - (line.name == "endif") for line in directives)]
    end = depths.index(0) if 0 in depths else 0
    if end < 2:
        return 0
    first, second = directives[:2]
    # `#ifndef X`, `#define X 1`, `#endif` and more directives: X is a macro with a default value.
    words = [second.rest] if directives[end + 1 :] else second.rest.split()[:1]
    names = first.name, second.name, words
    around = code[: first.start] + _DIRECTIVE.sub("", code[directives[end].end :])
    is_guard = names == ("ifndef", "define", [first.rest]) and _NOTHING.fullmatch(around)
    return end if is_guard else 0


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


def decoded(data: bytes, path: str) -> str:
    """Return the text of a GLSL file, with "\\n" as line ends."""
    try:
        return data.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError:
        raise InputError(f"cannot read {path}: it is not UTF-8 text; give GLSL") from None


class Includes:
    """Text from files that include each other.

    Each file is inserted once, with two exceptions. If a file was inserted within a branch of a
    condition, an include outside the branch inserts it again, because the compiler may skip the
    branch. Directives after the include guard of a file are inserted at each include. A missing
    file is an error; within a condition, ``#error`` leaves this error to the compiler. ``#line``
    directives preserve line numbers.

    Attributes
    ----------
    files : included files, as named in include lines
    """

    def __init__(self, root: Path, paths: Sequence[str | os.PathLike[str]] = ()) -> None:
        """Create an empty text.

        Parameters
        ----------
        root : include directory of the library
        paths : more include directories, where ``<file>`` is searched before root. ``"file"`` is
            searched first in the folder of the including file, then in that of its link target
        """
        check_type("paths", paths, list | tuple, "a list of folders")
        for folder in paths:
            check_path("a folder in paths", folder)
        self.files: list[str] = []
        self._parts: list[str] = []
        self._root = os.path.realpath(root)
        self._folders = [*(os.fspath(folder) for folder in paths), self._root]
        self._late = False  # Whether the text has one of the versions _LATE.
        self._tailed: set[_Identity] = set()  # Included files with directives after their guard.
        self._chain: dict[_Identity, str] = {}  # Paths of the files being read, outermost first.
        # The first set holds the files included outside all conditions. Each further set holds the
        # files included in one open branch.
        self._scopes: list[set[_Identity]] = [set()]

    @property
    def text(self) -> str:
        """The resolved text."""
        # NVIDIA's compiler rejects #line at the end of the text.
        return _LAST_LINES.sub("\n", "".join(self._parts))

    @property
    def _path(self) -> str:
        """Path of the file being read; "" for text without a file."""
        return next(reversed(self._chain.values()), "")

    def append_file(self, path: str | Path, again: bool = False) -> None:
        """Append a file with its includes.

        again : append only the directives after the include guard

        Raises
        ------
        InputError : a file cannot be read or includes itself, or #if and #endif do not match; the
            message gives file and line
        """
        path = str(path)
        text = decoded(read_file(path, "a GLSL file"), path)
        identity = _identity(os.stat(path))
        if not again:
            self.files.append(self._name(path))
        if 0 < scan(text).guard < len(scan(text).directives) - 1:
            self._tailed.add(identity)
        self._chain[identity] = path
        self.append(text, again)
        self._chain.popitem()

    def append(self, text: str, again: bool = False) -> None:
        """Append text with its includes; see :meth:`append_file`."""
        text, directives, guard = scan(text)
        source = self.files.index(self._name(self._path)) + 1 if self._chain else 0
        start, position = (guard + 1, directives[guard].end + 1) if again else (0, 0)
        counts: list[int] = []  # Number of inserted files before each open condition.
        if source:
            line = text.count("\n", 0, position) + 1
            self._parts.append(f"{self._numbered(line, source)}  // {self.files[source - 1]}\n")
        for index, directive in enumerate(directives[start:], start):
            if guard and index in (0, guard):
                continue
            next_line = f"\n{self._numbered(directive.line + 1, source)}"
            if directive.name == "version":
                self._late = directive.rest[:3] in _LATE
            elif directive.name in IF:
                self._scopes.append(set())
                counts.append(len(self.files))
            elif directive.name in ("elif", "else", "endif"):
                self._check_open(bool(counts), directive)
                self._scopes[-1] = set()
                count = counts[-1]
                if directive.name == "endif":
                    self._scopes.pop()
                    counts.pop()
                if len(self.files) > count:  # Compilers ignore #line in a skipped branch.
                    self._parts += text[position : directive.end], next_line
                    position = directive.end
            elif directive.name == "include":
                self._parts.append(text[position : directive.start])
                position = directive.end
                if self._include(directive):
                    self._parts.append(next_line)
        self._parts.append(text[position:])
        self._check_closed(not counts)

    def _numbered(self, line: int, source: int) -> str:
        """Return a directive that gives the next line a number."""
        return f"#line {line - self._late} {source}"

    def _include(self, include: Directive) -> bool:
        """Insert an included file. Return False if the text already contains the file."""
        match = _INCLUDE.fullmatch(include.rest)
        if match is None:
            return self._fail(include, f'#include {include.rest}: write #include "FILE" or <FILE>')
        name, path = match[1] or match[2], self._path
        beside = [os.path.dirname(path) or "."] if path and match[1] else []
        folders = [*beside, *self._folders]
        try:
            file = _first(name, folders)
            if file is None and beside:
                folders.insert(1, os.path.dirname(os.path.realpath(path)))
                file = _first(name, folders)
        except OSError as error:
            return self._fail(include, f"cannot read {name}: {reason(error)}")
        if file is None:
            return self._fail(include, f"no file {name} in {' or '.join(dict.fromkeys(folders))}")
        place, identity = file
        if identity in self._chain:
            cycle = [*self._chain.values()][[*self._chain].index(identity) :]
            names = " -> ".join(map(self._name, [*cycle, place]))
            raise self._error(include, f"include cycle {names}")
        if len(self._chain) == DEEPEST:
            raise self._error(include, f"more than {DEEPEST} nested includes")
        again = any(identity in scope for scope in self._scopes)
        if again and identity not in self._tailed:
            return False
        self._scopes[-1].add(identity)
        self.append_file(place, again)
        return True

    def _fail(self, include: Directive, message: str) -> bool:
        """Raise InputError. Within a condition, which the compiler may skip, insert ``#error``."""
        if len(self._scopes) == 1:
            raise self._error(include, message)
        self._parts.append("#error " + re.sub("[\"']", "", message))  # naga reads quotes.
        return True

    def _name(self, path: str) -> str:
        """Return a file's path below the include directory, or `path` if the file is elsewhere."""
        root = os.path.join(self._root, "")
        location = os.path.normpath(path)
        if not location.startswith(root):
            location = os.path.realpath(path)  # A link may lead into the library.
        inside = location.startswith(root)
        return location.removeprefix(root).replace(os.sep, "/") if inside else path

    def _place(self, directive: Directive) -> str:
        path = f"{self._name(self._path)}:" if self._chain else "line "
        return f"{path}{directive.line}"

    def _error(self, directive: Directive, message: str) -> InputError:
        return InputError(f"{self._place(directive)}: {message}")

    def _check_open(self, is_open: bool, directive: Directive) -> None:
        if not is_open:
            raise self._error(directive, f"#{directive.name} without #if")

    def _check_closed(self, closed: bool) -> None:
        if not closed:
            file = self._name(self._path) if self._chain else "text"
            raise InputError(f"{file}: #if without #endif")


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
    """A block from #if to #endif. The #if remains in the text unless known macros decide it."""

    over: bool  # No later branch can be taken.
    guard: bool  # This is the include guard of a file.
    active: bool = False  # The current branch may be taken.
    stays: bool = False  # The condition remains in the text.
    included: set[tuple[int, int]] = field(default_factory=set)  # Files included in this branch.

    @property
    def open(self) -> bool:
        """Whether a compiler may skip the current branch."""
        return self.stays and not self.guard


class Preprocessor(Includes):
    """Flat text, without ``#line`` directives, from files that include each other.

    Conditions that known macros decide are removed, together with the branches not taken. All other
    conditions remain in the text. A condition can be decided if it consists only of comparisons,
    ``defined`` and names, with ``!``, ``&&`` and ``||``.

    Attributes
    ----------
    version : the ``#version`` line, which is removed from the text
    """

    def __init__(
        self,
        root: Path,
        paths: Sequence[str | os.PathLike[str]] = (),
        chosen: Mapping[str, str] | None = None,
        guards: bool = True,
        closed: bool = False,
    ) -> None:
        """Create an empty text.

        Parameters
        ----------
        root, paths : see :class:`Includes`
        chosen : macros that are set outside the text, and their values
        guards : whether include guards remain in the text
        closed : whether all unknown macros count as undefined, so that all conditions are decided
        """
        super().__init__(root, paths)
        self.version = ""
        self._chosen = dict(chosen or {})
        self._macros = dict(self._chosen)
        self._guards = guards
        self._closed = closed
        self._conditionals: list[_Conditional] = []

    def is_defined(self, macro: str) -> bool:
        """Return whether the text or `chosen` defines a macro."""
        return macro in self._macros

    def append(self, text: str, again: bool = False) -> None:
        """Append text with its includes; see :meth:`append_file`. Raise InputError also if a line
        defines a macro of `chosen`."""
        text, directives, guard = scan(text)
        start, position = (guard + 1, directives[guard].end + 1) if again else (0, 0)
        depth = len(self._conditionals)
        for number, directive in enumerate(directives[start:], start):
            if self._active:
                self._parts.append(text[position : directive.start])
            position = directive.end + 1
            line = text[directive.start : position]
            if directive.name in IF:
                is_guard = guard > 0 and number == 0
                self._conditionals.append(_Conditional(not self._active, is_guard))
                self._branch(directive, line)
            elif directive.name in ("elif", "else", "endif"):
                self._check_open(len(self._conditionals) > depth, directive)
                if directive.name != "endif":
                    self._branch(directive, line)
                elif self._conditionals.pop().stays:
                    self._parts.append(line)
            elif self._active:
                self._directive(directive, line)
        if self._active:
            self._parts.append(text[position:])
        self._check_closed(len(self._conditionals) == depth)

    def _directive(self, directive: Directive, line: str) -> None:
        """Process a directive, other than #if to #endif, in a branch that may be taken."""
        if directive.name == "include":
            self._scopes[1:] = [
                conditional.included for conditional in self._conditionals if conditional.open
            ]
            if self._include(directive):
                self._parts.append("\n")
            return
        if directive.name == "error" and not any(branch.open for branch in self._conditionals):
            raise self._error(directive, directive.rest)
        if directive.name == "version":
            if self.version:
                raise self._error(directive, "a second #version: remove one of them")
            self.version = line.strip()
            return
        if directive.name in ("define", "undef"):
            self._store(directive)
        self._parts.append(line)

    @property
    def _active(self) -> bool:
        return all(conditional.active for conditional in self._conditionals)

    def _branch(self, directive: Directive, line: str) -> None:
        """Begin a branch of the innermost conditional."""
        current = self._conditionals[-1]
        bare = current.guard and not self._guards
        truth = False if current.over else bare or self._truth(directive.name, directive.rest)
        if truth is None and self._closed:
            raise InputError(
                f"cannot evaluate {line.strip()}: use comparisons of macros, or defined()"
            )
        current.active = truth is not False
        current.over |= truth is True
        current.included = set()
        if truth is None:
            becomes_if = directive.name == "elif" and not current.stays
            self._parts.append(f"#if {directive.rest}\n" if becomes_if else line)
            current.stays = True
        elif truth and current.stays:
            self._parts.append("#else\n")

    def _truth(self, directive: str, condition: str) -> bool | None:
        """Return the value of a condition, or None if known macros do not decide it."""
        if directive == "else":
            return True
        if directive in ("ifdef", "ifndef"):
            return self._if_defined(condition, directive == "ifdef")
        condition = _DEFINED.sub(r" \1defined \2\3 ", condition)
        if re.search(r"[()\\]", condition):
            return None
        either = {
            _all(self._comparison(term.strip()) for term in terms.split("&&"))
            for terms in condition.split("||")
        }
        return True if True in either else None if None in either else False

    def _comparison(self, term: str) -> bool | None:
        if match := _DEFINED.fullmatch(term):
            return self._if_defined(match[3], not match[1])
        match = _COMPARISON.fullmatch(term)
        a, sign, b = match.groups() if match else (term, "!=", "0")
        left, right = self._value(a), self._value(b)
        return None if left is None or right is None else bool(_COMPARE[sign](left, right))

    def _if_defined(self, macro: str, truth: bool) -> bool | None:
        """Return `truth` if a macro is defined, or else its opposite, or None if the host may still
        define the macro."""
        return truth if macro in self._macros else not truth if self._closed else None

    def _value(self, word: str) -> int | None:
        for _ in self._macros:
            word = self._macros.get(word, word)
        if self._closed and not word[:1].isdigit():
            return 0
        return int(word) if re.fullmatch("0|[1-9][0-9]*", word) else None

    def _store(self, directive: Directive) -> None:
        """Store a macro's value, unless a condition that remains in the text encloses the line."""
        match = _MACRO.match(directive.rest)
        if match and match[1] in self._chosen:
            message = f"defines {match[1]}, which lobe or m sets: remove the line or the argument"
            raise InputError(f"{self._place(directive)} {message}")
        if match and directive.name == "undef":
            self._macros.pop(match[1], None)
        elif match and not any(conditional.open for conditional in self._conditionals):
            self._macros[match[1]] = match[2]


def _all(values: Iterable[bool | None]) -> bool | None:
    truths = set(values)
    return False if False in truths else None if None in truths else True
