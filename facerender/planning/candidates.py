"""The shadings that a plan may choose in place of the full, exact shading of a scene.

Other modules compute costs and errors. This module does not use OpenGL.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from operator import attrgetter
from typing import Any

import numpy as np

from facerender.drawing.prepare import simplify
from facerender.drawing.resolve import resolve
from facerender.scenes.scene import Scene
from facerender.shading import SCATTER_SAMPLES, SMALL_SLOPE, Shading, Term
from facerender.terms import FRESNEL, LOBES, MASKING, MODELS, AnyLobe
from facerender.terms.fitting import G_POWERS, fit_g_power

# From this slope m on, float32 needs no FR_SMALL_SLOPE: the error without it, 3e-7/m² of the lobe's
# peak, is invisible.
SMALLEST_PLAIN_SLOPE = 0.1

# Attribute of a shading, keyed by the decision's name. If the model changes, all decisions of TERM
# count as one decision.
DECISIONS = {
    "two lobes": "two_lobes",
    "lights": "specular_lights",
    "shadows": "shadow_lights",
    "scattering": "scatter_samples",
    "normal map": "normal_map",
    "slope": "term.m",
    "specular weight": "ks",
    "ambient": "ambient",
    "environment": "environment_samples",
    "diffuse": "diffuse",
    "model": "term.model",
    "lobe": "term.lobe",
    "Fresnel": "term.fresnel",
    "masking": "term.masking",
    "small slopes": "term.small_slope",
}
_GET = {name: attrgetter(path) for name, path in DECISIONS.items()}
SINGLE = ("two lobes", "slope")  # one decision: a single lobe needs another slope than two lobes
_SLOPES = {"slope", "normal map"}  # decisions that change slopes
ENVIRONMENT_SAMPLES = (0, 8, 16, 32)
TERM = ("model", "lobe", "Fresnel", "masking", "small slopes")


@dataclass(frozen=True)
class Constants:
    """Constants that may replace maps, and orders in which lights may lose terms or shadows.

    Attributes
    ----------
    m, ks : mean slope and mean specular weight of the visible pixels
    faintest : indices of the lights, in the order in which they lose their specular terms: the
        light with the faintest highlight first
    shadows : indices of the lights with shadows, sorted by how much the shadow darkens the image,
        weakest first
    single : values of m with which a single lobe may replace two lobes
    """

    m: float
    ks: float
    faintest: tuple[int, ...]
    shadows: tuple[int, ...] = ()
    single: tuple[float, ...] = ()


def candidates(
    scene: Scene,
    full: Shading,
    constants: Constants,
    fits: Callable[[Shading], bool] = lambda _: True,
) -> Iterator[Shading]:
    """Yield every shading that may replace the full shading, and the full shading itself.

    Parameters
    ----------
    full : the shading that counts as exact; it has the exact lobe
    fits : function that returns whether a shading with one change is within the budget. It is
        called for each change, except changes of highlights, lobes, Fresnel and masking terms.
        Only changes that fit are combined with other changes, which limits their number
    """
    lit = [light for light in constants.faintest if full.shines(light)]
    kinds = [full.specular_lights, *(tuple(sorted(lit[n:])) for n in range(1, len(lit) + 1))]
    for surface in _surfaces(scene, full, constants, fits):
        for shading, lights in product(_terms(scene, surface), kinds):
            if lights == () and shading != surface:
                continue
            yield replace(shading, specular_lights=lights)


def _surfaces(
    scene: Scene, full: Shading, constants: Constants, fits: Callable[[Shading], bool]
) -> Iterator[Shading]:
    """Yield variants of the full shading; the specular terms keep all properties except m."""
    materials = scene.mesh.materials
    normal_maps, specular_maps = (
        any(getattr(material, name) is not None for material in materials)
        for name in ("normal_map", "specular_map")
    )
    means = [constants.m] if full.term.m is None else []
    single = constants.single if full.two_lobes else ()
    changes = [*((full.two_lobes, m) for m in means), *((False, m) for m in single)]
    slopes = [(full.two_lobes, full.term.m)]
    slopes += [(two, m) for two, m in changes if fits(full.replace(two_lobes=two, m=m))]
    cast = [tuple(sorted(constants.shadows[n:])) for n in range(1, len(constants.shadows) + 1)]
    scatters = any(material.scattering and material.diffuse_weight > 0.0 for material in materials)
    fewer = [count for count in SCATTER_SAMPLES if scatters and count < full.scatter_samples]
    reflects = scene.environment is not None and full.environment
    most = full.environment_samples if reflects else 0
    samples = [count for count in ENVIRONMENT_SAMPLES if count < most]

    replacements: dict[str, Iterable[Any]] = {
        "ks": [constants.ks] if full.ks is None and specular_maps else [],
        "shadow_lights": cast,
        "scatter_samples": fewer,
        "normal_map": [False] if full.normal_map and normal_maps else [],
        "ambient": [False] if full.ambient and np.any(scene.ambient) else [],
        "diffuse": {"lambert"} - {full.diffuse},
        "environment_samples": samples,
    }
    choices = {
        name: [getattr(full, name), *(v for v in values if fits(replace(full, **{name: v})))]
        for name, values in replacements.items()
    }
    for (two_lobes, m), *combination in product(slopes, *choices.values()):
        attributes = dict(zip(choices, combination, strict=True))
        yield replace(full, term=replace(full.term, m=m), two_lobes=two_lobes, **attributes)


def shadowed(scene: Scene, shading: Shading) -> list[int]:
    """Return the indices of the lights whose shadows the shading draws."""
    lights = simplify(scene, shading).lights
    return [index for index, light in enumerate(lights) if light.shadow]


def _terms(scene: Scene, full: Shading) -> Iterator[Shading]:
    ranges = resolve(scene, full).slopes
    smallest, largest = min(low for low, _ in ranges), max(high for _, high in ranges)
    family = full.term.entry.family
    for model in [model for model in MODELS.values() if model.family == family]:
        for lobe in _lobes(model.k, smallest, largest):
            for term in _factors(Term(model.name, lobe, m=full.term.m), full.term):
                yield replace(full, term=term)
                if lobe == "exact" and SMALLEST_PLAIN_SLOPE <= smallest < SMALL_SLOPE:
                    yield replace(full, term=replace(term, small_slope=False))


def _lobes(k: int, smallest: float, largest: float) -> list[AnyLobe]:
    slopes = (smallest, largest)
    first_name, *other_names = [
        name for name, lobe in LOBES.items() if lobe.belongs(slopes, k).all()
    ]
    fits = [fit_g_power(k, g, *slopes) for g in G_POWERS]
    # Of lobes with equal costs, the search takes the first: the exact lobe, or a fitted g-power.
    return [first_name, *(lobe for lobe in fits if lobe is not None), *other_names]


def _factors(term: Term, full: Term) -> Iterator[Term]:
    if not term.entry.factors:
        yield term
        return
    exactness = FRESNEL[full.fresnel].exactness
    allowed = [name for name, fresnel in FRESNEL.items() if fresnel.exactness <= exactness]
    for fresnel, masking in product(allowed, MASKING):
        yield replace(term, fresnel=fresnel, masking=masking)


def changed(shading: Shading, full: Shading) -> list[str]:
    """Return the names of the decisions in which two shadings differ."""
    return [name for name, get in _GET.items() if get(shading) != get(full)]


def groups(shading: Shading, full: Shading) -> dict[str, tuple[str, ...]]:
    """Return groups of decisions in which two shadings differ, keyed by each group's main decision.

    The group "model" has all decisions of TERM; the group "two lobes" includes the slope.
    """
    differs = changed(shading, full)
    together = {"two lobes": SINGLE, "model": TERM}
    joint_groups = {name: together[name] for name in differs if name in together}
    grouped = {decision for names in joint_groups.values() for decision in names}
    return {name: (name,) for name in differs if name not in grouped} | joint_groups


def values(shading: Shading, names: Sequence[str]) -> dict[str, Any]:
    """Return the values of the named decisions, keyed by the shading's attribute."""
    return {DECISIONS[name]: _GET[name](shading) for name in names}


def with_decisions(shading: Shading, other: Shading, names: Sequence[str]) -> Shading:
    """Return a shading whose named decisions are replaced by the decisions of ``other``."""
    decided = values(other, names)
    of_term = {path[5:]: decided.pop(path) for path in [*decided] if path.startswith("term.")}
    term = replace(shading.term, **of_term)
    return replace(shading, term=term, **decided)


def separable(shading: Shading, names: Sequence[str]) -> bool:
    """Return whether the named decisions may change and the lobe remain.

    Lobes other than the exact one are fitted to the slopes.
    """
    return shading.term.lobe == "exact" or not _SLOPES.intersection(names)


def alone(shading: Shading, full: Shading, names: Sequence[str]) -> Shading:
    """Return the full shading with only the named decisions taken from ``shading``."""
    # A g-power lobe is fitted to the chosen slope and is invalid for other slopes.
    base = with_decisions(full, shading, SINGLE) if "lobe" in names else full
    return with_decisions(base, shading, names)
