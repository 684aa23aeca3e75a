"""The shadings that a plan chooses from: what may take the place of the exact, full one in a scene.
No OpenGL here, and nothing of what they cost or lose."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

from facerender import lobes
from facerender.brdf import Fresnel
from facerender.lobes import AnyLobe
from facerender.scenes.scene import Scene, slope_ranges
from facerender.shading import FRESNEL_TERMS, MASKING_TERMS, SMALL_SLOPE, Model, Shading
from facerender.terms.fitting import fit_g_power

G_POWERS = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 24)  # few products each
# Without FR_SMALL_SLOPE float32 errs by 3e-7/m² of the peak: from here on less than is seen.
SMALLEST_PLAIN_SLOPE = 0.1

# The fields of Shading that a decision is about, and its name; those of a term are decided together
# where the model changes.
DECISIONS: dict[str, tuple[str, ...]] = {
    "lights": ("specular_lights",),
    "frontal": ("frontal_lights",),
    "normal map": ("normal_map",),
    "slope": ("m",),
    "specular weight": ("ks",),
    "ambient": ("ambient",),
    "model": ("model",),
    "lobe": ("lobe",),
    "Fresnel": ("fresnel",),
    "masking": ("masking",),
    "small slopes": ("small_slope",),
}
TERM = ("model", "lobe", "Fresnel", "masking", "small slopes", "frontal")


@dataclass(frozen=True)
class Constants:
    """What may stand for a map all over a mesh, and the order in which lights may go.

    Attributes
    ----------
    m, ks : slope and specular weight, the means over what is seen
    faintest : indices of the lights by how bright their highlights are, the faintest first
    frontal : indices of the lights by how much the term of frontal light loses, the least first
    """

    m: float
    ks: float
    faintest: tuple[int, ...]
    frontal: tuple[int, ...] = ()


def candidates(scene: Scene, full: Shading, constants: Constants) -> Iterator[Shading]:
    """Yield every shading that may take the place of the full one, which is among them.

    Parameters
    ----------
    full : the exact lobe, and all that is to count
    """
    materials = scene.mesh.materials
    textured = {
        name: any(getattr(each, name) is not None for each in materials)
        for name in ("normal_map", "specular_map")
    }
    slopes: list[float | None] = [full.m]
    if full.m is None:
        slopes.append(constants.m)
    weights: list[float | None] = [full.ks]
    if full.ks is None and textured["specular_map"]:
        weights.append(constants.ks)
    kinds: list[tuple[int, ...] | None] = [full.specular_lights]
    kept = [light for light in constants.faintest if full.shines(light)]
    kinds += [tuple(sorted(kept[gone:])) for gone in range(1, len(kept) + 1)]
    for m, ks, normal_map, ambient in product(
        slopes,
        weights,
        {full.normal_map, full.normal_map and not textured["normal_map"]},
        {full.ambient, full.ambient and not any(scene.ambient)},  # type: ignore[arg-type]
    ):
        surface = replace(full, m=m, ks=ks, normal_map=normal_map, ambient=ambient)
        for shading in _terms(scene, surface):
            for lights in kinds:
                if lights == () and shading != surface:
                    continue
                lit = replace(shading, specular_lights=lights)
                yield lit
                if shading.model == "cook-torrance" and shading != shading.frontal:
                    near = set(full.frontal_lights)
                    order = [at for at in constants.frontal if lit.shines(at) and at not in near]
                    for count in range(1, len(order)):
                        yield replace(lit, frontal_lights=tuple(sorted(near.union(order[:count]))))


def _terms(scene: Scene, full: Shading) -> Iterator[Shading]:
    ranges = slope_ranges(full.simplify(scene))
    smallest, largest = min(low for low, _ in ranges), max(high for _, high in ranges)
    for model in _models(full):
        base = replace(
            full,
            model=model,
            fresnel="schlick",
            masking="v-cavity",
            small_slope=None,
            frontal_lights=full.frontal_lights if model == "cook-torrance" else (),
        )
        for lobe in _lobes(base.k, smallest, largest):
            for shading in _factors(replace(base, lobe=lobe), full):
                yield shading
                if lobe == "exact" and SMALLEST_PLAIN_SLOPE <= smallest < SMALL_SLOPE:
                    yield replace(shading, small_slope=False)


def _models(full: Shading) -> Sequence[Model]:
    return ("ward-printed",) if full.model == "ward-printed" else ("cook-torrance", "ward")


def _lobes(k: int, smallest: float, largest: float) -> list[AnyLobe]:
    ends = (smallest, largest)
    named: list[AnyLobe] = [name for name in lobes.NAMES if lobes.in_domain(ends, name, k).all()]
    fitted = [fit_g_power(k, g, *ends) for g in G_POWERS]
    # of the same cost the first is taken: exact, then what is fitted
    return [named[0], *(lobe for lobe in fitted if lobe is not None), *named[1:]]


def _factors(shading: Shading, full: Shading) -> Iterator[Shading]:
    if shading.model != "cook-torrance":
        yield shading
        return
    terms: dict[str, Sequence[Fresnel]] = {
        "dielectric": FRESNEL_TERMS,
        "schlick": ("schlick", "constant"),
        "constant": ("constant",),
    }
    for fresnel, masking in product(terms[full.fresnel], MASKING_TERMS):
        yield replace(shading, fresnel=fresnel, masking=masking)


def changed(shading: Shading, full: Shading) -> list[str]:
    """Return the decisions in which two shadings differ."""
    return [
        name
        for name, fields in DECISIONS.items()
        if any(getattr(shading, field) != getattr(full, field) for field in fields)
    ]


def groups(shading: Shading, full: Shading) -> dict[str, tuple[str, ...]]:
    """Return the decisions in which two shadings differ, each with those that go with it: the whole
    term with the model."""
    differs = changed(shading, full)
    if "model" not in differs:
        return {name: (name,) for name in differs}
    return {name: (name,) for name in differs if name not in TERM} | {"model": TERM}


def values(shading: Shading, names: Sequence[str]) -> dict[str, Any]:
    """Return the fields of some decisions."""
    return {field: getattr(shading, field) for name in names for field in DECISIONS[name]}


def with_decisions(shading: Shading, other: Shading, names: Sequence[str]) -> Shading:
    """Return a shading with some of the decisions of another."""
    return replace(shading, **values(other, names))


def alone(shading: Shading, full: Shading, names: Sequence[str]) -> Shading:
    """Return the full shading with some decisions of another by themselves."""
    # a g-power is fitted to the slope that was chosen, and means nothing at another
    base = replace(full, m=shading.m) if "lobe" in names else full
    return with_decisions(base, shading, names)
