"""A GLSL preprocessor that returns flat text. It evaluates only the conditions that known macros
decide, and leaves all other conditions in the text."""

from __future__ import annotations

import operator
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from facerender.errors import InputError
from facerender.glsl.includes import IF, Directive, Includes, scan

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
