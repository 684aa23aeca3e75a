"""GLSL code of specular terms: their macros, includes and calls."""

from __future__ import annotations

from collections.abc import Mapping

from facerender.errors import InputError
from facerender.shading import Term
from facerender.terms import FRESNEL, MASKING, AnyLobe, lobe_entry


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
    if term.entry.factors:
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


def file_of(term: Term, two_lobes: bool) -> str:
    """Return the name of the library file that a term needs, such as "ward"."""
    return term.entry.two.file if two_lobes and term.entry.two else term.entry.file


def call(term: Term, second_slope: float | None = None) -> str:
    """Return a term's GLSL expression, in 1/sr, of the variables vec3 n, l, v and float m, f0.

    second_slope : ratio of the second lobe's m to the first lobe's m; the expression then also
        uses float second_m and lobe_weight. None for materials with one lobe
    """
    if second_slope is not None and term.entry.two:
        m, second = _slopes(term, second_slope)
        return term.entry.two.call.format(m=m, second=second, **_names(term))
    return _lobes(term.entry.call, term, second_slope)


def environment_call(term: Term, second_slope: float | None = None) -> str:
    """Return the GLSL expression of the radiance (vec3) that a term reflects from an environment.

    The expression uses vec3 n, v and float m, f0. For second_slope see :func:`call`.

    Raises
    ------
    InputError : the model does not support environment maps
    """
    if term.entry.environment is None:
        raise InputError(
            f"the model {term.model} has no specular term for environment maps: set "
            "environment_samples to 0, or choose another model"
        )
    return _lobes(term.entry.environment.call, term, second_slope)


def _names(term: Term) -> dict[str, str]:
    """Return the names that the code of a call contains in braces, and their macros."""
    return {
        "lobe": lobe_entry(term.lobe).macro,
        "fresnel": FRESNEL[term.fresnel].macro,
        "masking": MASKING[term.masking].macro,
    }


def _slopes(term: Term, second_slope: float | None) -> tuple[str, str]:
    """Return m of both lobes as GLSL: numbers if the term has a constant m, otherwise variables.
    The second string is "" if there is one lobe."""
    second = None if second_slope is None else term.second(second_slope).slope("second_m")
    slopes = term.slope("m"), second or ""
    m, second_m = (x if isinstance(x, str) else repr(float(x)) for x in slopes)
    return m, second_m


def _lobes(code: str, term: Term, second_slope: float | None) -> str:
    """Return the call for one lobe, or for two lobes the weighted mean of both calls."""
    m, second = _slopes(term, second_slope)
    first_call, second_call = (code.format(m=slope, **_names(term)) for slope in (m, second))
    if not second:
        return first_call
    return f"lobe_weight * {first_call} + (1.0 - lobe_weight) * {second_call}"


def _macros(term: Term, smallest_m: float) -> dict[str, str]:
    """Return the macros that select the lobe of a term. FR_SMALL_SLOPE is 0 if the term has the
    exact lobe and needs no accurate small angles."""
    macros = lobe_macros(term.lobe)
    if lobe_entry(term.lobe).of_tan2 and not term.keeps_small_slopes(smallest_m):
        macros["FR_SMALL_SLOPE"] = "0"
    return macros
