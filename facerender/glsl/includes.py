"""Resolution of GLSL ``#include`` lines, independent of the shader library.

``Includes`` leaves conditions to the compiler, except literal numbers. ``Preprocessor`` returns
flat text and evaluates the conditions that known macros decide; it leaves all others in the
text."""

from __future__ import annotations

import operator
import os
import re
import stat
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import accumulate
from pathlib import Path
from typing import NamedTuple

from facerender.errors import InputError, quoted, reason
from facerender.system.files import read_file
from facerender.values.fields import PATH

DEEPEST = 64  # Largest number of nested includes.
IF = ("if", "ifdef", "ifndef")

_COMMENT_OR_STRING = re.compile(r'"[^"\n]*"|//(?:\\\n|[^\n])*|/\*.*?(?:\*/|\Z)', re.DOTALL)
_DIRECTIVE = re.compile(r"^[ \t]*#[ \t]*(\w+)[ \t]*([^\n]*)", re.MULTILINE)
_INCLUDE = re.compile(r'"([^"]+)"|<([^>]+)>')
_LAST_LINES = re.compile(r"(?:\n#line \d+ \d+\s*)+\Z")
_NOTHING = re.compile(r"(?:\s|//[^\n]*)*")
_LATE = ("110", "120", "130", "140", "150")  # Versions in which #line numbers the line after next.
# Device and inode number, which are equal for all links to a file. Comparing them is faster than
# resolving the paths of all files of a program.
_Identity = tuple[int, int]


class Directive(NamedTuple):
    """A preprocessor line."""

    start: int  # index in the text at which the line starts
    end: int  # index in the text at which the line ends, without the newline
    line: int  # number of the line, from 1
    name: str  # first word, such as "define"
    rest: str  # other words, without comments, such as "FR_LOBE 1"


class Scan(NamedTuple):
    """A text and its directives."""

    text: str  # Without comments that begin on the line of a directive and end on a later line.
    directives: tuple[Directive, ...]
    # Index of the #endif of the include guard, which begins at the first directive; 0 without a
    # guard. Only directives and comments may follow the #endif.
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
    return Scan(text, tuple(directives), _guard(code, directives))


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
    """Replace a comment by spaces if it begins on a directive's line and ends on a later one."""
    # Otherwise the later lines of the comment would become code when the directive is removed.
    line = match.string[match.string.rfind("\n", 0, match.start()) + 1 : match.start()]
    return _blank(match) if "\n" in match[0] and line.lstrip().startswith("#") else match[0]


def decoded(data: bytes, path: str) -> str:
    """Return the text of a GLSL file, with "\\n" as line ends."""
    try:
        return data.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError:
        raise InputError(f"cannot read {path}: it is not UTF-8 text; give GLSL") from None


@dataclass
class _Conditional:
    """A block from #if to #endif."""

    guard: bool  # This is the include guard of a file.
    over: bool  # No later branch can be taken.
    file_count: int  # Number of files included before the block.
    active: bool = True  # The current branch may be taken.
    stays: bool = False  # The condition remains in the text.
    included: set[_Identity] = field(default_factory=set)  # Files included in this branch.

    @property
    def open(self) -> bool:
        """Whether a compiler may skip the current branch."""
        return self.stays and not self.guard

    def begin_branch(self, truth: bool | None) -> None:
        """Begin the next branch, whose condition is true, false or, with None, not decided."""
        self.active = not self.over and truth is not False
        self.over |= truth is True
        self.included = set()


class Includes:
    """Text from files that include each other; each file is inserted once.

    A missing file is an error; within a condition, ``#error`` leaves this error to the compiler.
    ``#line`` directives preserve line numbers.

    Attributes
    ----------
    files : included files, as named in include lines
    """

    # Two texts may occur again. If a file was inserted within a branch of a condition, an include
    # outside the branch inserts it again, because the compiler may skip the branch. Directives
    # after the include guard of a file are inserted at each include: lobe.glsl checks there that
    # FR_LOBE has not changed.

    def __init__(self, root: Path, paths: Sequence[str | os.PathLike[str]] = ()) -> None:
        """Create an empty text.

        root : include directory of the library
        paths : more include directories, where ``<file>`` is searched before root. ``"file"`` is
            searched first in the folder of the including file, then in that of its link target
        """
        if not isinstance(paths, list | tuple):  # each letter of a text would be a folder
            raise InputError(f"paths = {quoted(paths)}: give a list of folders")
        self.files: list[str] = []
        self._parts: list[str] = []
        self._root = os.path.realpath(root)
        self._folders = [*(PATH.check("a folder in paths", folder) for folder in paths), self._root]
        self._source = 0  # Number of the file being read, from 1; 0 for text without a file.
        self._late = False  # Whether the text has one of the versions _LATE.
        self._tailed: set[_Identity] = set()  # Included files with directives after their guard.
        self._chain: dict[_Identity, str] = {}  # Paths of the files being read, outermost first.
        self._included: set[_Identity] = set()  # Files included outside all conditions.
        self._conditionals: list[_Conditional] = []  # The blocks being read, outermost first.

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
        """Append a file with its includes. Raise InputError, with file and line, if a file cannot
        be read or includes itself, or if #if and #endif do not match.

        again : append only the directives after the include guard
        """
        path = str(path)
        text = decoded(read_file(path, "a GLSL file"), path)
        status = os.stat(path)
        identity = status.st_dev, status.st_ino
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
        first, position = (guard + 1, directives[guard].end + 1) if again else (0, 0)
        depth, outer_source = len(self._conditionals), self._source
        self._source = self.files.index(self._name(self._path)) + 1 if self._chain else 0
        self._begin(text.count("\n", 0, position) + 1)
        for index, directive in enumerate(directives[first:], first):
            self._code(text[position : directive.start])
            position = directive.end + 1
            line = text[directive.start : position]
            if directive.name in IF:
                is_guard = guard > 0 and index == 0
                block = _Conditional(is_guard, not self._active, len(self.files))
                self._conditionals.append(block)
                self._branch(block, directive, line)
            elif directive.name in ("elif", "else", "endif"):
                if len(self._conditionals) == depth:
                    raise self._error(directive, f"#{directive.name} without #if")
                if directive.name == "endif":
                    self._end(self._conditionals.pop(), directive, line)
                else:
                    self._branch(self._conditionals[-1], directive, line)
            else:
                self._directive(directive, line)
        self._code(text[position:])
        if len(self._conditionals) > depth:
            file = self._name(self._path) if self._chain else "text"
            raise InputError(f"{file}: #if without #endif")
        self._source = outer_source

    # A subclass replaces the next five methods, which decide how a text is stored.

    def _begin(self, line: int) -> None:
        """Begin the text of a file at a line."""
        if self._source:
            self._parts.append(f"{self._numbered(line)}  // {self.files[self._source - 1]}\n")

    def _code(self, text: str) -> None:
        """Store the lines between two directives."""
        self._parts.append(text)

    def _branch(self, block: _Conditional, directive: Directive, line: str) -> None:
        """Begin a branch."""
        self._end(block, directive, line)
        block.begin_branch(_literal(directive.rest) if directive.name in ("if", "elif") else None)
        block.stays = True

    def _end(self, block: _Conditional, directive: Directive, line: str) -> None:
        """End a branch, and number the next line again if the block has included files."""
        # Compilers ignore #line in a branch that they skip.
        if not block.guard and len(self.files) > block.file_count:
            line = line.rstrip("\n") + self._next_number(directive, line)
        self._parts.append(line)

    def _directive(self, directive: Directive, line: str) -> None:
        """Process a directive other than #if to #endif."""
        if directive.name == "version":
            self._late = directive.rest[:3] in _LATE
        elif directive.name == "include":
            if not self._active:
                # moderngl searches the result for includes, also in branches that are skipped.
                line = re.sub(r"[^\n]", " ", line)
            elif self._include(directive):
                line = self._next_number(directive, line)
            else:
                line = line[directive.end - directive.start :]
        self._parts.append(line)

    def _next_number(self, directive: Directive, line: str) -> str:
        """Return the end of a directive's line, and a directive that numbers the next line."""
        return f"\n{self._numbered(directive.line + 1)}{line[directive.end - directive.start :]}"

    def _numbered(self, line: int) -> str:
        """Return a directive that gives the next line a number."""
        return f"#line {line - self._late} {self._source}"

    @property
    def _active(self) -> bool:
        return all(block.active for block in self._conditionals)

    def _open(self) -> list[_Conditional]:
        """Return the blocks whose current branch a compiler may skip."""
        return [block for block in self._conditionals if block.open]

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
        file_path, identity = file
        if identity in self._chain:
            cycle = [*self._chain.values()][[*self._chain].index(identity) :]
            names = " -> ".join(map(self._name, [*cycle, file_path]))
            raise self._error(include, f"include cycle {names}")
        if len(self._chain) == DEEPEST:
            raise self._error(include, f"more than {DEEPEST} nested includes")
        scopes = [self._included, *(block.included for block in self._open())]
        again = any(identity in scope for scope in scopes)
        if again and identity not in self._tailed:
            return False
        scopes[-1].add(identity)
        self.append_file(file_path, again)
        return True

    def _fail(self, include: Directive, message: str) -> bool:
        """Raise InputError. Within a condition, which the compiler may skip, insert ``#error``."""
        if not self._open():
            raise self._error(include, message)
        # naga reads the quotes of an #error as GLSL.
        self._parts.append("#error " + re.sub("[\"']", "", message))
        return True

    def _name(self, path: str) -> str:
        """Return a file's path below the include directory, or `path` if the file is elsewhere."""
        root = os.path.join(self._root, "")
        location = os.path.normpath(path)
        if not location.startswith(root):
            # A link may lead into the library.
            location = os.path.realpath(path)
        inside = location.startswith(root)
        return location.removeprefix(root).replace(os.sep, "/") if inside else path

    def _error(self, directive: Directive, message: str, separator: str = ": ") -> InputError:
        path = f"{self._name(self._path)}:" if self._chain else "line "
        return InputError(f"{path}{directive.line}{separator}{message}")


def _literal(condition: str) -> bool | None:
    """Return the value of a condition that is a number, such as 0 or (1); otherwise None."""
    number = condition.strip("()")
    return bool(number.strip("0")) if number.isdecimal() else None


def _first(name: str, folders: Sequence[str]) -> tuple[str, _Identity] | None:
    """Return path and identity of the first file with this name in these folders, or None."""
    for folder in folders:
        path = os.path.join(folder, name)
        try:
            status = os.stat(path)
        except (FileNotFoundError, NotADirectoryError):
            continue
        if stat.S_ISREG(status.st_mode):
            return path, (status.st_dev, status.st_ino)
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


class Preprocessor(Includes):
    """Flat text, without ``#line`` directives, from files that include each other.

    Conditions that known macros decide are removed, together with the branches not taken. All other
    conditions remain in the text.

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

    def is_defined(self, macro: str) -> bool:
        """Return whether the text or `chosen` defines a macro."""
        return macro in self._macros

    def _begin(self, line: int) -> None:
        pass

    def _code(self, text: str) -> None:
        if self._active:
            self._parts.append(text)

    def _branch(self, block: _Conditional, directive: Directive, line: str) -> None:
        bare = block.guard and not self._guards
        truth = False if block.over else bare or self._truth(directive.name, directive.rest)
        if truth is None and self._closed:
            raise InputError(
                f"cannot evaluate {line.strip()}: use comparisons of macros, or defined()"
            )
        block.begin_branch(truth)
        if truth is None:
            becomes_if = directive.name == "elif" and not block.stays
            self._parts.append(f"#if {directive.rest}\n" if becomes_if else line)
            block.stays = True
        elif truth and block.stays:
            self._parts.append("#else\n")

    def _end(self, block: _Conditional, directive: Directive, line: str) -> None:
        if block.stays:
            self._parts.append(line)

    def _directive(self, directive: Directive, line: str) -> None:
        if not self._active:
            return
        if directive.name == "include":
            if self._include(directive):
                self._parts.append("\n")
            return
        if directive.name == "error" and not self._open():
            raise self._error(directive, directive.rest)
        if directive.name == "version":
            if self.version:
                raise self._error(directive, "a second #version: remove one of them")
            self.version = line.strip()
            return
        if directive.name in ("define", "undef"):
            self._store(directive)
        self._parts.append(line)

    def _truth(self, directive: str, condition: str) -> bool | None:
        """Return the value of a condition, or None if known macros do not decide it."""
        if directive == "else":
            return True
        if directive in ("ifdef", "ifndef"):
            return self._if_defined(condition, directive == "ifdef")
        if (literal := _literal(condition)) is not None:
            return literal
        # The library needs no more than comparisons, "defined" and names, with !, && and ||.
        condition = _DEFINED.sub(r" \1defined \2\3 ", condition)
        if re.search(r"[()\\]", condition):
            return None
        either = set()
        for terms in condition.split("||"):
            truths = {self._comparison(term.strip()) for term in terms.split("&&")}
            either.add(False if False in truths else None if None in truths else True)
        return True if True in either else None if None in either else False

    def _comparison(self, term: str) -> bool | None:
        if match := _DEFINED.fullmatch(term):
            return self._if_defined(match[3], not match[1])
        match = _COMPARISON.fullmatch(term)
        a, sign, b = match.groups() if match else (term, "!=", "0")
        left, right = self._value(a), self._value(b)
        return None if left is None or right is None else bool(_COMPARE[sign](left, right))

    def _if_defined(self, macro: str, truth: bool) -> bool | None:
        """Return `truth` if a macro is defined, or else its opposite, or None if unknown."""
        # Unless the text is closed, the host may still define the macro.
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
            raise self._error(directive, message, " ")
        if match and directive.name == "undef":
            self._macros.pop(match[1], None)
        elif match and not self._open():
            self._macros[match[1]] = match[2]
