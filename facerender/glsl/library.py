"""The GLSL library: its directory, its files as flat text for a GLSL version or another language,
its catalogue of functions, and the code of specular terms (their macros, includes and calls)."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from facerender import __version__
from facerender.errors import InputError, check_known
from facerender.glsl.includes import Includes, Preprocessor, decoded
from facerender.scene.shading import SMALL_SLOPE, Term
from facerender.system.files import data_dir
from facerender.terms.lobe import LOBES, SLOPES, TITLES, AnyLobe, Entry, GPower, lobe_entry
from facerender.terms.model import FRESNEL, MASKING, MODELS

if TYPE_CHECKING:
    import moderngl


# The catalogue of functions is parsed from the comments that a reader of the GLSL files has. Each
# file has a header comment, and a function may have a comment above it. A comment begins with a
# sentence; lines "//   key: text" follow. Deeper indented lines continue the text of a key.
_FUNCTION = re.compile(r"((?:^//.*\n)*)^(\w+) (fr_\w+)\(([^)]*)\) \{", re.MULTILINE)
_KEYED = re.compile(r"^   (\w+(?:, \w+)*): +(\S.*(?:\n {5,}\S.*)*)", re.MULTILINE)


@dataclass(frozen=True)
class Function:
    """A public function of the library, with the texts of its comments."""

    name: str  # such as "fr_ward"
    signature: str  # GLSL declaration
    file: str  # path in an include line
    summary: str  # first sentence of the comment
    parameters: dict[str, str]  # meaning, unit and domain, keyed by the parameter name
    formula: str
    unit: str
    result: str  # text of the key "returns"; "" if the comment lacks this key
    error: str
    source: str


@cache
def functions() -> tuple[Function, ...]:
    """Return all public functions of the library, in alphabetical order of the files."""
    result = []
    for file in (f"facerender/{name}.glsl" for name in library()):
        text = (shader_dir() / file).read_text(encoding="utf-8")
        header = _comment(text[: text.index("#ifndef")])
        for comment, return_type, name, parameters in _FUNCTION.findall(text):
            description = _comment(comment)
            texts = _keyed(header) | _keyed(description)
            paragraph = (description or header).split("\n\n")[0]
            parameters = " ".join(parameters.split())
            names = [parameter.split()[1] for parameter in parameters.split(", ")]
            function = Function(
                name,
                signature=f"{return_type} {name}({parameters})",
                file=file,
                summary=re.split(r"(?<=\.) (?=[A-Z])", " ".join(paragraph.split()))[0],
                parameters={name: texts[name] for name in names},
                result=texts.get("returns", ""),
                **{key: texts[key] for key in ("formula", "unit", "error", "source")},
            )
            result.append(function)
    return tuple(result)


def _comment(lines: str) -> str:
    return re.sub(r"^//", "", lines, flags=re.MULTILINE)


def _keyed(comment: str) -> dict[str, str]:
    return {
        key: " ".join(text.split())
        for keys, text in _KEYED.findall(comment)
        for key in keys.split(", ")
    }


Target = Literal["330", "es300", "vulkan"]
Language = Literal["hlsl", "msl", "wgsl"]

TARGETS: dict[Target, str] = {"330": "330 core", "es300": "300 es", "vulkan": "450"}
LANGUAGES: tuple[Language, ...] = ("hlsl", "msl", "wgsl")
_STANDARD_INPUT = Path("standard input")


@cache
def shader_dir() -> Path:
    """Return the include directory of the library.

    A host adds this directory to its include path and writes
    ``#include "facerender/cook_torrance.glsl"``.
    """
    return data_dir("shaders")


@cache
def library() -> tuple[str, ...]:
    """Return the names of the library's files, such as "cook_torrance" and "lobe/exact"."""
    root = shader_dir() / "facerender"
    files = (path.relative_to(root).with_suffix("") for path in root.rglob("*.glsl"))
    return tuple(sorted(file.as_posix() for file in files))


def shader_source(
    name: str,
    target: Target | Language | None = None,
    *,
    lobe: AnyLobe | None = None,
    m: float | None = None,
    paths: Sequence[str | os.PathLike[str]] = (),
) -> str:
    """Return a library file, or a GLSL file that includes library files, as flat text.

    Each file is inserted once, except that a file included within a condition may be inserted again
    after this condition. The text begins with a comment on licence and origin.

    Parameters
    ----------
    name : name of a library file ("cook_torrance", "lobe/exact") or library function
        ("fr_cook_torrance"), or path of a GLSL file; "-" reads standard input
    target : "330" (OpenGL 3.3), "es300" (OpenGL ES 3.0, WebGL 2) or "vulkan" (GLSL 450): the text
        begins with this ``#version``, and host code may follow. "hlsl", "msl" (Metal) or "wgsl":
        the text is translated to this language, with all macros resolved. None (default): GLSL to
        include in a program, the same for all GLSL versions
    lobe : lobe for ``fr_lobe`` and the BRDFs; the code of other lobes is omitted. None (default):
        the host may select a lobe with ``#define FR_LOBE``; otherwise the exact lobe is used
    m : RMS slope, in the domain of the lobe. All functions use this constant and ignore their
        parameter m; coefficients of the lobe become constants. None (default): use the parameter
    paths : more include directories; see :func:`resolve_includes`

    Raises
    ------
    InputError : an unknown name, target or lobe; m outside its domain; a file that is missing,
        includes itself, reaches an ``#error``, or defines a macro that lobe or m sets; for "hlsl",
        "msl" and "wgsl", a file with samplers, arrays, or declarations other than functions and
        constants
    """
    macros = {} if lobe is None else lobe_macros(lobe)
    if m is not None:
        SLOPES.check("m", m)
    # A constant m in this range does not need the slower form that is accurate at small angles.
    if lobe == "exact" and m is not None and m >= SMALL_SLOPE:
        macros["FR_SMALL_SLOPE"] = "0"
    return _flat(name, target, macros, lobe, m, paths)


def term_source(
    term: Term, smallest_m: float, target: Target | Language | None = None, two_lobes: bool = False
) -> str:
    """Return the file of a term's model as flat text, configured for the term.

    target : see :func:`shader_source`, which also lists the errors
    smallest_m : lowest m of the material; used if the term has no constant m
    two_lobes : whether to return the function with two lobes; both slopes remain parameters
    """
    variant = replace(term, m=None) if two_lobes else term
    macros = term_macros(variant, smallest_m)
    return _flat(file_of(term, two_lobes), target, macros, term.lobe, variant.m)


def _flat(
    name: str,
    target: Target | Language | None,
    macros: dict[str, str],
    lobe: AnyLobe | None,
    m: float | None,
    paths: Sequence[str | os.PathLike[str]] = (),
) -> str:
    if target is not None:
        check_known("target", target, (*TARGETS, *LANGUAGES))
    path = _path(name)
    is_standard = path == _STANDARD_INPUT
    standard_input = decoded(sys.stdin.buffer.read(), str(path)) if is_standard else None
    chosen = {macro.split("(")[0]: value for macro, value in macros.items()}
    if m is not None:
        coefficients = [lobe.constants[0] for lobe in LOBES.values() if lobe.constants]
        chosen |= dict.fromkeys(["FR_SLOPE", *coefficients], "")
    closed = target in LANGUAGES

    def flattened(guards: bool) -> Preprocessor:
        flat = Preprocessor(shader_dir(), paths, chosen, guards, closed)
        if standard_input is None:
            flat.append_file(path)
        else:
            flat.append(standard_input)
        return flat

    flat = flattened(guards=target is None)
    # A branch and the text after it may include the same file: the guards decide which is compiled.
    if len(set(flat.files)) < len(flat.files):
        flat = flattened(guards=True)
    if lobe is not None and "facerender/lobe.glsl" not in flat.files:
        raise InputError(f"{name} does not use FR_LOBE: leave lobe {lobe} out")
    if m is not None:
        macros = macros | _constant_slope(name, flat, lobe, m)

    version = flat.version
    if target is not None:
        if version:
            raise InputError(f"{name} contains {version}: leave out that line or the target")
        version = f"#version {TARGETS[target]}" if target in TARGETS else ""
    in_library = path.is_relative_to(shader_dir())
    label = flat.files[0] if in_library else path.name
    origin = f"{label.encode(errors='replace').decode()} with what it includes of facerender"
    slope = "" if m is None else f", m = {m:g} whatever the caller passes"
    head = [
        version,
        f"// {origin} {__version__}{'' if lobe is None else f', lobe {lobe}'}{slope}.",
        "// SPDX-License-Identifier: MIT, (c) 2026 the facerender contributors",
        defines(macros).rstrip(),
    ]
    text = "\n".join([*filter(None, head), "", flat.text])
    if target in LANGUAGES:
        from facerender.glsl.translate import translate

        try:
            text = translate(text.split("\n"), target)
        except InputError as error:
            language, file = target.upper(), label if in_library else name
            spirv = ", or convert the SPIR-V of target vulkan with spirv-cross"
            remedy = f"write this code in {language}{spirv * (target != 'wgsl')}"
            raise InputError(f"{file} in {language}: {error}; {remedy}") from None
    return re.sub(r"\n{3,}", "\n\n", text).rstrip("\n") + "\n"


def resolve_includes(text: str, paths: Sequence[str | os.PathLike[str]] = ()) -> str:
    """Resolve the ``#include`` lines in GLSL text that includes files below :func:`shader_dir`.

    ``"file"`` and ``<file>`` are accepted. Each file is inserted once, except that a file included
    within a condition may be inserted again after this condition. The compiler evaluates
    conditions. Within ``#if 0`` and other branches that literal numbers skip, includes are ignored.
    ``#line`` directives preserve line numbers in compiler messages: your text is source string 0,
    and included files are numbered from 1.

    paths : more include directories, which are searched before :func:`shader_dir`

    Raises
    ------
    InputError : a file includes itself, or is missing; the message gives the line. Within another
        condition a missing file becomes ``#error``, which the compiler reports or skips
    """
    resolved = Includes(shader_dir(), paths)
    resolved.append(text.removeprefix("\ufeff"))
    return resolved.text


def translated(text: str, language: Language) -> str:
    """Translate GLSL functions and constants. The text may include files of the library.

    Macros that neither the text nor the library defines count as undefined. For errors see
    :func:`shader_source`.
    """
    from facerender.glsl.translate import translate

    flat = Preprocessor(shader_dir(), closed=True)
    flat.append(text)
    return translate(flat.text.split("\n"), language)


def moderngl_includes(context: moderngl.Context) -> None:
    """Register all library files as includes of a moderngl context. Programs of the context may
    then contain lines such as ``#include "facerender/cook_torrance.glsl"``, in quotes."""
    for name in library():
        context.includes[f"facerender/{name}.glsl"] = shader_source(name)


def _path(name: str) -> Path:
    if name == "-":
        return _STANDARD_INPUT
    root = shader_dir() / "facerender"
    stem = name.removeprefix("facerender/").removesuffix(".glsl")
    host_file = Path(name)
    # "ward" is always the library's file; "ward.glsl" is the host's, if the host has such a file.
    if stem in library() and (stem == name or not os.path.isfile(host_file)):
        return root / f"{stem}.glsl"
    if host_file.suffix or os.path.exists(host_file):
        return host_file
    for file in library():
        path = root / f"{file}.glsl"
        if re.search(rf"^\w+ {re.escape(name)}\(", path.read_text(encoding="utf-8"), re.MULTILINE):
            return path
    raise InputError(
        f"unknown shader {name!r}; known: {', '.join(library())}, their functions (see facerender "
        "shaders list), and paths of GLSL files"
    )


def _constant_slope(
    name: str, flat: Preprocessor, lobe: AnyLobe | None, m: float
) -> dict[str, str]:
    """Return the macros that make m and the lobe coefficients constants."""

    def has(entry: Entry) -> bool:
        return f"facerender/{entry.file}.glsl" in flat.files

    # One constant cannot stand for the slopes of two lobes.
    if any(model.two and has(model.two) for model in MODELS.values()):
        raise InputError(f"{name} has two slopes: leave m = {m:g} out")
    used = sorted(filter(has, LOBES.values()), key=lambda entry: entry.name)
    if not used:
        raise InputError(f"{name} does not use a slope: leave m = {m:g} out")
    if "facerender/lobe.glsl" in flat.files and not flat.is_defined("FR_LOBE"):
        raise InputError(f"m = {m:g} without a lobe: give a lobe, which determines m's domain")
    powers = list(dict.fromkeys(model.k for model in MODELS.values() if has(model)))
    powers = powers or list(TITLES)
    for entry in used if lobe is None else [lobe_entry(lobe)]:
        for k in powers:
            entry.check(m, k)

    # The macros replace the functions' parameter m, which callers of the functions still pass.
    macros = {"FR_SLOPE(m)": str(float(m))}
    if isinstance(lobe, GPower):
        macros["FR_STEEPNESS(m, k)"] = str(float(lobe.factor / m**2 - lobe.offset))
    for macro, coefficients in filter(None, (entry.constants for entry in used)):
        vectors = [coefficients(m, k) for k in powers]
        texts = [f"vec{len(a)}({', '.join(f'{x:#.9g}' for x in a)})" for a in vectors]
        choice = f"((k) == {powers[0]} ? {texts[0]} : {texts[-1]})"
        macros[f"{macro}(m, k)"] = choice if len(powers) > 1 else texts[0]
    return macros


def defines(macros: Mapping[str, str]) -> str:
    """Return GLSL lines that define these macros."""
    return "".join(f"#define {name} {value}\n" for name, value in macros.items())


def lobe_macros(lobe: AnyLobe) -> dict[str, str]:
    """Return the macros that select a lobe for ``fr_lobe``."""
    entry = lobe_entry(lobe)
    return {"FR_LOBE": entry.macro, **entry.macros}


def term_macros(term: Term, smallest_m: float) -> dict[str, str]:
    """Return the macros that make the function of a model, such as ``fr_cook_torrance``, compute a
    term; ``smallest_m`` as in :func:`prelude`."""
    macros = _macros(term, smallest_m)
    if MODELS[term.model].factors:
        macros["FR_FRESNEL"] = FRESNEL[term.fresnel].macro
        macros["FR_MASKING"] = MASKING[term.masking].macro
    if term.m is not None:
        macros["FR_SLOPE(m)"] = repr(float(term.m))
    return macros


def prelude(term: Term, smallest_m: float, two_lobes: bool = False) -> str:
    """Return the macros and the include that precede the call of a term in a program.

    smallest_m : lowest m of the material; used if the term has no constant m
    """
    macros = _macros(term, smallest_m)
    if term.m is not None:
        macros["FR_CONSTANT_SLOPE"] = "1"
    return f'{defines(macros)}#include "facerender/{file_of(term, two_lobes)}.glsl"\n'


def _macros(term: Term, smallest_m: float) -> dict[str, str]:
    """Return the macros that select the lobe of a term. FR_SMALL_SLOPE is 0 if the term has the
    exact lobe and needs no accurate small angles."""
    lobe = lobe_entry(term.lobe)
    macros = {"FR_LOBE": lobe.macro, **lobe.macros}
    if lobe.of_tan2 and not term.keeps_small_slopes(smallest_m):
        macros["FR_SMALL_SLOPE"] = "0"
    return macros


def file_of(term: Term, two_lobes: bool) -> str:
    """Return the name of the library file that a term needs, such as "ward"."""
    model = MODELS[term.model]
    return model.two.file if two_lobes and model.two else model.file


def call(term: Term, second_slope: float | None = None) -> str:
    """Return a term's GLSL expression, in 1/sr, of the variables vec3 n, l, v and float m, f0.

    second_slope : ratio of the second lobe's m to the first lobe's m; the expression then also
        uses float second_m and lobe_weight. None for materials with one lobe
    """
    model = MODELS[term.model]
    two = None if second_slope is None else model.two
    return _expression((two or model).call, term, second_slope)


def environment_call(term: Term, second_slope: float | None = None) -> str:
    """Return the GLSL expression of the radiance (vec3) that a term reflects from an environment.

    The expression uses vec3 n, v and float m, f0. For second_slope see :func:`call`. Raise
    InputError if the model does not support environment maps.
    """
    model = MODELS[term.model]
    if model.environment is None:
        raise InputError(
            f"the model {term.model} has no specular term for environment maps: set "
            "environment_samples to 0, or choose another model"
        )
    return _expression(model.environment.call, term, second_slope)


def _expression(code: str, term: Term, second_slope: float | None) -> str:
    """Return the call with the names of macros and slopes. If it has one lobe, but the material has
    two, return the weighted mean of two calls. A constant m becomes a number."""
    names = {
        "lobe": lobe_entry(term.lobe).macro,
        "fresnel": FRESNEL[term.fresnel].macro,
        "masking": MASKING[term.masking].macro,
    }
    m, second = "m", "second_m"
    if term.m is not None:
        m, second = repr(term.m), repr(term.second(second_slope or 1.0).m)
    if second_slope is None or "{second}" in code:
        return code.format(m=m, second=second, **names)
    first_call, second_call = (code.format(m=slope, **names) for slope in (m, second))
    return f"lobe_weight * {first_call} + (1.0 - lobe_weight) * {second_call}"
