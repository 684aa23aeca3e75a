"""Public API of the lobes in float64: E/c^k, its approximations and their domains.

The lobe ``lobes.NAME`` is ``fr_lobe_NAME`` in GLSL; see ``terms/lobe.py``."""

from facerender.terms.lobe import (
    FITTED,
    LOBES,
    MAX_SLOPE,
    MIN_SLOPE,
    AnyLobe,
    GPower,
    PowerPolynomial,
    check_slope,
    clamped_power,
    cosine,
    exact,
    exact_tan2,
    fitted,
    fitted_coefficients,
    fitted_fine,
    fitted_fine_coefficients,
    g_power,
    in_domain,
    lobe,
    max_slope,
)

NAMES = tuple(LOBES)

__all__ = [
    "FITTED",
    "LOBES",
    "MAX_SLOPE",
    "MIN_SLOPE",
    "NAMES",
    "AnyLobe",
    "GPower",
    "PowerPolynomial",
    "check_slope",
    "clamped_power",
    "cosine",
    "exact",
    "exact_tan2",
    "fitted",
    "fitted_coefficients",
    "fitted_fine",
    "fitted_fine_coefficients",
    "g_power",
    "in_domain",
    "lobe",
    "max_slope",
]
