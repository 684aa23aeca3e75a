"""Price of a shading per fragment, as a sum of the prices of its parts.

The parts are the renderer's program, its maps and lights (``fragment.py``), the specular term of
the first light, and the term of each further light, which shares values with the first.
``python -m benchmarks.prices table`` writes the table ``prices.json`` in the repository;
``measured`` measures the prices on this machine.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

from facerender.drawing.resolve import Lighting, ResolvedScene, resolve
from facerender.errors import InputError, check_known
from facerender.glsl.code import call, prelude
from facerender.pricing.variants import SLOPE
from facerender.scenes.light import LIGHT_KINDS
from facerender.scenes.material import Material
from facerender.scenes.mesh import Part
from facerender.scenes.scene import Scene
from facerender.shading import Shading, Term
from facerender.terms import lobe_entry

TABLE = Path(__file__).with_name("prices.json")
FRAME = "frame"  # prices whole frames; see ``planning/frame_times.py``
HERE = "here"

Pair = tuple[float, float]
Terms = Mapping[str, Pair]
P = TypeVar("P")


class NoPrice(InputError):
    """The prices lack a term, or another part such as a kind of light."""


@dataclass(frozen=True)
class Prices:
    """Prices of one driver or GPU.

    Attributes
    ----------
    source : origin of the prices, as text
    unit : unit of all prices
    parts : prices of ``fragment.PARTS`` without the specular terms, and of ``scatter.PARTS``
    terms : two prices of each specular term, keyed by :func:`term_name`: the price for the first
        light with a specular term, and the price for each further light. The same two prices of
        each second lobe, keyed by :func:`second_name`
    """

    source: str
    unit: str
    parts: Mapping[str, float]
    terms: Terms

    def cost(self, scene: Scene, shading: Shading) -> tuple[float, float]:
        """Return the cost of a fragment of the scene, and the specular part of this cost.

        With several mesh parts, return the mean weighted by the parts' numbers of faces.

        Raises
        ------
        NoPrice : a term has no price
        """
        resolved = resolve(scene, shading)
        simple = resolved.scene
        lights = self._lights(resolved.lighting)
        total = specular = faces = 0.0
        for part, material, (smallest, _) in zip(
            simple.mesh.parts, simple.mesh.materials, resolved.slopes, strict=True
        ):
            cost, shine = self._part(resolved, part, material, lights, smallest)
            faces += len(part.faces)
            total += len(part.faces) * cost
            specular += len(part.faces) * shine
        return total / faces, specular / faces

    def _lights(self, lighting: Lighting) -> float:
        kinds = [(group, LIGHT_KINDS[group.kind]) for group in lighting.groups]
        lights = sum(group.count * self._priced(self.parts, kind.price) for group, kind in kinds)
        return lights + sum(
            group.count * self._priced(self.parts, kind.shadow_price)
            for group, kind in kinds
            if group.shadows is not None
        )

    def _part(
        self,
        resolved: ResolvedScene,
        part: Part,
        material: Material,
        lights: float,
        smallest: float,
    ) -> tuple[float, float]:
        """Return :meth:`cost` for one mesh part; ``lights`` is the cost of all lights without their
        specular terms, ``smallest`` the smallest slope m of the part."""
        scene, shading, count = resolved.scene, resolved.shading, resolved.lighting.shining
        shine = 0.0
        if material.ks and count:
            shine = self._specular(term_name(shading.term, smallest), count)
            if material.two_lobes:
                shine += self._specular(second_name(shading.term, smallest), count)
        diffuse = material.diffuse_weight > 0.0
        ambient = diffuse and any(scene.ambient)  # type: ignore[arg-type]
        coupled = shading.diffuse == "coupled" and diffuse and material.ks > 0.0
        cost = self.parts["base program"] + shine + lights
        if coupled:
            cost += self._priced(self.parts, "coupled diffuse")
            cost += len(scene.lights) * self._priced(self.parts, "light of coupled diffuse")
        environment = scene.environment is not None
        if environment:
            cost += self._priced(self.parts, "environment")
        if environment and material.ks and shading.environment_samples:
            lobe_cost = shading.environment_samples * self._priced(self.parts, "environment sample")
            reflected = (1 + material.two_lobes) * lobe_cost
            cost, shine = cost + reflected, shine + reflected
        occluded = ambient or (environment and diffuse)
        cost += self._maps(part, material, occluded, shine > 0.0 or coupled)
        cost += self.parts["ambient term"] * ambient
        if material.scattering and diffuse:
            cost += self._priced(self.parts, "scattering")
            cost += shading.scatter_samples * self._priced(self.parts, "sample of scattering")
        return cost, shine

    def _specular(self, name: str, lights: int) -> float:
        first, further = self._priced(self.terms, name)
        return sum([first, *[further] * (lights - 1)])

    def _priced(self, prices: Mapping[str, P], name: str) -> P:
        if name not in prices:
            raise NoPrice(
                f"{name} has no price in {self.source}: measure it with --cost here, or update the "
                "table in a checkout with python -m benchmarks.prices table"
            )
        return prices[name]

    def _maps(self, part: Part, material: Material, ambient: bool, shines: bool) -> float:
        if part.uv is None:
            return 0.0
        occlusion = (material.occlusion_map,) * ambient
        read = (*occlusion, *(material.roughness_map, material.specular_map) * shines)
        has = {
            "albedo map": material.albedo_map is not None and material.diffuse_weight > 0.0,
            "normal map": material.normal_map is not None,
            "property map": any(texture is not None for texture in read),
        }
        cost = sum(self.parts[name] for name, is_there in has.items() if is_there)
        if shines and material.two_lobes and material.lobe_map is not None:
            cost += self.parts["property map"]  # for the lobe map
        return cost


def load_prices(
    kind: str, scene: Scene, shadings: Iterable[Shading], software: bool = False
) -> Prices:
    """Return the prices of a driver or GPU that given shadings of a scene need.

    Parameters
    ----------
    kind : "llvmpipe", "navi21" (RDNA2) or "vega10" (GCN5) from the table; "auto" and "frame" choose
        llvmpipe if the CPU draws, otherwise navi21; "here" measures on this machine, which takes
        up to a minute

    Raises
    ------
    InputError : an unknown kind
    ContextError : no OpenGL context to measure in
    """
    table = shipped()
    if kind in (FRAME, "auto"):
        kind = "llvmpipe" if software else "navi21"
    if kind in table:
        return table[kind]
    check_known("cost", kind, [FRAME, "auto", *table, HERE])
    terms: dict[str, Term] = {}
    seconds: dict[str, Term] = {}
    two_lobes = any(material.two_lobes for material in scene.mesh.materials)
    for shading in shadings:
        if Lighting.of(scene, shading).shining:
            terms |= variants(shading.term)
            if two_lobes and shading.two_lobes:
                seconds |= second_variants(shading.term)
    terms |= {term_name(second, SLOPE): second for second in seconds.values()}
    return measured(terms, seconds=seconds)


def shipped() -> dict[str, Prices]:
    """Return the prices of the table ``prices.json``, keyed by driver or GPU."""
    table = json.loads(TABLE.read_text(encoding="utf-8"))
    return {kind: Prices(**prices) for kind, prices in table.items()}


def term_name(term: Term, smallest_m: float) -> str:
    """Return the key of a specular term in :attr:`Prices.terms`; terms of equal cost share it."""
    lobe = lobe_entry(term.lobe)
    words = [term.model, lobe.price]
    if term.entry.factors:
        words += [term.fresnel, term.masking]
    if lobe.of_tan2 and not term.keeps_small_slopes(smallest_m):
        words.append("plain")
    if term.m is not None:
        words.append("constant")
    return " ".join(words)


def second_name(term: Term, smallest_m: float) -> str:
    """Return the key of a term's second lobe in :attr:`Prices.terms`.

    Both lobes of a term share its Fresnel and masking terms, so the key excludes these.
    """
    return f"second lobe of {term_name(_unfactored(term), smallest_m)}"


def _unfactored(term: Term) -> Term:
    return replace(term, fresnel=Term.fresnel, masking=Term.masking)


def variants(term: Term) -> dict[str, Term]:
    """Return variants of a term with and without a constant m, keyed by :func:`term_name`. Variants
    with the exact lobe also differ in ``small_slope``."""
    options = (True, False) if lobe_entry(term.lobe).of_tan2 else (None,)
    terms = [replace(term, m=m, small_slope=option) for m in (None, term.m) for option in options]
    return {term_name(variant, SLOPE): variant for variant in terms}


def second_variants(term: Term) -> dict[str, Term]:
    """Return terms whose second lobes cost the same as the second lobes of a term's variants,
    keyed by :func:`second_name`."""
    return {
        second_name(variant, SLOPE): _unfactored(variant) for variant in variants(term).values()
    }


def second_lobes(two: Terms, one: Terms, seconds: Mapping[str, Term]) -> dict[str, Pair]:
    """Return the cost of each second lobe: a term's cost with two lobes minus its cost with one."""
    added = {}
    for name, term in seconds.items():
        first, further = one[term_name(term, SLOPE)]
        added[name] = (two[name][0] - first, two[name][1] - further)
    return added


def without_specular(parts: Mapping[str, float]) -> dict[str, float]:
    """Return the costs of the non-specular parts: the terms' prices include the specular parts."""
    return {name: cost for name, cost in parts.items() if name not in _SPECULAR}


def measured(
    terms: Mapping[str, Term], repeats: int = 7, seconds: Mapping[str, Term] | None = None
) -> Prices:
    """Measure the price of every part and every specular term on this machine.

    Parameters
    ----------
    terms : keyed by :func:`term_name`
    seconds : terms whose second lobes are priced, keyed by :func:`second_name`; ``terms`` also
        contains each of these

    Raises
    ------
    ContextError : no OpenGL context
    """
    from facerender.drawing.context import create_context
    from facerender.pricing import cost, fragment, scatter

    parts = {name: time.value for name, time in fragment.by_slope(repeats=repeats).items()}
    calls = {name: (prelude(term, SLOPE), call(term)) for name, term in terms.items()}
    calls |= {
        name: (_LOBES + prelude(term, SLOPE, two_lobes=True), call(term, 1.5))
        for name, term in (seconds or {}).items()
    }
    times = cost.by_slope(calls, repeats=repeats)
    prices = {
        name: (parts[_SPECULAR[0]] + time.value, parts[_SPECULAR[1]] + time.value)
        for name, time in times.items()
    }
    prices |= second_lobes(prices, prices, seconds or {})
    context = create_context()
    context.release()
    source = f"measured on {context.renderer}, OpenGL {context.version}"
    return Prices(source, "ns", without_specular(parts) | scatter.by_frames(repeats), prices)


# Macros that replace the uniforms of a second lobe.
_LOBES = "#define second_m (1.5 * m)\n#define lobe_weight (0.5 + f0)\n"
_SPECULAR = ("first specular term", "further specular term")
