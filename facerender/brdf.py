"""BRDFs, Fresnel and masking terms in float64, for users. ``brdf.f`` is ``fr_f`` in GLSL, with the
same arguments in the same order; see ``terms/model.py``."""

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
    cook_torrance_two,
    ward,
    ward_printed,
)

__all__ = [
    "K_COOK_TORRANCE",
    "K_WARD",
    "MIN_COSINE",
    "cook_torrance",
    "cook_torrance_two",
    "fresnel",
    "fresnel_dielectric",
    "fresnel_schlick",
    "masking_kelemen",
    "masking_v_cavity",
    "ward",
    "ward_printed",
]
