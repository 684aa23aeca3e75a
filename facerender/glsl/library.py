"""The GLSL library: its directory, its files as flat text for a GLSL version or another language,
and the code of specular terms (their macros, includes and calls)."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
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

Target = Literal["330", "es300", "vulkan"]
Language = Literal["hlsl", "metal", "msl", "wgsl"]

TARGETS: dict[Target, str] = {"330": "330 core", "es300": "300 es", "vulkan": "450"}
LANGUAGES: dict[Language, str] = {"hlsl": "HLSL", "metal": "Metal", "wgsl": "WGSL", "msl": "Metal"}


@cache
def shader_dir() -> Path:
    """Return the include directory of the library. A host adds this directory to its include path
    and writes ``#include "facerender/cook_torrance.glsl"``."""
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
        begins with this ``#version``, and host code may follow. "hlsl", "metal" or "wgsl": the
        functions are translated to this language, with all macros resolved; macros without a
        definition count as undefined. "msl" is another name of "metal". None (default): GLSL to
        include in a program, the same for all GLSL versions
    lobe : lobe for ``fr_lobe`` and the BRDFs; the code of other lobes is omitted. None (default):
        the host may select a lobe with ``#define FR_LOBE``; otherwise the exact lobe is used
    m : RMS slope, in the domain of the lobe. All functions use this constant and ignore their
        parameter m; coefficients of the lobe become constants. None (default): use the parameter
    paths : more include directories; see :func:`resolve_includes`

    Raises
    ------
    InputError : an unknown name, target or lobe; m outside its domain; a file that is missing,
        includes itself, reaches an ``#error``, or defines a macro that lobe or m sets; a file that
        cannot be translated, or a translator that is not installed
    """
    if m is not None:
        SLOPES.check("m", m)
    macros = {} if lobe is None else lobe_macros(lobe, m is None or m < SMALL_SLOPE)
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
    standard_input = decoded(sys.stdin.buffer.read(), str(path)) if name == "-" else None
    chosen = {macro.split("(")[0]: value for macro, value in macros.items()}
    if m is not None:
        coefficients = [lobe.constants[0] for lobe in LOBES.values() if lobe.constants]
        chosen |= dict.fromkeys(["FR_SLOPE", *coefficients], "")

    # A branch and the text after it may include the same file: the guards decide which is compiled.
    for guards in (True,) if target is None else (False, True):
        flat = Preprocessor(shader_dir(), paths, chosen, guards)
        if standard_input is None:
            flat.append_file(path)
        else:
            flat.append(standard_input)
        if len(set(flat.files)) == len(flat.files):
            break
    if lobe is not None and "facerender/lobe.glsl" not in flat.files:
        raise InputError(f"{name} does not use FR_LOBE: leave lobe {lobe} out")
    if m is not None:
        macros = macros | _slope_macros(name, flat, lobe, m)

    if target is not None and flat.version:
        raise InputError(f"{name} contains {flat.version}: leave out that line or the target")
    version = f"#version {TARGETS[target]}" if target in TARGETS else flat.version
    in_library = path.is_relative_to(shader_dir())
    label = flat.files[0] if in_library else path.name
    origin = f"{label.encode(errors='replace').decode()} with what it includes of facerender"
    slope = "" if m is None else f", m = {m:g} whatever the caller passes"
    code = f"{defines(macros)}\n{flat.text}"
    if target in LANGUAGES:
        from facerender.glsl.translate import translate

        language = LANGUAGES[target]
        try:
            code = "\n" + translate(code, language)
        except InputError as error:
            raise InputError(f"{label if in_library else name} in {language}: {error}") from None
    text = f"""{version}
// {origin} {__version__}{"" if lobe is None else f", lobe {lobe}"}{slope}.
// SPDX-License-Identifier: MIT, (c) 2026 the facerender contributors
{code}"""
    return re.sub(r"\n{3,}", "\n\n", text).strip("\n") + "\n"


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


def moderngl_includes(context: moderngl.Context) -> None:
    """Register all library files as includes of a moderngl context. Programs of the context may
    then contain lines such as ``#include "facerender/cook_torrance.glsl"``, in quotes."""
    for name in library():
        context.includes[f"facerender/{name}.glsl"] = shader_source(name)


def _path(name: str) -> Path:
    if name == "-":
        return Path("standard input")
    stem = name.removeprefix("facerender/").removesuffix(".glsl")
    host_file = Path(name)
    # "ward" is always the library's file; "ward.glsl" is the host's, if the host has such a file.
    if stem in library() and (stem == name or not os.path.isfile(host_file)):
        return shader_dir() / f"facerender/{stem}.glsl"
    if host_file.suffix or os.path.exists(host_file):
        return host_file
    for file in library():
        path = shader_dir() / f"facerender/{file}.glsl"
        if re.search(rf"^\w+ {re.escape(name)}\(", path.read_text(encoding="utf-8"), re.MULTILINE):
            return path
    known = f"{', '.join(library())}, their functions (see facerender shaders list)"
    raise InputError(f"unknown shader {name!r}; known: {known}, and paths of GLSL files")


def _slope_macros(name: str, flat: Preprocessor, lobe: AnyLobe | None, m: float) -> dict[str, str]:
    """Return the macros that make m and the lobe coefficients constants."""
    files = {file for file in library() if f"facerender/{file}.glsl" in flat.files}
    # One constant cannot stand for the slopes of two lobes.
    if any(model.two and model.two.file in files for model in MODELS.values()):
        raise InputError(f"{name} has two slopes: leave m = {m:g} out")
    used = [LOBES[lobe_name] for lobe_name in sorted(LOBES) if LOBES[lobe_name].file in files]
    if not used:
        raise InputError(f"{name} does not use a slope: leave m = {m:g} out")
    if "lobe" in files and "FR_LOBE" not in flat.macros:
        raise InputError(f"m = {m:g} without a lobe: give a lobe, which determines m's domain")
    powers = list(dict.fromkeys(model.k for model in MODELS.values() if model.file in files))
    powers = powers or [*TITLES]
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


def lobe_macros(lobe: AnyLobe, small_slopes: bool = True) -> dict[str, str]:
    """Return the macros that select a lobe for ``fr_lobe``. Without ``small_slopes`` the exact lobe
    has its faster form, which is less accurate at small angles."""
    entry = lobe_entry(lobe)
    small = {} if small_slopes or not entry.of_tan2 else {"FR_SMALL_SLOPE": "0"}
    return {"FR_LOBE": entry.macro, **entry.macros, **small}


def term_macros(term: Term, smallest_m: float) -> dict[str, str]:
    """Return the macros that make the function of a model, such as ``fr_cook_torrance``, compute a
    term; ``smallest_m`` as in :func:`term_source`."""
    macros = lobe_macros(term.lobe, term.keeps_small_slopes(smallest_m))
    if term.entry.factors:
        macros["FR_FRESNEL"] = FRESNEL[term.fresnel].macro
        macros["FR_MASKING"] = MASKING[term.masking].macro
    if term.m is not None:
        macros["FR_SLOPE(m)"] = repr(float(term.m))
    return macros


def prelude(term: Term, smallest_m: float, two_lobes: bool = False) -> str:
    """Return the macros and the include that precede the call of a term in a program. For the
    parameters see :func:`term_source`."""
    macros = lobe_macros(term.lobe, term.keeps_small_slopes(smallest_m))
    if term.m is not None:
        macros["FR_CONSTANT_SLOPE"] = "1"
    return f'{defines(macros)}#include "facerender/{file_of(term, two_lobes)}.glsl"\n'


def file_of(term: Term, two_lobes: bool) -> str:
    """Return the name of the library file that a term needs, such as "ward"."""
    return _entry(term, two_lobes).file


def call(term: Term, second_slope: float | None = None) -> str:
    """Return a term's GLSL expression, in 1/sr, of the variables vec3 n, l, v and float m, f0.

    second_slope : ratio of the second lobe's m to the first lobe's m; the expression then also
        uses float second_m and lobe_weight. None for materials with one lobe
    """
    return _expression(_entry(term, second_slope is not None).call, term, second_slope)


def _entry(term: Term, two_lobes: bool) -> Entry:
    return (two_lobes and term.entry.two) or term.entry


def environment_call(term: Term, second_slope: float | None = None) -> str:
    """Return the GLSL expression of the radiance (vec3) that a term reflects from an environment.

    The expression uses vec3 n, v and float m, f0. For second_slope see :func:`call`. Raise
    InputError if the model does not support environment maps.
    """
    environment = term.entry.environment
    if environment is None:
        remedy = "set environment_samples to 0, or choose another model"
        problem = f"the model {term.model} has no specular term for environment maps"
        raise InputError(f"{problem}: {remedy}")
    return _expression(environment.call, term, second_slope)


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
