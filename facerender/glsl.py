"""GLSL sources: where they are, their includes resolved into flat text, and that text for a target.
What their functions are, ``catalogue.py`` tells; no OpenGL here."""

from __future__ import annotations

import operator
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import facerender
from facerender import lobes
from facerender.brdf import K_COOK_TORRANCE, K_WARD
from facerender.errors import InputError, reason
from facerender.lobes import Lobe
from facerender.shading import SMALL_SLOPE, lobe_macro

if TYPE_CHECKING:
    import moderngl

Target = Literal["330", "es300", "vulkan"]

TARGETS: dict[Target, str] = {"330": "330 core", "es300": "300 es", "vulkan": "450"}

# The slopes of a file's lobes have one domain.
_LOBE_FILES: dict[str, Lobe] = {
    "facerender/lobe/exact.glsl": "exact",
    "facerender/lobe/cosine.glsl": "cosine",
    "facerender/lobe/g_power.glsl": "d16",
    "facerender/lobe/fitted.glsl": "fitted",
}
_MODEL_FILES = {
    "facerender/cook_torrance.glsl": K_COOK_TORRANCE,
    "facerender/ward.glsl": K_WARD,
}
_SLOPE_MACROS = ("FR_SLOPE", "FR_FITTED_COEFFICIENTS", "FR_FITTED_FINE_COEFFICIENTS")
_COMMENT_OR_STRING = re.compile(r'"[^"\n]*"|//(?:\\\n|[^\n])*|/\*.*?(?:\*/|\Z)', re.DOTALL)
_DIRECTIVE = re.compile(r"\s*#\s*(\w+)\s*(.*?)\s*")
_INCLUDE = re.compile(r'"([^"]+)"|<([^>]+)>')
_GUARD = re.compile(r"\s*#[ \t]*ifndef[ \t]+(\w+)\s*#[ \t]*define[ \t]+\1\b")
_DEFINED = re.compile(r"(!?)\s*defined\s*\(?\s*(\w+)\s*\)?")
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


def data_dir(name: str) -> Path:
    """Return the folder ``name`` of the package's data: in the wheel, or in the checkout."""
    installed = Path(__file__).parent / name
    return installed if installed.is_dir() else Path(__file__).parents[1] / name


@cache
def shader_dir() -> Path:
    """Return the include root: a host adds it to its include path and writes
    ``#include "facerender/cook_torrance.glsl"``."""
    return data_dir("shaders")


@cache
def library() -> tuple[str, ...]:
    """Return the names of the library's files, such as "cook_torrance" and "lobe/exact"."""
    root = shader_dir() / "facerender"
    return tuple(
        sorted(path.relative_to(root).with_suffix("").as_posix() for path in root.rglob("*.glsl"))
    )


def shader_source(
    name: str, target: Target | None = None, *, lobe: Lobe | None = None, m: float | None = None
) -> str:
    """Return one file of the library, or of your own, as flat text: each file that it includes
    once, in order, with a line on licence and origin.

    Parameters
    ----------
    name : of a file of the library, such as "cook_torrance" or "lobe/exact", or of one of its
        functions, such as "fr_cook_torrance"; or the path of a GLSL file of your own that includes
        files of the library
    target : "330" (OpenGL 3.3), "es300" (OpenGL ES 3.0, WebGL 2) or "vulkan" (GLSL 450): the text
        begins with this ``#version``, a whole compilation unit. Without: text to include, the same
        for all targets
    lobe : what ``fr_lobe`` and the BRDFs use; others are left out. Without, the host says
        ``#define FR_LOBE``, or gets the exact lobe
    m : rms slope, in the domain of the lobe: the coefficients become constants, and every function
        uses this slope whatever the caller passes

    Raises
    ------
    InputError : an unknown name, target or lobe; a slope outside its domain; a file that is
        missing, or that includes itself
    """
    if target is not None and target not in TARGETS:
        raise InputError(f"unknown target {target!r}; known: {', '.join(TARGETS)}")
    if lobe is not None and lobe not in lobes.NAMES:
        raise InputError(f"unknown lobe {lobe!r}; known: {', '.join(lobes.NAMES)}")
    path = _path(name)
    macros = {} if lobe is None else {"FR_LOBE": lobe_macro(lobe)}
    if lobe == "exact" and m is not None and m >= SMALL_SLOPE:
        macros["FR_SMALL_SLOPE"] = "0"
    expansion = _Expansion(macros | ({} if m is None else dict.fromkeys(_SLOPE_MACROS, "")))
    expansion.file(path)
    if lobe is not None and "facerender/lobe.glsl" not in expansion.files:
        raise InputError(f"{name} does not use FR_LOBE: leave lobe {lobe} out")
    if m is not None:
        macros |= _constant_slope(name, expansion.files, lobe, m)

    version = expansion.version
    if target is not None:
        if version:
            raise InputError(f"{name} says {version}: leave that line, or the target, out")
        version = f"#version {TARGETS[target]}"
    slope = "" if m is None else f", m = {m:g} whatever the caller passes"
    head = [
        version,
        f"// {_label(path)} with what it includes of facerender {facerender.__version__}"
        f"{'' if lobe is None else f', lobe {lobe}'}{slope}.",
        "// SPDX-License-Identifier: MIT, (c) 2026 the facerender developers",
        *(f"#define {macro} {value}" for macro, value in macros.items()),
    ]
    text = "\n".join([*filter(None, head), "", *expansion.lines])
    return re.sub(r"\n{3,}", "\n\n", text).rstrip("\n") + "\n"


def resolve_includes(text: str) -> str:
    """Resolve the ``#include`` lines of a shader of yours: ``"file"`` and ``<file>`` below
    :func:`shader_dir`.

    Each file comes once; branches of ``#if`` that the text's own macros decide are left out. Line
    numbers in a compiler's messages stay those of your text, as source string 0; those of a file
    of the library follow the number that its ``#line`` gives it.

    Raises
    ------
    InputError : a file that is missing, or that includes itself; the message gives the line
    """
    expansion = _Expansion({}, numbered=True)
    expansion.text(text)
    return "\n".join(expansion.lines)


def moderngl_includes(context: moderngl.Context) -> None:
    """Make ``#include "facerender/cook_torrance.glsl"``, and every other file of the library, work
    in the programs of a moderngl context."""
    for name in library():
        context.includes[f"facerender/{name}.glsl"] = shader_source(name)


def _path(name: str) -> Path:
    if name in library():
        return shader_dir() / f"facerender/{name}.glsl"
    if Path(name).suffix:
        return Path(name)
    for file in library():
        path = shader_dir() / f"facerender/{file}.glsl"
        if re.search(rf"^\w+ {re.escape(name)}\(", path.read_text(encoding="utf-8"), re.MULTILINE):
            return path
    raise InputError(
        f"unknown shader {name!r}; known: {', '.join(library())}, their functions (facerender "
        "shaders list), and files of your own"
    )


def _label(path: Path) -> str:
    """Name a file as an include line does."""
    root = shader_dir()
    return path.relative_to(root).as_posix() if path.is_relative_to(root) else str(path)


def _constant_slope(name: str, files: Iterable[str], lobe: Lobe | None, m: float) -> dict[str, str]:
    """Return the macros that make m a constant, and with it the fitted lobes' coefficients."""
    used = [_LOBE_FILES[file] for file in files if file in _LOBE_FILES]
    if not used:
        raise InputError(f"{name} does not use a slope: leave m = {m:g} out")
    if lobe is None and "facerender/lobe.glsl" in files:
        raise InputError(f"m = {m:g} without a lobe: say which, since each has its own domain")
    powers = [k for file, k in _MODEL_FILES.items() if file in files] or [K_COOK_TORRANCE, K_WARD]
    for k in powers:
        lobes.check_slope(m, lobe or used[0], k)

    macros = {"FR_SLOPE(m)": str(float(m))}
    if used == ["fitted"]:
        for macro, kind, coefficients in (
            ("FR_FITTED_COEFFICIENTS", "vec3", lobes.fitted_coefficients),
            ("FR_FITTED_FINE_COEFFICIENTS", "vec4", lobes.fitted_fine_coefficients),
        ):
            vectors = [
                f"{kind}({', '.join(f'{a:#.9g}' for a in coefficients(m, k))})" for k in powers
            ]
            macros[f"{macro}(m, k)"] = (
                vectors[0]
                if len(vectors) == 1
                else f"((k) == {powers[0]} ? {vectors[0]} : {vectors[1]})"
            )
    return macros


@dataclass
class _Conditional:
    """An #if up to its #endif; it stays in the text unless the macros that are known decide it."""

    over: bool  # no branch that comes can be taken
    guard: bool  # it is a file's include guard
    active: bool = False  # the branch that is being read may be taken
    stays: bool = False
    included: set[Path] = field(default_factory=set)  # by the branch that is being read

    @property
    def open(self) -> bool:
        """Whether a compiler may skip what is being read."""
        return self.stays and not self.guard


class _Expansion:
    """Flat text from files that include each other.

    Attributes
    ----------
    lines : the text
    version : the ``#version`` line, where the text is not numbered; it is not among the lines
    files : what was included, as include lines name it
    """

    def __init__(self, macros: dict[str, str], numbered: bool = False) -> None:
        """macros : values that are known; numbered : lines keep their numbers, by ``#line``"""
        self.lines: list[str] = []
        self.version = ""
        self.files: list[str] = []
        self._macros = dict(macros)
        self._numbered = numbered
        self._chain: list[Path] = []
        self._conditionals: list[_Conditional] = []
        self._included: set[Path] = set()

    def file(self, path: Path) -> None:
        """Append a file."""
        try:
            text = path.read_text(encoding="utf-8")
        except OSError as error:
            raise InputError(f"cannot read {path}: {reason(error)}") from None
        except UnicodeDecodeError:
            raise InputError(f"cannot read {path}: it is not UTF-8 text") from None
        self.files.append(_label(path))
        if self._numbered:
            self.lines.append(f"#line 1 {len(self.files)}  // {_label(path)}")
        self._chain.append(path.resolve())
        self.text(text, path)
        self._chain.pop()

    def text(self, text: str, path: Path | None = None) -> None:
        """Append text, that of the file at path if it is any's."""
        source = len(self.files)
        depth = len(self._conditionals)
        code = _COMMENT_OR_STRING.sub(_blank, text)
        guard = match[1] if (match := _GUARD.match(code)) else None
        lines = zip(text.split("\n"), code.split("\n"), strict=True)
        for number, (line, bare) in enumerate(lines, 1):
            directive, rest = match.groups() if (match := _DIRECTIVE.fullmatch(bare)) else ("", "")
            if directive in ("if", "ifdef", "ifndef"):
                own = directive == "ifndef" and rest == guard
                self._conditionals.append(_Conditional(over=not self._active, guard=own))
                self._branch(directive, rest, line)
            elif directive in ("elif", "else", "endif"):
                if len(self._conditionals) == depth:
                    raise InputError(f"{_place(path, number)}: #{directive} without #if")
                if directive == "endif":
                    self._put(line if self._conditionals.pop().stays else None)
                else:
                    self._branch(directive, rest, line)
            elif not self._active:
                self._put(None)
            elif directive == "include":
                self._include(rest, path, number)
                if self._numbered:
                    self.lines.append(f"#line {number + 1} {source}")
            elif directive == "version" and not self._numbered:
                self.version = line.strip()
            else:
                self._learn(directive, rest)
                self.lines.append(line)
        if len(self._conditionals) > depth:
            raise InputError(f"{_label(path) if path else 'text'}: #if without #endif")

    @property
    def _active(self) -> bool:
        return all(conditional.active for conditional in self._conditionals)

    def _put(self, line: str | None) -> None:
        """Append a line; None stands for one that is left out."""
        if line is not None or self._numbered:
            self.lines.append(line or "")

    def _include(self, rest: str, path: Path | None, number: int) -> None:
        where = _place(path, number)
        match = _INCLUDE.fullmatch(rest)
        if match is None:
            raise InputError(f'{where}: #include {rest}: write #include "FILE" or <FILE>')
        folders = [path.parent] if path and match[1] else []
        folders.append(shader_dir())
        name = match[1] or match[2]
        found = next((file for folder in folders if (file := folder / name).is_file()), None)
        if found is None:
            raise InputError(f"{where}: no file {name} in {' or '.join(map(str, folders))}")
        key = found.resolve()
        if key in self._chain:
            cycle = [*self._chain[self._chain.index(key) :], key]
            raise InputError(f"{where}: include cycle {' -> '.join(map(_label, cycle))}")
        branches = [conditional.included for conditional in self._conditionals if conditional.open]
        scopes = [self._included, *branches]
        if not any(key in scope for scope in scopes):
            scopes[-1].add(key)
            self.file(found)

    def _branch(self, directive: str, rest: str, line: str) -> None:
        """Begin a branch of the last conditional."""
        current = self._conditionals[-1]
        truth = False if current.over else self._truth(directive, rest)
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
            return (directive == "ifdef") if condition in self._macros else None
        either = [
            _all([self._comparison(term.strip()) for term in terms.split("&&")])
            for terms in condition.split("||")
        ]
        return True if True in either else _all(either)

    def _comparison(self, term: str) -> bool | None:
        if match := _DEFINED.fullmatch(term):
            return (not match[1]) if match[2] in self._macros else None
        match = _COMPARISON.fullmatch(term)
        a, sign, b = match.groups() if match else (term, "!=", "0")
        left, right = self._value(a), self._value(b)
        return None if left is None or right is None else bool(_COMPARE[sign](left, right))

    def _value(self, word: str) -> int | None:
        for _ in self._macros:
            word = self._macros.get(word, word)
        return int(word) if word.isdecimal() else None

    def _learn(self, directive: str, rest: str) -> None:
        """Note a macro's value, if the line is sure to be compiled."""
        match = _MACRO.match(rest)
        if match and directive == "undef":
            self._macros.pop(match[1], None)
        elif match and directive == "define" and not any(c.open for c in self._conditionals):
            self._macros[match[1]] = match[2]


def _place(path: Path | None, number: int) -> str:
    return f"{_label(path)}:{number}" if path else f"line {number}"


def _blank(match: re.Match[str]) -> str:
    """Overwrite a comment with spaces; a string stays."""
    return match[0] if match[0].startswith('"') else re.sub(r"[^\n]", " ", match[0])


def _all(values: Iterable[bool | None]) -> bool | None:
    found = set(values)
    return False if False in found else None if None in found else True
