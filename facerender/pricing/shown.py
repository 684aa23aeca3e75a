"""The prices of what a page shows of a mesh, whose reader changes term, m, ks, lights and ambient
light: differences of ``Prices.cost``, where the sum stands."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import Any

from facerender.pricing.table import NoPrice, Prices
from facerender.scenes.light import LIGHT_KINDS, Light
from facerender.scenes.mesh import Mesh
from facerender.scenes.scene import Scene
from facerender.shading import SMALL_SLOPE, Shading, Term
from facerender.terms import FRESNEL, LOBES, MASKING, MODELS, AnyLobe, GPower
from facerender.terms.fitting import G_POWERS

# What takes the place of the mesh's own m: changes of the material, and of the term.
_Changes = dict[str, Any]
_SLOPES: dict[str, tuple[_Changes, _Changes]] = {
    "own": ({}, {}),
    "own plain": ({}, {"small_slope": False}),
    "small": ({"m": SMALL_SLOPE / 2.0}, {}),
    "plain": ({"m": SMALL_SLOPE}, {}),
    "constant small": ({}, {"m": SMALL_SLOPE / 2.0}),
    "constant plain": ({}, {"m": SMALL_SLOPE}),
}
_LIGHTS = [(), (Light(),), (Light(), Light())]
_AMBIENT = (0.0, 1.0)


def shown_prices(prices: Prices, mesh: Mesh) -> dict[str, Any]:
    """Return what a fragment of the mesh costs, apart, as data. Pairs are without ambient light and
    with it.

    lights
        of one light by kind, None where it has no price
    dull
        pair: of all but lights, where nothing is specular
    normal
        of normal maps, in all the others
    shining
        by m, "own", "small", "plain" (from SMALL_SLOPE on), "own plain" where the term has it that
        small slopes are not exact, and "constant" where the term has a slope of its own; then by
        ks, "own", "given", or "weight" in place of a map: ``fixed``, a pair as ``dull``, where
        lights have a specular term, and ``terms``, by name those terms, in the first light and in
        each further one; without those that have no price
    """
    first = Shading(two_lobes=False, scatter_samples=0)
    terms_shown = _terms()
    light = Light().kind.price

    def shining(drawn: Mesh, changes: _Changes) -> dict[str, Any]:
        lit = [Scene(drawn, lights=lights) for lights in _LIGHTS[1:]]
        fixed: list[float] = []
        terms = {}
        for name, term in terms_shown.items():
            shading = first.replace(term=replace(term, **changes))
            try:
                one, two = (prices.cost(scene, shading)[1] for scene in lit)
            except NoPrice:
                continue
            terms[name] = [six_digits(one), six_digits(two - one)]
            if not fixed:
                scenes = (Scene(drawn, lights=_LIGHTS[1], ambient=each) for each in _AMBIENT)
                costs = (prices.cost(scene, shading) for scene in scenes)
                fixed = [
                    six_digits(cost - specular - prices.parts[light]) for cost, specular in costs
                ]
        return {"fixed": fixed, "terms": terms}

    def by_weight(changes: tuple[_Changes, _Changes]) -> dict[str, Any]:
        of_material, of_term = changes
        drawn = mesh.with_material(**of_material)
        own = given = weight = shining(drawn, of_term)
        if not all(material.ks for material in drawn.materials):
            given = weight = shining(drawn.with_material(ks=1.0), of_term)
        if any(material.specular_map for material in drawn.materials):
            weight = shining(drawn.with_material(ks=1.0, specular_map=None), of_term)
        return {"own": own, "given": given, "weight": weight}

    dull = mesh.with_material(ks=0.0)
    unlit = [Scene(dull, lights=_LIGHTS[0], ambient=each) for each in _AMBIENT]
    whole, flat = (
        prices.cost(unlit[0], first.replace(normal_map=each))[0] for each in (True, False)
    )
    return {
        "lights": {kind.name: prices.parts.get(kind.price) for kind in LIGHT_KINDS.values()},
        "dull": [six_digits(prices.cost(scene, first)[0]) for scene in unlit],
        "normal": six_digits(whole - flat),
        "shining": {name: by_weight(changes) for name, changes in _SLOPES.items()},
    }


def _terms() -> dict[str, Term]:
    """Every term that a page may show, by the words in which it names it."""
    lobes: dict[str, AnyLobe] = {name: name for name in LOBES}
    lobes |= {f"g-power {g}": GPower(g, 0.27, 0.1) for g in G_POWERS}
    terms = {}
    for model, (name, lobe) in product(MODELS.values(), lobes.items()):
        if not model.factors:
            terms[f"{model.name} {name}"] = Term(model.name, lobe)
            continue
        for fresnel, masking in product(FRESNEL, MASKING):
            words = f"{model.name} {name} {fresnel} {masking}"
            terms[words] = Term(model.name, lobe, fresnel, masking)
    return terms


def six_digits(value: float) -> float:
    """Return a number as the page has it, in its data as in its links."""
    return float(f"{value:.6g}")
