"""An upper bound of what a shading changes, over every view of a scene's materials and lights. It
holds for cameras that nobody has thought of, and is loose. No OpenGL here.

Towards grazing angles both models grow as 1/(N.V), up to 1/FR_MIN_COSINE: a change of the specular
term has no small bound there. What a guarantee lets through is what changes nothing, such as
constants in place of values that are the same everywhere, or what contributes next to nothing.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from facerender import brdf, lobes
from facerender.lobes import AnyLobe
from facerender.planning.budget import Budget
from facerender.scenes.material import Material
from facerender.scenes.scene import Scene, slope_ranges
from facerender.shading import Shading

Range = tuple[float, float]

_COSINES = np.cos(np.linspace(0.0, 0.5 * np.pi, 2001)).clip(0.0, 1.0)


def bound(scene: Scene, shading: Shading, full: Shading, budget: Budget) -> float:
    """Return an upper bound, in the budget's unit, of the error of a shading at any camera.

    Raises
    ------
    InputError : a budget in FLIP, which has no such bound
    """
    worst = 0.0
    for material, slopes, chosen in zip(
        scene.mesh.materials,
        slope_ranges(full.simplify(scene)),
        slope_ranges(shading.simplify(scene)),
        strict=True,
    ):
        radiance = 0.0
        if shading.ambient != full.ambient:
            radiance = material.kd / np.pi * max(material.albedo) * np.max(scene.ambient)
        if shading.normal_map != full.normal_map and material.normal_map is not None:
            radiance = np.inf
        weight = max(_weight(material, each) for each in (shading, full))
        ceiling = weight * _ceiling((min(*slopes, *chosen), max(*slopes, *chosen)))
        changed = ceiling  # radiance is not negative: two differ by the larger one at most
        if (
            slopes == chosen
            and shading.model == full.model
            and _same_weight(material, shading, full)
        ):
            changed = weight * _specular(material, slopes, shading, full)
        for light, source in enumerate(scene.lights):
            same = (light in shading.frontal_lights) == (light in full.frontal_lights)
            share = changed if shading.shines(light) and same else ceiling
            # a point light may be as near as one likes
            irradiance = np.inf if source.position else np.max(source.irradiance)
            if full.shines(light) and share and irradiance:
                radiance += irradiance * share
        worst = max(worst, float(radiance))
    return budget.bound(worst)


def _same_weight(material: Material, shading: Shading, full: Shading) -> bool:
    mapped = material.specular_map is not None and (shading.ks is None or full.ks is None)
    same = _weight(material, shading) == _weight(material, full)
    return shading.ks == full.ks or (same and not mapped)


def _specular(material: Material, slopes: Range, shading: Shading, full: Shading) -> float:
    """Bound the change of the specular radiance for an irradiance of 1 and a weight of 1, by other
    terms of one model."""
    lobe = _lobe_error(shading.lobe, full.lobe, slopes, full.k)
    factors = 0.0
    if full.model == "cook-torrance":
        terms = [brdf.fresnel(material.f0, _COSINES, each.fresnel) for each in (shading, full)]
        factors = float(np.abs(np.subtract(*terms)).max()) + (shading.masking != full.masking)
    return _scale(slopes) * lobe + min(factors, 1.0) * _ceiling(slopes)


@lru_cache(maxsize=4096)
def _lobe_error(lobe: AnyLobe, other: AnyLobe, slopes: Range, k: int) -> float:
    m = np.linspace(*slopes, 9)[:, None]
    near = np.cos(np.arctan(m * np.linspace(0.0, 8.0, 2001)))  # where a small slope's lobe is
    c = np.concatenate([near, np.broadcast_to(_COSINES, near.shape)], axis=-1)
    values = [lobes.lobe(each, c, m, k) for each in (lobe, other)]
    return float(np.abs(np.subtract(*values)).max())


def _weight(material: Material, shading: Shading) -> float:
    return material.ks if shading.ks is None else shading.ks


def _scale(slopes: Range) -> float:
    """What a lobe of height 1 can make of an irradiance of 1: N.L G/((N.L)(N.V)) is at most 1/N.V
    with every masking term here, and sqrt(N.L/N.V) of Ward less."""
    return 1.0 / (4.0 * np.pi * slopes[0] ** 2 * brdf.MIN_COSINE)


def _ceiling(slopes: Range) -> float:
    """The largest specular radiance for an irradiance of 1 and a weight of 1. Above m = 0.7071 the
    exact lobe is highest off the normal, and below it at 1, as all others."""
    w = max(slopes[1] ** 2, 0.5)
    return _scale(slopes) * 4.0 * w**2 * float(np.exp(1.0 / w - 2.0))
