"""Resolution of GLSL ``#include`` lines, independent of the shader library.

``Includes`` leaves conditions to the compiler, except literal numbers. ``Preprocessor`` returns
flat text and evaluates the conditions that known macros decide; it leaves all others in the
text."""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate
from operator import eq, ge, gt, le, lt, ne
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
_LATE = ("110", "120", "130", "140", "150")  # Versions in which #line numbers the line after next.
# Device and inode number, which are equal for all links to a file. Comparing them is faster than
# resolving the paths of all files of a program.
_Identity = tuple[int, int]


class Directive(NamedTuple):
    """A preprocessor line, and the code between the directive before it and this line."""

    before: str
    line: str  # with the newline
    newline: str  # "" if the text ends without a newline
    number: int  # number of the line, from 1
    name: str  # first word, such as "define"
    rest: str  # other words, without comments, such as "FR_LOBE 1"


@lru_cache(maxsize=256)
def scan(text: str) -> tuple[tuple[Directive, ...], str, int]:
    """Return the directives of a text, the code after them, and the index of the #endif of the
    include guard. The guard begins at the first directive; only directives and comments may follow
    its end. Without a guard the index is 0."""
    # Cached, since many programs include the same files.
    code = text
    if "/*" in text or "\\\n" in text:
        text = blanked(text, behind_directives=True)
        code = blanked(text)
    directives = []
    number, position = 1, 0
    for match in _DIRECTIVE.finditer(code):
        start, end = match.start(), match.end() + 1
        number += code.count("\n", position, start)
        words = blanked(match[2]) if "//" in match[2] else match[2]
        parts = text[position:start], text[start:end], text[match.end() : end]
        directives.append(Directive(*parts, number, match[1], words.strip()))
        number, position = number + 1, end
    after = text[position:]
    return tuple(directives), after, _guard(directives, after)


def _guard(directives: list[Directive], after: str) -> int:
    depths = [*accumulate((line.name in IF) - (line.name == "endif") for line in directives)]
    end = depths.index(0) if 0 in depths else 0
    if end < 2:
        return 0
    first, second = directives[:2]
    behind = directives[end + 1 :]
    # `#ifndef X`, `#define X 1`, `#endif` and more directives: X is a macro with a default value.
    words = [second.rest] if behind else second.rest.split()[:1]
    names = first.name, second.name, words
    around = blanked("".join(line.before for line in [first, *behind]) + after)
    return end if names == ("ifndef", "define", [first.rest]) and not around.strip() else 0


def blanked(text: str, behind_directives: bool = False) -> str:
    """Return a text with spaces in place of its comments.

    behind_directives : replace only comments that begin on a directive's line and end on a later
        one; their later lines would become code when the directive is removed
    """

    def blank(match: re.Match[str]) -> str:
        line = text[text.rfind("\n", 0, match.start()) + 1 : match.start()]
        replaced = not behind_directives or ("\n" in match[0] and line.lstrip().startswith("#"))
        is_comment = match[0].startswith("/")
        return re.sub(r"[^\n]", " ", match[0]) if replaced and is_comment else match[0]

    return _COMMENT_OR_STRING.sub(blank, text)


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
    included: frozenset[_Identity]  # Files that the text before the block contains.
    truth: bool | None = None  # Value of the current branch's condition; None if not decided.
    stays: bool = False  # The condition remains in the text.


class Includes:
    """Text from files that include each other; each file is inserted once.

    A missing file is an error; within a condition, ``#error`` leaves this error to the compiler.
    ``#line`` directives preserve line numbers.
    """

    _flat = False  # Whether the text has no #line directives and no conditions that are decided.

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
        folders = [PATH.check("a folder in paths", folder) for folder in paths]
        self.files: list[str] = []  # Included files, as named in include lines.
        self._parts: list[str] = []
        self._folders = [*folders, os.path.realpath(root)]
        self._file = ""  # Name of the file being read; "" for text without a file.
        self._late = False  # Whether the text has one of the versions _LATE.
        self._tailed: set[_Identity] = set()  # Included files with directives after their guard.
        self._chain: dict[_Identity, str] = {}  # Paths of the files being read, outermost first.
        self._included: frozenset[_Identity] = frozenset()  # Files that the text contains.
        self._conditionals: list[_Conditional] = []  # The blocks being read, outermost first.

    @property
    def text(self) -> str:
        """The resolved text."""
        # NVIDIA's compiler rejects #line at the end of the text.
        return _LAST_LINES.sub("\n", "".join(self._parts))

    def append_file(self, path: str | Path, again: bool = False) -> None:
        """Append a file with its includes. Raise InputError, with file and line, if a file cannot
        be read or includes itself, or if #if and #endif do not match.

        again : append only the directives after the include guard
        """
        path = str(path)
        text = decoded(read_file(path, "a GLSL file"), path)
        status = os.stat(path)
        identity = status.st_dev, status.st_ino
        outer_file, self._file = self._file, self._name(path)
        if not again or self._file not in self.files:
            self.files.append(self._file)
        directives, _, guard = scan(text)
        if 0 < guard < len(directives) - 1:
            self._tailed.add(identity)
        self._chain[identity] = path
        self.append(text, again)
        self._chain.popitem()
        self._file = outer_file

    def append(self, text: str, again: bool = False) -> None:
        """Append text with its includes; see :meth:`append_file`."""
        directives, after, guard = scan(text)
        depth = len(self._conditionals)
        if self._file and not self._flat:
            number = directives[guard].number + 1 if again else 1
            self._parts.append(self._numbered(number, f"  // {self._file}\n"))
        for directive in directives[guard + 1 if again else 0 :]:
            self._code(directive.before)
            if directive.name in IF:
                is_guard = guard > 0 and directive is directives[0]
                state = len(self.files), self._included
                self._conditionals.append(_Conditional(is_guard, not self._active, *state))
            elif directive.name not in ("elif", "else", "endif"):
                self._directive(directive)
                continue
            elif len(self._conditionals) == depth:
                raise self._error(directive, f"#{directive.name} without #if")
            block = self._conditionals[-1]
            if block.stays and not block.guard:
                self._included = block.included
            if directive.name == "endif":
                self._conditionals.pop()
                self._end(block, directive, directive.line)
            else:
                block.truth = False if block.over else self._truth(block, directive)
                block.over |= block.truth is True
                self._branch(block, directive)
        self._code(after)
        if len(self._conditionals) > depth:
            raise InputError(f"{self._file or 'text'}: #if without #endif")

    def _code(self, text: str) -> None:
        """Store the lines between two directives."""
        if self._active or not self._flat:
            self._parts.append(text)

    def _branch(self, block: _Conditional, directive: Directive) -> None:
        """Begin a branch."""
        if block.truth is None or not self._flat:
            becomes_if = directive.name == "elif" and not block.stays
            block.stays = True
            self._end(block, directive, f"#if {directive.rest}\n" if becomes_if else directive.line)
        elif block.truth and block.stays:
            self._parts.append("#else\n")

    def _end(self, block: _Conditional, directive: Directive, line: str) -> None:
        """End a branch, and number the next line again if the block has included files."""
        # Compilers ignore #line in a branch that they skip.
        if not self._flat and not block.guard and len(self.files) > block.file_count:
            end = self._numbered(directive.number + 1, directive.newline)
            line = line.rstrip("\n") + "\n" + end
        if block.stays:
            self._parts.append(line)

    # A subclass replaces the next two methods.

    def _truth(self, block: _Conditional, directive: Directive) -> bool | None:
        """Return the value of a condition if it is a number, such as 0 or (1); otherwise None."""
        number = directive.rest.strip("()") if directive.name in ("if", "elif") else ""
        return bool(number.strip("0")) if number.isdecimal() else None

    def _directive(self, directive: Directive) -> None:
        """Process a directive other than #if to #endif."""
        line = directive.line
        if directive.name == "version":
            self._late = directive.rest[:3] in _LATE
        elif directive.name == "include":
            if not self._active:
                # moderngl searches the result for includes, also in branches that are skipped.
                line = re.sub(r"[^\n]", " ", line)
            elif self._include(directive):
                line = "\n" + self._numbered(directive.number + 1, directive.newline)
            else:
                line = directive.newline
        self._parts.append(line)

    def _numbered(self, number: int, end: str) -> str:
        """Return a directive that gives the next line a number."""
        source = self.files.index(self._file) + 1 if self._file else 0
        return f"#line {number - self._late} {source}{end}"

    @property
    def _active(self) -> bool:
        return not self._conditionals or self._conditionals[-1].truth is not False

    @property
    def _open(self) -> bool:
        """Whether a compiler may skip the current line."""
        return any(block.stays and not block.guard for block in self._conditionals)

    def _include(self, include: Directive) -> bool:
        """Insert an included file. Return False if the text already contains the file."""
        match = _INCLUDE.fullmatch(include.rest)
        if match is None:
            return self._fail(include, f'#include {include.rest}: write #include "FILE" or <FILE>')
        name, path = match[1] or match[2], next(reversed(self._chain.values()), "")
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
        again = identity in self._included
        if again and identity not in self._tailed:
            return False
        self._included |= {identity}
        self.append_file(file_path, again)
        return True

    def _fail(self, include: Directive, message: str) -> bool:
        """Raise InputError. Within a condition, which the compiler may skip, insert ``#error``."""
        if not self._open:
            raise self._error(include, message)
        # naga reads the quotes of an #error as GLSL.
        self._parts.append("#error " + re.sub("[\"']", "", message))
        return True

    def _name(self, path: str) -> str:
        """Return a file's path below the include directory, or `path` if the file is elsewhere."""
        root = os.path.join(self._folders[-1], "")
        location = os.path.normpath(path)
        if not location.startswith(root):
            # A link may lead into the library.
            location = os.path.realpath(path)
        inside = location.startswith(root)
        return location.removeprefix(root).replace(os.sep, "/") if inside else path

    def _error(self, directive: Directive, message: str, separator: str = ": ") -> InputError:
        source = f"{self._file}:" if self._file else "line "
        return InputError(f"{source}{directive.number}{separator}{message}")


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
_COMPARE = {"==": eq, "!=": ne, "<=": le, ">=": ge, "<": lt, ">": gt}


class Preprocessor(Includes):
    """Flat text, without ``#line`` directives, from files that include each other.

    Conditions that known macros decide are removed, together with the branches not taken. All other
    conditions remain in the text.
    """

    _flat = True

    def __init__(
        self,
        root: Path,
        paths: Sequence[str | os.PathLike[str]] = (),
        chosen: Mapping[str, str] | None = None,
        guards: bool = True,
    ) -> None:
        """Create an empty text.

        chosen : macros that are set outside the text, and their values
        guards : whether include guards remain in the text
        """
        super().__init__(root, paths)
        self.version = ""  # The #version line, which is removed from the text.
        self._chosen = dict(chosen or {})
        self.macros = dict(self._chosen)  # Macros that the text or `chosen` defines.
        self._guards = guards

    def _directive(self, directive: Directive) -> None:
        if not self._active:
            return
        line = directive.line
        if directive.name == "include":
            line = "\n" if self._include(directive) else ""
        elif directive.name == "error" and not self._open:
            raise self._error(directive, directive.rest)
        elif directive.name == "version":
            if self.version:
                raise self._error(directive, "a second #version: remove one of them")
            self.version, line = line.strip(), ""
        elif directive.name in ("define", "undef") and (match := _MACRO.match(directive.rest)):
            if match[1] in self._chosen:
                remedy = "which lobe or m sets: remove the line or the argument"
                raise self._error(directive, f"defines {match[1]}, {remedy}", " ")
            if directive.name == "undef":
                self.macros.pop(match[1], None)
            elif not self._open:  # otherwise a compiler may skip the line
                self.macros[match[1]] = match[2]
        self._parts.append(line)

    def _truth(self, block: _Conditional, directive: Directive) -> bool | None:
        """Return the value of a condition, or None if known macros do not decide it."""
        condition = directive.rest
        if directive.name == "else" or (block.guard and not self._guards):
            return True
        if directive.name in ("ifdef", "ifndef"):
            # The host may still define other macros.
            return directive.name == "ifdef" if condition in self.macros else None
        if (literal := super()._truth(block, directive)) is not None:
            return literal
        # The library needs no more than comparisons, "defined" and names, with !, && and ||.
        condition = _DEFINED.sub(r" \1defined \2\3 ", condition)
        if re.search(r"[()\\]", condition):
            return None
        rank = (False, None, True).index  # in three-valued logic
        groups = [map(self._comparison, terms.split("&&")) for terms in condition.split("||")]
        return max((min(group, key=rank) for group in groups), key=rank)

    def _comparison(self, term: str) -> bool | None:
        term = term.strip()
        if match := _DEFINED.fullmatch(term):
            return not match[1] if match[3] in self.macros else None
        match = _COMPARISON.fullmatch(term)
        a, sign, b = match.groups() if match else (term, "!=", "0")
        left, right = self._value(a), self._value(b)
        return None if left is None or right is None else bool(_COMPARE[sign](left, right))

    def _value(self, word: str) -> int | None:
        for _ in self.macros:
            word = self.macros.get(word, word)
        return int(word) if re.fullmatch("0|[1-9][0-9]*", word) else None
