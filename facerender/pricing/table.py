"""The cost of a shading per fragment, as a sum: the renderer's program, its maps and lights
(``fragment.py``), and the specular term of the first light and of each further one, which shares
intermediate values with the first. The table ``prices.json`` is written by
``python -m benchmarks.prices table`` in the repository; ``measured`` prices this machine.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

from facerender.drawing.resolve import Lighting, resolve
from facerender.errors import InputError
from facerender.glsl.code import call, prelude
from facerender.pricing.variants import SLOPE
from facerender.scenes.light import LIGHT_KINDS
from facerender.scenes.material import Material
from facerender.scenes.mesh import Part
from facerender.scenes.scene import Scene
from facerender.shading import Shading, Term
from facerender.terms import lobe_entry

TABLE = Path(__file__).with_name("prices.json")
FRAME = "frame"  # of whole ones, as ``planning/frame_times.py`` prices them
HERE = "here"

Pair = tuple[float, float]
Terms = Mapping[str, Pair]
P = TypeVar("P")


class NoPrice(InputError):
    """A term, or a kind of light, that the table of prices does not have."""


@dataclass(frozen=True)
class Prices:
    """Prices of one target.

    Attributes
    ----------
    source : what they are and where they are from, in words
    unit : of all of them
    parts : those of ``fragment.PARTS`` apart from specular terms
    terms : by :func:`term_name`, of a specular term in the first light that has one, and in
        another; by :func:`second_name`, of its second lobe
    """

    source: str
    unit: str
    parts: Mapping[str, float]
    terms: Terms

    def cost(self, scene: Scene, shading: Shading) -> tuple[float, float]:
        """Return the cost of a fragment of the scene, and the specular part of it; of several mesh
        parts the mean, weighted by their faces.

        Raises
        ------
        NoPrice : a term that is not priced
        """
        resolved = resolve(scene, shading)
        simple, lighting = resolved.scene, resolved.lighting
        terms = [
            lighting.terms[group.term]
            for group in sorted(lighting.groups, key=lambda group: group.term)
            for _ in range(group.count if group.term >= 0 else 0)
        ]
        lights = self._lights(lighting)
        total = specular = faces = 0.0
        for part, material, (smallest, _) in zip(
            simple.mesh.parts, simple.mesh.materials, resolved.slopes, strict=True
        ):
            whole, shine = self._part(simple, shading, part, material, lights, terms, smallest)
            faces += len(part.faces)
            total += len(part.faces) * whole
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
        scene: Scene,
        shading: Shading,
        part: Part,
        material: Material,
        lights: float,
        terms: Sequence[Term],
        smallest: float,
    ) -> tuple[float, float]:
        """Return the cost of a fragment of one mesh part, and the specular part of it.

        lights : cost of all lights without their terms
        terms : of the lights that have one
        smallest : slope m of the part
        """
        shine = 0.0
        if material.ks:
            shine = self._specular([term_name(each, smallest) for each in terms])
            if material.two_lobes:
                shine += self._specular([second_name(each, smallest) for each in terms])
        diffuse = material.kd > 0.0
        ambient = diffuse and any(scene.ambient)  # type: ignore[arg-type]
        coupled = shading.diffuse == "coupled" and diffuse and material.ks > 0.0
        whole = self.parts["base program"] + shine + lights
        if coupled:
            whole += self._priced(self.parts, "coupled diffuse")
            whole += len(scene.lights) * self._priced(self.parts, "light of coupled diffuse")
        environment = scene.environment is not None
        if environment:
            whole += self._priced(self.parts, "environment")
        if environment and material.ks and shading.environment_samples:
            each = shading.environment_samples * self._priced(self.parts, "environment sample")
            reflected = (1 + material.two_lobes) * each
            whole, shine = whole + reflected, shine + reflected
        occluded = ambient or (environment and diffuse)
        whole += self._maps(part, material, occluded, shine > 0.0 or coupled)
        whole += self.parts["ambient term"] * ambient
        if material.scattering and diffuse:
            whole += self._priced(self.parts, "scattering")
            whole += shading.scatter_samples * self._priced(self.parts, "sample of scattering")
        return whole, shine

    def _specular(self, names: Iterable[str]) -> float:
        terms = (self._priced(self.terms, name) for name in names)
        return sum(first if i == 0 else more for i, (first, more) in enumerate(terms))

    def _priced(self, prices: Mapping[str, P], name: str) -> P:
        if name not in prices:
            raise NoPrice(
                f"no price of {name} among {self.source}: measure it with --cost here, or update "
                "the table in a checkout: python -m benchmarks.prices table"
            )
        return prices[name]

    def _maps(self, part: Part, material: Material, ambient: bool, shines: bool) -> float:
        if part.uv is None:
            return 0.0
        occlusion = (material.occlusion_map,) * ambient
        read = (*occlusion, *(material.roughness_map, material.specular_map) * shines)
        has = {
            "albedo map": material.albedo_map is not None and material.kd > 0.0,
            "normal map": material.normal_map is not None,
            "property map": any(each is not None for each in read),
        }
        cost = sum(self.parts[name] for name, is_there in has.items() if is_there)
        if shines and material.two_lobes and material.lobe_map is not None:
            cost += self.parts["property map"]  # another texture of the kind
        return cost


def load_prices(
    kind: str, scene: Scene, shadings: Iterable[Shading], software: bool = False
) -> Prices:
    """Return the prices of a target, for some shadings of a scene.

    Parameters
    ----------
    kind : of the table "llvmpipe", "navi21" (RDNA2) or "vega10" (GCN5); "auto" and "frame", the
        table's for llvmpipe where the CPU draws, and for RDNA2 elsewhere; "here" to measure on this
        machine, for up to a minute
    software : whether the CPU draws

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
    if kind != HERE:
        known = ", ".join([FRAME, "auto", *table, HERE])
        raise InputError(f"unknown cost {kind!r}; known: {known}")
    terms: dict[str, Term] = {}
    seconds: dict[str, Term] = {}
    two_lobes = any(material.two_lobes for material in scene.mesh.materials)
    for shading in shadings:
        for term in Lighting.of(scene, shading).terms:
            terms |= variants(term)
            if two_lobes and shading.two_lobes:
                seconds |= second_variants(term)
    terms |= {term_name(each, SLOPE): each for each in seconds.values()}
    return measured(terms, seconds=seconds)


def shipped() -> dict[str, Prices]:
    """Return the table, by target."""
    table = json.loads(TABLE.read_text(encoding="utf-8"))
    return {kind: Prices(**prices) for kind, prices in table.items()}


def term_name(term: Term, smallest_m: float) -> str:
    """Name a specular term, as far as its cost depends on it."""
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
    """Name the second lobe of a term, as far as its cost depends on it: it shares the Fresnel and
    the masking term."""
    return f"second lobe of {term_name(_unfactored(term), smallest_m)}"


def _unfactored(term: Term) -> Term:
    return replace(term, fresnel=Term.fresnel, masking=Term.masking)


def variants(term: Term) -> dict[str, Term]:
    """Return a term with a constant slope and without, and of the exact lobe with small slopes and
    without, by name."""
    small = (True, False) if lobe_entry(term.lobe).of_tan2 else (None,)
    terms = [replace(term, m=m, small_slope=each) for m in (None, term.m) for each in small]
    return {term_name(each, SLOPE): each for each in terms}


def second_variants(term: Term) -> dict[str, Term]:
    """Return the terms whose second lobes cost what those of a term's variants do, by name."""
    return {second_name(each, SLOPE): _unfactored(each) for each in variants(term).values()}


def second_lobes(two: Terms, one: Terms, seconds: Mapping[str, Term]) -> dict[str, Pair]:
    """Return the cost that each second lobe adds, from the costs of terms with two lobes and with
    one."""
    added = {}
    for name, term in seconds.items():
        first, further = one[term_name(term, SLOPE)]
        added[name] = (two[name][0] - first, two[name][1] - further)
    return added


def without_specular(parts: Mapping[str, float]) -> dict[str, float]:
    """Return the costs of the parts that a table has: a specular term's part is in its price."""
    return {name: cost for name, cost in parts.items() if name not in _SPECULAR}


def measured(
    terms: Mapping[str, Term], repeats: int = 7, seconds: Mapping[str, Term] | None = None
) -> Prices:
    """Measure every part and term on this machine, by the slope of time over repetitions.

    Parameters
    ----------
    terms : by :func:`term_name`
    seconds : by :func:`second_name`: terms, all of them in ``terms``, whose second lobes are priced

    Raises
    ------
    ContextError : no OpenGL context
    """
    from facerender.drawing.context import create_context
    from facerender.pricing import cost, fragment, scatter

    parts = {name: each.value for name, each in fragment.by_slope(repeats=repeats).items()}
    calls = {name: (prelude([term], SLOPE), call(term)) for name, term in terms.items()}
    calls |= {
        name: (_LOBES + prelude([term], SLOPE, two_lobes=True), call(term, 1.5))
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


# Stand in for the uniforms of a second lobe.
_LOBES = "#define second_m (1.5 * m)\n#define lobe_weight (0.5 + f0)\n"
_SPECULAR = ("first specular term", "further specular term")
