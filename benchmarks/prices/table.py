"""The package's price table, ``facerender/pricing/prices.json``: estimates by RADV for two families
of AMD GPUs, and measurements on llvmpipe."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from itertools import product
from typing import Any

from benchmarks.prices import amd
from facerender.drawing.frame_passes import scatter_pass
from facerender.drawing.program import Program
from facerender.pricing import cost, table
from facerender.pricing.cost import SLOPE
from facerender.pricing.table import (
    TABLE,
    Pair,
    Prices,
    measured,
    second_lobes,
    second_variants,
    variants,
    without_specular,
)
from facerender.scene.scattering import Scattering
from facerender.scene.shading import Shading, Term
from facerender.terms.lobe import G_POWERS, LOBES, AnyLobe, GPower
from facerender.terms.model import FRESNEL, MASKING, MODELS
from facerender.terms.transport import PROFILES

_SCATTER_SAMPLES = (8, 16)  # RADV unrolls these loops, and counts longer ones once
_TWO_LOBES = {"second_slope": 1.5, "lobe_weight": 0.5}


def all_terms() -> dict[str, Term]:
    """Return every term that a plan may choose, by name."""
    powers: list[AnyLobe] = [GPower(g, 0.27, 0.1) for g in G_POWERS]
    terms: dict[str, Term] = {}
    for model, lobe in product(MODELS.values(), [*LOBES, *powers]):
        factors = product(FRESNEL, MASKING) if model.factors else [(Term.fresnel, Term.masking)]
        for fresnel, masking in factors:
            terms |= variants(Term(model.name, lobe, fresnel, masking, SLOPE))
    return terms


def all_seconds() -> dict[str, Term]:
    """Return every term whose second lobe has a separate price, by name."""
    seconds: dict[str, Term] = {}
    for term in all_terms().values():
        seconds |= second_variants(term)
    return seconds


def cycles(programs: Sequence[Program], family: str) -> list[int]:
    """Return RADV's estimates of whole programs on a family of AMD GPUs.

    Parameters
    ----------
    family : "navi21" (RDNA2) or "vega10" (GCN5)

    Returns
    -------
    cycles per wave, the ``inverse_throughput`` of :class:`amd.Statistics`

    Raises
    ------
    InputError : the family is unknown
    NotMeasured : a tool is missing; the message names it and the command that installs it
    """
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        modules = list(pool.map(lambda program: amd.spirv(**program.sources("450")), programs))
    attributes = [3, 3, 2]  # components of position, normal and texture coordinates
    rows = amd.compile_programs(modules, family, attributes)[1]
    return [row["Inverse Throughput"] for row in rows]


def parts(family: str, shading: Shading | None = None) -> dict[str, float]:
    """Return the cost of each part of the fragment program; unit and exceptions as :func:`cycles`.

    The cost of a map covers only the vector ALU, because the compiler models neither the texture
    filter nor the cache. ``shading`` is a parameter of :func:`fragment.samples`.
    """
    estimates = cycles([program for _, program in table.samples(shading)], family)
    return dict(zip(table.PARTS, map(float, table.TO_PARTS @ estimates), strict=True))


def scattering_parts(family: str) -> dict[str, float]:
    """Return the cost of ``scatter.PARTS``; unit and exceptions as :func:`cycles`."""
    profile = Scattering((PROFILES["skin"][2:],), (1,), 1.0, 1.0)
    black = (0.0, 0.0, 0.0)
    passes = [scatter_pass(profile, n, black, False, False) for n in _SCATTER_SAMPLES]
    costs = cycles([each.draws[-1].program for each in passes], family)
    return cost.parts(_SCATTER_SAMPLES, [float(each) for each in costs])


def compiled(family: str, terms: Mapping[str, Term], seconds: Mapping[str, Term]) -> Prices:
    """Return prices from RADV, which compiles the renderer's program with each term for one light
    and for two.

    Parameters
    ----------
    terms, seconds : as in :func:`facerender.pricing.table.measured`

    Raises
    ------
    NotMeasured : a tool is missing; the message names it and the command that installs it
    """
    costs = parts(family)
    scenes = [table.scene_with(), table.scene_with(directional=2)]
    counted = [table.parts_of(table.program_of(scene)) for scene in scenes]
    dull = [sum(count * costs[name] for name, count in counts.items()) for counts in counted]

    def specular(terms: Mapping[str, Term], **material: Any) -> dict[str, Pair]:
        changed = [replace(each, mesh=each.mesh.with_material(**material)) for each in scenes]
        programs = [
            table.program_of(scene, Shading(**vars(term)))
            for term in terms.values()
            for scene in changed
        ]
        rows = cycles(programs, family)
        pairs = zip(terms, rows[::2], rows[1::2], strict=True)
        return {
            name: (first - dull[0], (both - dull[1]) - (first - dull[0]))
            for name, first, both in pairs
        }

    prices = specular(terms)
    prices |= second_lobes(specular(seconds, **_TWO_LOBES), prices, seconds)
    source = f"{amd.driver()}'s estimate for {amd.FAMILIES[family]}"
    return Prices(
        source, "cycles of a wave", without_specular(costs) | scattering_parts(family), prices
    )


def write() -> None:
    """Write the price table of the package."""
    terms, seconds = all_terms(), all_seconds()
    prices_of = {family: compiled(family, terms, seconds) for family in amd.FAMILIES}
    prices_of["llvmpipe"] = measured(terms, repeats=15, seconds=seconds)
    rows = {kind: _rounded(asdict(prices)) for kind, prices in prices_of.items()}
    text = json.dumps(rows, indent=1)
    text = re.sub(r"\[\s+(\S+),\s+(\S+)\s+\]", r"[\1, \2]", text)  # one term per line
    TABLE.write_text(text + "\n", encoding="utf-8")


def _rounded(value: Any) -> Any:
    """Return the value with numbers rounded to four digits, which is finer than their spread."""
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    if isinstance(value, tuple):
        return [_rounded(item) for item in value]
    return float(f"{value:.4g}") if isinstance(value, float | int) else value
