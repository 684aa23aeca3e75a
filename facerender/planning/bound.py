"""An upper bound of what a shading changes, over every view of a scene's materials and lights. It
holds for cameras that nobody has thought of, and is loose. No OpenGL here.

Towards grazing angles both models grow as 1/(N.V), up to 1/FR_MIN_COSINE: a change of the specular
term has no small bound there. What a guarantee lets through is what changes nothing, such as
constants in place of values that are the same everywhere, or what contributes next to nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache

import numpy as np

from facerender.drawing.resolve import resolve
from facerender.errors import InputError
from facerender.planning.budget import Budget
from facerender.planning.candidates import shadowed
from facerender.scenes.light import Light
from facerender.scenes.material import Material
from facerender.scenes.scene import Scene
from facerender.shading import Shading, Term
from facerender.terms import FRESNEL, MASKING, AnyLobe, lobe_entry
from facerender.terms.masking import MIN_COSINE

Range = tuple[float, float]

_COSINES = np.cos(np.linspace(0.0, 0.5 * np.pi, 2001)).clip(0.0, 1.0)


class Unbounded(InputError):
    """A term or a kind of light of which nobody has told what it is at most."""


def bound(scene: Scene, shading: Shading, full: Shading, budget: Budget) -> float:
    """Return an upper bound, in the budget's unit, of the error of a shading at any camera.

    Raises
    ------
    Unbounded : a term or a kind of light of which nobody has told what it is at most
    InputError : a budget in FLIP, which has no such bound
    """
    lit = [(light, shading.of(i), full.of(i)) for i, light in enumerate(scene.lights)]
    for light, *both in lit:
        _check_known(light, [term for term in both if term])
    worst = 0.0
    for material, slopes in zip(scene.mesh.materials, resolve(scene, full).slopes, strict=True):
        radiance = 0.0
        if shading.ambient != full.ambient:
            radiance = material.kd / np.pi * max(material.albedo) * np.max(scene.ambient)
        if _coupling(shading) != _coupling(full):  # two factors in [0, 2]
            received = sum(_highest(light) for light, *_ in lit) + np.max(scene.ambient)
            radiance += 2.0 * material.kd / np.pi * max(material.albedo) * received
        switches = ["curvature"]
        if material.normal_map is not None:
            switches += ["normal_map", "slope_filter"]
        if any(getattr(shading, each) != getattr(full, each) for each in switches):
            radiance = np.inf
        if shadowed(scene, shading) != shadowed(scene, full):
            radiance = np.inf
        if material.scattering and shading.scatter_samples != full.scatter_samples:
            radiance = np.inf
        if scene.environment is not None and _around(shading) != _around(full):
            radiance = np.inf
        weight = max(_weight(material, each) for each in (shading, full))
        same_weight = _same_weight(material, shading, full)
        for light, own, other in lit:
            terms = {
                term: _slopes(term, slopes, material) for term in (own, other) if term is not None
            }
            irradiance = _highest(light)
            if not terms or not irradiance:
                continue
            # radiance is not negative: two differ by the larger one at most
            share = weight * max(_ceiling(term, ends) for term, ends in terms.items())
            lobes = shading.two_lobes == full.two_lobes or not material.two_lobes
            if own and other and _alike(own, other, terms) and same_weight and lobes:
                share = weight * _specular(material, terms[own], own, other)
            if share:
                radiance += irradiance * share
        worst = max(worst, float(radiance))
    return budget.bound(worst)


def _coupling(shading: Shading) -> object:
    """What diffuse light depends on beside the material."""
    if shading.diffuse == "lambert":
        return None
    return shading.term.m, shading.lights, shading.ks, shading.two_lobes


def _around(shading: Shading) -> object:
    """What the radiance of the environment depends on beside the material."""
    term = shading.term
    reflecting = (term.model, term.fresnel, term.masking, term.m, shading.ks, shading.two_lobes)
    samples = shading.environment_samples
    return shading.environment, samples, reflecting if samples else (), _coupling(shading)


def _slopes(term: Term, slopes: Range, material: Material) -> Range:
    """Of all lobes that there may be: two together are between what each alone would be."""
    return slopes if term.m is None else material.with_second(term.m, term.m)


def _alike(term: Term, other: Term, slopes: Mapping[Term, Range]) -> bool:
    return term.model == other.model and slopes[term] == slopes[other]


def _same_weight(material: Material, shading: Shading, full: Shading) -> bool:
    mapped = material.specular_map is not None and (shading.ks is None or full.ks is None)
    same = _weight(material, shading) == _weight(material, full)
    return shading.ks == full.ks or (same and not mapped)


def _specular(material: Material, slopes: Range, term: Term, other: Term) -> float:
    """Bound the change of the specular radiance for an irradiance of 1 and a weight of 1, by other
    terms of one model."""
    model = term.entry
    lobe = _lobe_error(term.lobe, other.lobe, slopes, model.k)
    factors = 0.0
    if model.factors:
        fresnel = [FRESNEL[each.fresnel].evaluate(material.f0, _COSINES) for each in (term, other)]
        factors = float(np.abs(np.subtract(*fresnel)).max()) + (term.masking != other.masking)
    return _scale(term, slopes) * lobe + min(factors, 1.0) * _ceiling(other, slopes)


@lru_cache(maxsize=4096)
def _lobe_error(lobe: AnyLobe, other: AnyLobe, slopes: Range, k: int) -> float:
    m = np.linspace(*slopes, 9)[:, None]
    near = np.cos(np.arctan(m * np.linspace(0.0, 8.0, 2001)))  # where a small slope's lobe is
    c = np.concatenate([near, np.broadcast_to(_COSINES, near.shape)], axis=-1)
    values = [lobe_entry(each).evaluate(c, m, k) for each in (lobe, other)]
    return float(np.abs(np.subtract(*values)).max())


def _weight(material: Material, shading: Shading) -> float:
    return material.ks if shading.ks is None else shading.ks


def _scale(term: Term, slopes: Range) -> float:
    """What a lobe of height 1 can make of an irradiance of 1, at N.V >= MIN_COSINE."""
    model = term.entry
    assert model.at_most is not None
    return model.at_most(slopes[0]) / MIN_COSINE


def _ceiling(term: Term, slopes: Range) -> float:
    """The largest specular radiance for an irradiance of 1 and a weight of 1."""
    lobe = lobe_entry(term.lobe)
    assert lobe.highest is not None
    return _scale(term, slopes) * lobe.highest(slopes[1], term.entry.k)


def _highest(light: Light) -> float:
    kind = light.kind
    assert kind.highest is not None
    return kind.highest(light)


def _check_known(light: Light, terms: Sequence[Term]) -> None:
    """A bound of what nobody has bounded would be silently wrong."""
    known = {f"{light.kind.name} lights": light.kind.highest is not None}
    for term in terms:
        lobe = lobe_entry(term.lobe)
        known |= {
            f"the model {term.model}": term.entry.at_most is not None,
            f"the lobe {lobe.name}": lobe.highest is not None,
            f"the Fresnel term {term.fresnel}": FRESNEL[term.fresnel].at_most_1,
            f"the masking term {term.masking}": MASKING[term.masking].at_most_1,
        }
    for name, is_known in known.items():
        if not is_known:
            raise Unbounded(
                f"nothing is known of how large {name} may become: a guarantee needs it; leave "
                "the guarantee out, and the error is measured at cameras"
            )
