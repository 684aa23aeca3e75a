"""BRDFs, Fresnel and masking terms, slope variance in float64, for users. ``brdf.f`` is ``fr_f`` in
GLSL, with the same arguments in the same order; see ``terms/``."""

from facerender.terms.fresnel import (
    fresnel,
    fresnel_dielectric,
    fresnel_schlick,
)
from facerender.terms.masking import masking_kelemen, masking_v_cavity
from facerender.terms.model import (
    K_COOK_TORRANCE,
    K_WARD,
    MIN_COSINE,
    cook_torrance,
    ward,
    ward_printed,
)
from facerender.terms.slope_variance import (
    cosine_disc,
    slope_filtered,
    slope_variance_disc,
    slope_variance_map,
    slope_variance_pixel,
)

__all__ = [
    "K_COOK_TORRANCE",
    "K_WARD",
    "MIN_COSINE",
    "cook_torrance",
    "cosine_disc",
    "fresnel",
    "fresnel_dielectric",
    "fresnel_schlick",
    "masking_kelemen",
    "masking_v_cavity",
    "slope_filtered",
    "slope_variance_disc",
    "slope_variance_map",
    "slope_variance_pixel",
    "ward",
    "ward_printed",
]
