"""Public API of the BRDFs in float64: models, Fresnel and masking terms, sampling, slope variance.

``brdf.NAME`` is ``fr_NAME`` in GLSL, with the same arguments in the same order; see ``terms/``."""

from __future__ import annotations

from facerender.terms.albedo import cook_torrance_albedo, cook_torrance_albedo_mean, diffuse_coupled
from facerender.terms.environment import (
    environment_cook_torrance,
    environment_irradiance,
    environment_radiance,
    environment_ward,
)
from facerender.terms.fresnel import fresnel, fresnel_dielectric, fresnel_schlick
from facerender.terms.masking import MIN_COSINE, masking_kelemen, masking_v_cavity
from facerender.terms.model import (
    K_COOK_TORRANCE,
    K_WARD,
    cook_torrance,
    cook_torrance_two,
    ward,
    ward_printed,
)
from facerender.terms.sampling import (
    cook_torrance_pdf,
    cook_torrance_sample,
    slope_sample,
    ward_pdf,
    ward_sample,
)
from facerender.terms.slope_variance import (
    cosine_disc,
    slope_filtered,
    slope_variance_disc,
    slope_variance_map,
)

__all__ = [
    "K_COOK_TORRANCE",
    "K_WARD",
    "MIN_COSINE",
    "cook_torrance",
    "cook_torrance_albedo",
    "cook_torrance_albedo_mean",
    "cook_torrance_pdf",
    "cook_torrance_sample",
    "cook_torrance_two",
    "cosine_disc",
    "diffuse_coupled",
    "environment_cook_torrance",
    "environment_irradiance",
    "environment_radiance",
    "environment_ward",
    "fresnel",
    "fresnel_dielectric",
    "fresnel_schlick",
    "masking_kelemen",
    "masking_v_cavity",
    "slope_filtered",
    "slope_sample",
    "slope_variance_disc",
    "slope_variance_map",
    "ward",
    "ward_pdf",
    "ward_printed",
    "ward_sample",
]
