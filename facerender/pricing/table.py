"""What a shading costs a fragment, as a sum: the host's program, its maps and lights
(``fragment.py``), and the specular term of the first light and of each further one, which shares
with it what depends on the fragment alone. Kept as a table, or measured when it is asked for.

    python -m facerender.pricing.table     measures the table anew, in a few minutes
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, TypeVar

from facerender.drawing.prepare import simplify
from facerender.drawing.program import Lighting
from facerender.errors import InputError
from facerender.glsl.code import call, prelude
from facerender.pricing.variants import SLOPE
from facerender.scenes.light import LIGHT_KINDS
from facerender.scenes.material import Material
from facerender.scenes.mesh import Part
from facerender.scenes.scene import Scene, slope_ranges
from facerender.shading import Shading, Term
from facerender.terms import FRESNEL, LOBES, MASKING, MODELS, AnyLobe, GPower, lobe_entry
from facerender.terms.fitting import G_POWERS

TABLE = Path(__file__).with_name("prices.json")
FAMILY_NAMES = {"navi21": "RDNA2 (navi21)", "vega10": "GCN5 (vega10)"}
FRAME = "frame"  # of whole ones, as ``planning/frames.py`` prices them
HERE = "here"
COMPILED = {f"radv:{family}": family for family in FAMILY_NAMES}

Terms = Mapping[str, tuple[float, float]]


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
        """Return what a fragment of the scene costs, and how much of it is specular; of several
        parts the mean, weighted by their faces.

        Raises
        ------
        NoPrice : a term that is not priced
        """
        simple = simplify(scene, shading)
        lighting = Lighting.of(simple, shading)
        lit = [
            lighting.terms[group.term]
            for group in sorted(lighting.groups, key=lambda group: group.term)
            for _ in range(group.count if group.term >= 0 else 0)
        ]
        lights = sum(
            group.count * self._priced(self.parts, LIGHT_KINDS[group.kind].price)
            for group in lighting.groups
        )
        lights += sum(
            group.count * self._priced(self.parts, LIGHT_KINDS[group.kind].shadow_price)
            for group in lighting.groups
            if group.shadows is not None
        )
        total = specular = faces = 0.0
        for part, material, (smallest, _) in zip(
            simple.mesh.parts, simple.mesh.materials, slope_ranges(simple, shading), strict=True
        ):
            shine = 0.0
            if material.ks:
                shine = self._specular([term_name(each, smallest) for each in lit])
                if material.two_lobes:
                    shine += self._specular([second_name(each, smallest) for each in lit])
            ambient = material.kd > 0.0 and any(simple.ambient)  # type: ignore[arg-type]
            coupled = shading.diffuse == "coupled" and material.kd > 0.0 and material.ks > 0.0
            sum_ = self.parts["base program"] + shine + lights
            if coupled:
                sum_ += self._priced(self.parts, "coupled diffuse")
                each = self._priced(self.parts, "light of coupled diffuse")
                sum_ += len(simple.lights) * each
            around = simple.environment is not None
            if around:
                sum_ += self._priced(self.parts, "environment")
            if around and material.ks and shading.environment_samples:
                each = shading.environment_samples * self._priced(self.parts, "environment sample")
                reflected = (1 + material.two_lobes) * each
                sum_, shine = sum_ + reflected, shine + reflected
            occluded = ambient or (around and material.kd > 0.0)
            sum_ += self._maps(part, material, occluded, shine > 0.0 or coupled)
            sum_ += self.parts["ambient term"] * ambient
            if material.scattering and material.kd > 0.0:
                sum_ += self._priced(self.parts, "scattering")
                each = self._priced(self.parts, "sample of scattering")
                sum_ += shading.scatter_samples * each
            faces += len(part.faces)
            total += len(part.faces) * sum_
            specular += len(part.faces) * shine
        return total / faces, specular / faces

    def _specular(self, names: Iterable[str]) -> float:
        terms = (self._priced(self.terms, name) for name in names)
        return sum(first if i == 0 else more for i, (first, more) in enumerate(terms))

    def _priced(self, prices: Mapping[str, P], name: str) -> P:
        if name not in prices:
            raise NoPrice(
                f"no price of {name} among {self.source}: measure it, with --cost here, or write "
                "the table anew: python -m facerender.pricing.table"
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
        machine, "radv:navi21" or "radv:vega10" to compile, both for up to a minute
    software : whether the CPU draws

    Raises
    ------
    InputError : an unknown kind
    NotMeasured : a tool that compiling needs is missing
    ContextError : no OpenGL context to measure in
    """
    table = shipped()
    if kind in (FRAME, "auto"):
        kind = "llvmpipe" if software else "navi21"
    if kind in table:
        return table[kind]
    if kind == HERE or kind in COMPILED:
        wanted: dict[str, Term] = {}
        seconds: dict[str, Term] = {}
        two_lobes = any(material.two_lobes for material in scene.mesh.materials)
        for shading in shadings:
            for term in Lighting.of(scene, shading).terms:
                wanted |= _variants(term)
                if two_lobes and shading.two_lobes:
                    seconds |= _seconds(term)
        wanted |= {term_name(each, SLOPE): each for each in seconds.values()}
        if kind == HERE:
            return measured(wanted, seconds=seconds)
        return compiled(COMPILED[kind], wanted, seconds)
    known = ", ".join([FRAME, "auto", *table, HERE, *COMPILED])
    raise InputError(f"unknown cost {kind!r}; known: {known}")


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


def _seconds(term: Term) -> dict[str, Term]:
    """The terms whose second lobes cost what those of a term's variants do, by name."""
    return {second_name(each, SLOPE): _unfactored(each) for each in _variants(term).values()}


def _variants(term: Term) -> dict[str, Term]:
    """A term with a constant slope and without, and of the exact lobe with small slopes and
    without, by name."""
    small = (True, False) if lobe_entry(term.lobe).of_tan2 else (None,)
    variants = [replace(term, m=m, small_slope=each) for m in (None, term.m) for each in small]
    return {term_name(each, SLOPE): each for each in variants}


def all_terms() -> dict[str, Term]:
    """Return every term that a plan may choose, by name."""
    powers: list[AnyLobe] = [GPower(g, 0.27, 0.1) for g in G_POWERS]
    terms: dict[str, Term] = {}
    for model, lobe in product(MODELS.values(), [*LOBES, *powers]):
        factors = product(FRESNEL, MASKING) if model.factors else [(Term.fresnel, Term.masking)]
        for fresnel, masking in factors:
            terms |= _variants(Term(model.name, lobe, fresnel, masking, SLOPE))
    return terms


def all_seconds() -> dict[str, Term]:
    """Return every term whose second lobe has a price of its own, by name."""
    seconds: dict[str, Term] = {}
    for term in all_terms().values():
        seconds |= _seconds(term)
    return seconds


def compiled(
    family: str, wanted: Mapping[str, Term], seconds: Mapping[str, Term] | None = None
) -> Prices:
    """Have RADV compile the host's program with each term, for one light and for two.

    Parameters
    ----------
    seconds : terms, all of them wanted, whose second lobes are priced

    Raises
    ------
    NotMeasured : a tool is missing; the message says which, and how to get it
    """
    from facerender.pricing import amd, fragment, scatter

    parts = fragment.by_compiler(family)
    scenes = [fragment.scene_with(), fragment.scene_with(directional=2)]
    dull = [fragment.estimate(fragment.program_of(scene), parts) for scene in scenes]

    def specular(terms: Mapping[str, Term], **material: float) -> dict[str, tuple[float, float]]:
        drawn = [replace(each, mesh=each.mesh.with_material(**material)) for each in scenes]
        programs = [
            fragment.program_of(scene, Shading(term=term))
            for term in terms.values()
            for scene in drawn
        ]
        rows = fragment.cycles(programs, family)
        pairs = zip(terms, rows[::2], rows[1::2], strict=True)
        return {
            name: (first - dull[0], (both - dull[1]) - (first - dull[0]))
            for name, first, both in pairs
        }

    terms = specular(wanted)
    if seconds:
        terms |= _added(specular(seconds, **_TWO_LOBES), terms, seconds)
    source = f"{amd.driver()}'s estimate for {FAMILY_NAMES[family]}"
    parts = _without_specular(parts) | scatter.by_compiler(family)
    return Prices(source, "cycles of a wave", parts, terms)


_TWO_LOBES = {"second_slope": 1.5, "lobe_weight": 0.5}


def _added(two: Terms, one: Terms, seconds: Mapping[str, Term]) -> dict[str, tuple[float, float]]:
    """What second lobes add, of what terms cost with two lobes and with one."""
    added = {}
    for name, term in seconds.items():
        first, further = one[term_name(term, SLOPE)]
        added[name] = (two[name][0] - first, two[name][1] - further)
    return added


def measured(
    wanted: Mapping[str, Term], repeats: int = 7, seconds: Mapping[str, Term] | None = None
) -> Prices:
    """Measure every part and term here, by slope; seconds as of :func:`compiled`.

    Raises
    ------
    ContextError : no OpenGL context
    """
    from facerender.drawing.context import create_context
    from facerender.pricing import cost, fragment, scatter

    parts = {name: each.value for name, each in fragment.by_slope(repeats=repeats).items()}
    calls = {name: (prelude([term], SLOPE), call(term)) for name, term in wanted.items()}
    calls |= {
        name: (_LOBES + prelude([term], SLOPE, two_lobes=True), call(term, 1.5))
        for name, term in (seconds or {}).items()
    }
    times = cost.by_slope(calls, repeats=repeats)
    terms = {
        name: (parts[_SPECULAR[0]] + time.value, parts[_SPECULAR[1]] + time.value)
        for name, time in times.items()
    }
    terms |= _added(terms, terms, seconds or {})
    context = create_context()
    context.release()
    source = f"measured on {context.renderer}, OpenGL {context.version}"
    return Prices(source, "ns", _without_specular(parts) | scatter.by_frames(repeats), terms)


# What a second lobe reads, for a program that has no uniforms.
_LOBES = "#define second_m (1.5 * m)\n#define lobe_weight (0.5 + f0)\n"
_SPECULAR = ("first specular term", "further specular term")


def _without_specular(parts: Mapping[str, float]) -> dict[str, float]:
    return {name: cost for name, cost in parts.items() if name not in _SPECULAR}


def main() -> None:
    from facerender.pricing import amd

    terms, seconds = all_terms(), all_seconds()
    prices_of = {family: compiled(family, terms, seconds) for family in amd.FAMILIES}
    prices_of["llvmpipe"] = measured(terms, repeats=15, seconds=seconds)
    rows = {kind: _rounded(asdict(prices)) for kind, prices in prices_of.items()}
    text = json.dumps(rows, indent=1)
    text = re.sub(r"\[\s+(\S+),\s+(\S+)\s+\]", r"[\1, \2]", text)  # a term on a line
    TABLE.write_text(text + "\n", encoding="utf-8")


def _rounded(value: Any) -> Any:
    """The same with numbers of four digits, which is more than their spread."""
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    if isinstance(value, tuple):
        return [_rounded(item) for item in value]
    return float(f"{value:.4g}") if isinstance(value, float | int) else value


if __name__ == "__main__":
    main()
