"""Writes the files of the library that choose among terms, from the registry.

python -m facerender.glsl.dispatch      writes lobe.glsl, fresnel.glsl and masking.glsl anew
"""

from __future__ import annotations

from collections.abc import Iterable

from facerender.glsl.library import shader_dir
from facerender.terms import FRESNEL, LOBES, MASKING, Fresnel, Masking
from facerender.terms.lobe import GPower, lobe_entry

G_POWER = lobe_entry(GPower(8, 0.25))
_OTHERS = {"FR_LOBE_OWN": 90, "FR_LOBE_EVERY": 91}

_LOBE = """\
// The lobe that the host chooses: at compile time, #define FR_LOBE FR_LOBE_D16, or call by call,
// with a constant that the compiler folds. Default: exact.
//
//   formula E/c^k, E = exp(-tan^2(gamma)/m^2), or what the chosen lobe puts in its place
//   c       cosine of the angle between normal and half vector, in [0, 1]
//   m       rms slope, in the domain of the chosen lobe
//   k       FR_K_COOK_TORRANCE or FR_K_WARD
//   lobe    FR_LOBE_EXACT or another of the macros below, a constant. Only the lobe that FR_LOBE
//           says is there: another gives -1. With #define FR_LOBE FR_LOBE_EVERY all are there, and
//           functions without this argument have the exact one
//   unit    none: peak 1 at c = 1; the caller multiplies by the model's scale
//   error   of the chosen lobe: see lobe/*.glsl
//   source  see lobe/*.glsl
//
// A lobe of the host's own: declare float my_lobe(float c, float m, int k), and before the include
// #define FR_LOBE_FUNCTION my_lobe.
//
// Written by python -m facerender.glsl.dispatch.
#ifndef FR_LOBE_GLSL
#define FR_LOBE_GLSL

#include "constants.glsl"

{numbers}

// Numbers: preprocessors that compare macros as text (Babylon.js, PlayCanvas) see through no name.
#if defined(FR_LOBE_FUNCTION) && !defined(FR_LOBE)
#define FR_LOBE {own}
#endif
#ifndef FR_LOBE
#define FR_LOBE {exact}
#endif

#if {known}
#else
#error FR_LOBE is none of {names}: give the number where a host compares macros as text
#endif
#if FR_LOBE == FR_LOBE_OWN && !defined(FR_LOBE_FUNCTION)
#error FR_LOBE_OWN is the lobe that FR_LOBE_FUNCTION names: define it too
#endif
#if FR_LOBE == FR_LOBE_EVERY
#define FR_DEFAULT_LOBE FR_LOBE_EXACT
#else
#define FR_DEFAULT_LOBE FR_LOBE
#endif

{includes}

// With FR_LOBE_G_POWER the power, in 1 to 31, and the steepness that the host fitted; by default
// those of D8.
#ifndef FR_G
#define FR_G 8
#endif
#ifndef FR_STEEPNESS
#define FR_STEEPNESS(m, k) ((2.0 / ((m) * (m)) - float(k)) / float(FR_G))
#endif

// Lobe within a BRDF, which has 1/m^2 already, of the kind that the caller names by a constant.
//
//   inverse_m2  1/m^2
float fr_lobe_within(float c, float m, float inverse_m2, int k, int lobe) {{
{branches}
#ifdef FR_LOBE_FUNCTION
    if (lobe == FR_LOBE_OWN) return FR_LOBE_FUNCTION(clamp(c, 0.0, 1.0), m, k);
#endif
    return -1.0;
}}

// Lobe, of the kind that the caller names by a constant.
float fr_lobe_of(float c, float m, int k, int lobe) {{
    return fr_lobe_within(c, m, 1.0 / (FR_SLOPE(m) * FR_SLOPE(m)), k, lobe);
}}

// Lobe, as the host chose it: #define FR_LOBE FR_LOBE_D16.
float fr_lobe(float c, float m, int k) {{
    return fr_lobe_of(c, m, k, FR_DEFAULT_LOBE);
}}

#endif
"""

_FRESNEL = """\
// Fresnel reflectance of a dielectric in air, for unpolarised light. The host chooses the one that
// fr_fresnel calls: #define FR_FRESNEL FR_FRESNEL_DIELECTRIC. Default: Schlick.
//
//   formula   of the chosen one: see fresnel/*.glsl; with FR_FRESNEL_CONSTANT f0
//   f0        reflectance at normal incidence, in [0, 1); skin: 0.028, index of refraction 1.4
//   v_dot_h   cosine between the eye (or the light) and the unit half vector, in [0, 1]
//   fresnel   {macros}, a constant
//   unit      none, in [0, 1]
//   error     of the chosen one; f0 alone is 1 - f0 too low at 90 degrees
//   source    of the chosen one
//
// Written by python -m facerender.glsl.dispatch.
#ifndef FR_FRESNEL_GLSL
#define FR_FRESNEL_GLSL

#include "constants.glsl"
{includes}

{numbers}

#ifndef FR_FRESNEL
#define FR_FRESNEL FR_FRESNEL_SCHLICK
#endif

// Fresnel reflectance, of the kind that the caller names by a constant.
float fr_fresnel_of(float f0, float v_dot_h, int fresnel) {{
{branches}
}}

// Fresnel reflectance times a constant, of the kind that the caller names by another.
//
//   scale     in (0, 1], a constant
//   unit      none, in [0, scale]
float fr_fresnel_times(float scale, float f0, float v_dot_h, int fresnel) {{
{times}
}}

// Fresnel reflectance, as the host chose it: #define FR_FRESNEL FR_FRESNEL_DIELECTRIC.
float fr_fresnel(float f0, float v_dot_h) {{
    return fr_fresnel_of(f0, v_dot_h, FR_FRESNEL);
}}

#endif
"""

_MASKING = """\
// Masking and shadowing of microfacets. The host chooses the one that fr_cook_torrance has within
// its one division: #define FR_MASKING FR_MASKING_KELEMEN, or FR_MASKING_NONE, which is 1 and lets
// the BRDF grow as 1/(N.V) towards the silhouette. Default: V-cavities.
//
//   formula            G/((N.L)(N.V)) = x/(y h.h), of the chosen one
//   n_dot_h, h_dot_h   dot(n, h) and dot(h, h) of h = l + v, which keeps its length
//   n_dot_l, n_dot_v   cosines of light and eye, in [-1, 1]
//   masking            {macros}, a constant
//   unit               none; x >= 0, and 0 where a cosine is not above 0 (with FR_MASKING_KELEMEN
//                      and _NONE, FR_MIN_COSINE); y > 0
//   error              of each: see masking/*.glsl
//   source             of each: see there
//
// Written by python -m facerender.glsl.dispatch.
#ifndef FR_MASKING_GLSL
#define FR_MASKING_GLSL

#include "constants.glsl"
{includes}

{numbers}

#ifndef FR_MASKING
#define FR_MASKING FR_MASKING_V_CAVITY
#endif

// Masking over the divisor of a BRDF, as numerator and denominator, of the kind that the caller
// names by a constant.
vec2 fr_masking_of(float n_dot_h, float h_dot_h, float n_dot_l, float n_dot_v, int masking) {{
{branches}
}}

#endif
"""


def dispatch() -> dict[str, str]:
    """Return the text of each file, by the name of the file in the library."""
    return {
        "lobe": _lobe(),
        "fresnel": _factor(_FRESNEL, FRESNEL.values(), "fresnel", "schlick"),
        "masking": _factor(_MASKING, MASKING.values(), "masking", "v-cavity"),
    }


def _lobe() -> str:
    calls = {lobe.macro: lobe.within for lobe in (*LOBES.values(), G_POWER)}
    files: dict[str, list[str]] = {}
    for lobe in (*LOBES.values(), G_POWER):
        files.setdefault(lobe.file, []).append(lobe.macro)
    numbers = {lobe.macro: lobe.number for lobe in (*LOBES.values(), G_POWER)} | _OTHERS
    names = ", ".join(f"{number} {macro}" for macro, number in numbers.items())
    return _LOBE.format(
        numbers="\n".join(f"#define {macro} {number}" for macro, number in numbers.items()),
        own=numbers["FR_LOBE_OWN"],
        exact=numbers["FR_LOBE_EXACT"],
        known=" || ".join(f"FR_LOBE == {macro}" for macro in numbers),
        names=names,
        includes="\n".join(_where(macros, _include(file)) for file, macros in files.items()),
        branches="\n".join(
            _where([macro], f"    if (lobe == {macro}) return {call};")
            for macro, call in calls.items()
        ),
    )


def _where(macros: list[str], line: str) -> str:
    """Return a line that is there for some lobes."""
    chosen = " || ".join(f"FR_LOBE == {macro}" for macro in [*macros, "FR_LOBE_EVERY"])
    return f"#if {chosen}\n{line}\n#endif"


def _factor(text: str, terms: Iterable[Fresnel | Masking], kind: str, default: str) -> str:
    """Fill the template of terms that are all there; the default is what any other number gives."""
    terms = list(terms)
    macros = [term.macro for term in terms]
    files = dict.fromkeys(term.file for term in terms if term.file != "constants")
    last = next(term for term in terms if term.name == default)
    others = [term for term in reversed(terms) if term is not last]

    def branches(code: str) -> str:
        lines = [
            f"    if ({kind} == {term.macro}) return {getattr(term, code)};" for term in others
        ]
        return "\n".join([*lines, f"    return {getattr(last, code)};"])

    prefix = f"FR_{kind.upper()}"
    return text.format(
        macros=", ".join([macros[0], *(macro.removeprefix(prefix) for macro in macros[1:])]),
        includes="\n".join(map(_include, files)),
        numbers="\n".join(f"#define {term.macro} {term.number}" for term in terms),
        branches=branches("call"),
        times=branches("times") if "{times}" in text else "",
    )


def _include(file: str) -> str:
    return f'#include "{file}.glsl"'


def main() -> None:
    for name, text in dispatch().items():
        (shader_dir() / f"facerender/{name}.glsl").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
