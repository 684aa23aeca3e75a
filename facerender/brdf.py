"""Public API of the BRDFs in float64: models, Fresnel and masking terms, sampling, slope variance.

``brdf.NAME`` is ``fr_NAME`` in GLSL, with the same arguments in the same order; see ``terms/``."""

from __future__ import annotations

from facerender.terms.environment import (
    cook_torrance_albedo,
    cook_torrance_albedo_mean,
    cook_torrance_pdf,
    cook_torrance_sample,
    diffuse_coupled,
    environment_cook_torrance,
    environment_irradiance,
    environment_radiance,
    environment_ward,
    slope_sample,
    ward_pdf,
    ward_sample,
)
from facerender.terms.model import (
    K_COOK_TORRANCE,
    K_WARD,
    MIN_COSINE,
    cook_torrance,
    cook_torrance_two,
    cosine_disc,
    fresnel,
    fresnel_dielectric,
    fresnel_schlick,
    masking_kelemen,
    masking_v_cavity,
    slope_filtered,
    slope_variance_disc,
    slope_variance_map,
    ward,
    ward_printed,
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
