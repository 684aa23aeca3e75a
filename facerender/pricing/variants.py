"""The specular terms and lobes whose cost is measured, as GLSL: the forms that Romanyuk et al.
(2020) print, and the library's. How they are measured is not told here."""

from __future__ import annotations

from facerender.glsl.code import defines, lobe_macros
from facerender.terms import LOBES, MODELS

SLOPE = 0.3  # of the terms that are priced

# Of the models that the paper prints, a call of the library's.
CALLS = {
    model.name: model.printed.replace("fr_printed_", "fr_")
    for model in MODELS.values()
    if model.printed
}
# Their lobes alone: E/c^4, and E from the angle.
_PRINTED_EXACT = {
    "cook-torrance": "exp((c * c - 1.0) / (m * m * c * c)) / (c * c * c * c)",
    "ward": "exp(-tan(acos(c)) * tan(acos(c)) / (m * m))",
}


def term(call: str, lobe: str, *lines: str) -> tuple[str, str]:
    """Return the prelude and the expression, in 1/sr, of a model's term.

    Parameters
    ----------
    call : the expression; its function names the file
    lobe : a name of ``terms.LOBES``
    lines : of GLSL, that stand before the include
    """
    folder = "printed" if "printed_" in call else "facerender"
    file = call.split("(")[0].removeprefix("fr_").removeprefix("printed_")
    chosen = defines(lobe_macros(lobe))
    return chosen + "\n".join([*lines, f'#include "{folder}/{file}.glsl"']), call


def terms(model: str) -> dict[str, tuple[str, str]]:
    """Return prelude and expression of each whole term by name, the printed forms first."""
    call = CALLS[model]
    printed = MODELS[model].printed
    result = {f"printed, {lobe}": term(printed, lobe) for lobe in ("exact", "d16")}
    for lobe in LOBES:
        result[lobe] = term(call, lobe)
        if lobe == "exact":
            result["exact, m >= 0.2"] = term(call, lobe, "#define FR_SMALL_SLOPE 0")
    return result


def lobe_terms(model: str) -> dict[str, tuple[str, str]]:
    """Return prelude and expression of each lobe alone, of float c and m, without a unit."""
    k = MODELS[model].k
    power = f"fr_printed_g_power(c, 2.0 / (m * m) - {k}.0, 16)"
    return {
        "printed, exact": ("", _PRINTED_EXACT[model]),
        "printed, d16": ('#include "printed/g_power.glsl"', power),
    } | {
        lobe: (
            f'{defines(lobe_macros(lobe))}#include "facerender/lobe.glsl"',
            f"fr_lobe(c, m, {k})",
        )
        for lobe in LOBES
    }
