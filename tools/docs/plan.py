"""Writes docs/plan.md: what plans of ten scenes choose, save and lose, and how they are checked.

python -m tools.docs.plan      from the repository's root; half an hour; needs an OpenGL context, the head
                         scan of the tests for two scenes, and what RADV's estimates need
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np

import facerender as fr
from benchmarks.prices import amd
from benchmarks.prices.table import cycles
from facerender.drawing.passes.shade import shade_pass
from facerender.drawing.prepare import simplify
from facerender.drawing.program import Program
from facerender.measure.tables import markdown_table
from facerender.planning.budget import ROUNDING, Budget
from facerender.planning.candidates import DECISIONS, candidates, changed
from facerender.planning.plan import Plan, plan
from facerender.pricing.table import load_prices
from facerender.scenes.view import view_of
from tests.verification.scan import load_scan, scan_folder
from tests.verification.subjects import BUDGETS, KINDS, Subject, brute_force, subjects
from tools.docs.template import missing

OUTPUT = Path(__file__).parents[2] / "docs/plan.md"
SIZE = (512, 512)
SMALL = (64, 64)
TURNTABLE = 8
RATES_HEAD = ("planned for", "budget", "its cameras", "50 others")
CHECKS_HEAD = ("", "largest difference", "median")

PAGE = """# Plans: what ten scenes need

Written by `python -m tools.docs.plan`, on {GL_RENDERER}, OpenGL
{GL_VERSION}. A plan is the cheapest shading whose error against the full one
stays within a budget (`facerender plan --help`). Here the full shading is Cook-Torrance with the
exact lobe, Schlick's Fresnel term and V-cavity masking, unless a scene says otherwise. The head is
the built-in one, the scan Lee Perry-Smith's (Infinite-Realities, CC BY 3.0); three lights are key,
rim and fill. Errors are of the displayed image before rounding, of the worst channel of the worst
pixel, at 512 x 512: of float64 at the pixels' centres, and as drawn with {samples} samples a pixel.

## What it saves

Cost of a fragment's whole program, and in brackets of its specular terms, relative to the full
shading; and what was chosen. Each column has plans of its own. The costs are sums of parts:
nanoseconds measured on llvmpipe, and cycles that Mesa's compiler for AMD's GPUs estimates
(`python -m benchmarks.prices table`).

At the scene's camera, 35 degrees to the side of the face:

{one_tables}

At eight cameras all around. Some of them always look against a light, where all terms show:

{around_tables}

- A slope that is the same everywhere becomes a constant, which changes nothing and always saves.
- Lights on the eye's side need no Fresnel and no masking term; on GPUs these are what costs. A rim
  light needs all terms.
- Another lobe hardly pays on RDNA2, where exp2 is cheap. On llvmpipe it does, and there it is a
  g-power that is fitted to the slope: see [accuracy.md](accuracy.md).

## With a guarantee

For every camera, at any of the three budgets. Towards the silhouette Cook-Torrance grows as 1/(N.V)
and Ward as its root, so that no change of a specular term has a small bound: what is left are
constants.

{guarantee}

## Is it true?

All plans above, drawn with {samples} samples and compared with the full shading drawn: cameras
whose largest error is over the budget; and the largest error of all, over its budget. The
{unplanned} others look from all around, from elevations of -30 to 40 degrees, with zooms of 0.8 to
2.5. A plan for one camera is for that camera: where others look against the light, it fails.

{rates}

Does the search find the cheapest of what it may choose? Each of {shadings} shadings
a scene, evaluated by itself at every pixel of a smaller image ({small} x {small}, one camera):
of {comparisons} plans ({count} scenes, three budgets, three costs), {dearer} are dearer than the
cheapest shading that fits.

Do the prices add up? Relative cost of the plans, by the sum of parts and by RADV's estimate of the
whole program, compiled:

{checks}

Planning took {one} at one camera, {eight} at eight.
"""
UNPLANNED = 50
NAMES = {"llvmpipe": "llvmpipe", "navi21": "RDNA2", "vega10": "GCN5"}


def cameras(count: int) -> list[fr.Camera]:
    """Cameras that no plan was made with: from all around, higher, lower, nearer."""
    random = np.random.default_rng(7)
    return [
        fr.Camera(random.uniform(-180, 180), random.uniform(-30, 40), zoom=random.uniform(0.8, 2.5))
        for _ in range(count)
    ]


class Views:
    """What OpenGL draws of a subject at cameras, and the largest errors there."""

    def __init__(self, renderer: fr.Renderer, subject: Subject, at: Sequence[fr.Camera]) -> None:
        self.renderer, self.subject = renderer, subject
        self.scenes = [replace(subject.scene, camera=each, background=None) for each in at]
        self.exact = [self._draw(scene, subject.full) for scene in self.scenes]
        self.known: dict[fr.Shading, list[float]] = {}

    def errors(self, shading: fr.Shading) -> list[float]:
        """The largest error at each camera, as a share of the display's range."""
        if shading not in self.known:
            budget = Budget.parse("1/255")
            self.known[shading] = [
                float(budget.errors(self._draw(scene, shading), exact).max())
                for scene, exact in zip(self.scenes, self.exact, strict=True)
            ]
        return self.known[shading]

    def _draw(self, scene: fr.Scene, shading: fr.Shading) -> np.ndarray:
        return self.renderer.render(scene, shading).linear[..., :3]


@dataclass(frozen=True, eq=False)
class Result:
    """A plan, how long it took, and the largest drawn errors at its cameras and at others."""

    plan: Plan
    seconds: float
    planned: list[float]
    unplanned: list[float]


Results = dict[tuple[str, str, str], Result]  # by scene, budget and kind of cost


def short(found: Plan) -> str:
    """What was chosen, in few words."""
    shading, full = found.shading, found.full
    differs = changed(shading, full)
    if not differs:
        return "exact: nothing saved"
    words = {
        "lights": f"specular of {listed(shading.specular_lights or ())}",
        "frontal": f"{listed(shading.frontal_lights)} without F and G",
        "normal map": "no normal map",
        "slope": "m constant",
        "specular weight": "ks constant",
        "ambient": "no ambient",
        "model": shading.term.model,
        "lobe": str(shading.term.lobe).split(" (")[0],
        "Fresnel": f"Fresnel {shading.term.fresnel}",
        "masking": f"masking {shading.term.masking}",
        "small slopes": "small slopes plain",
    }
    if "model" in differs:
        differs = [name for name in differs if name not in ("Fresnel", "masking")]
    return ", ".join(words[name] for name in DECISIONS if name in differs)


def listed(lights: Sequence[int]) -> str:
    names = ("key", "rim", "fill")  # where there are several
    return " and ".join(names[light] for light in lights) or "no light"


def cost_head(budget: str) -> list[str]:
    return [f"within {budget}", *(NAMES[kind] for kind in KINDS)]


def cost_tables(results: Results, names: Iterable[str], budgets: Sequence[str]) -> str:
    """For each budget, the scenes over the kinds of cost."""
    tables = []
    for budget in budgets:
        rows = []
        for name in names:
            cells = []
            for kind in KINDS:
                found = results[name, budget, kind].plan
                specular = found.cost.specular / found.cost.full_specular
                cells.append(f"{found.cost.relative:.2f} ({specular:.2f}): {short(found)}")
            rows.append([name, *cells])
        tables.append(markdown_table(cost_head(budget), rows))
    return "\n\n".join(tables)


def violations(results: Iterable[Result], unplanned: bool) -> str:
    """Cameras over the budget, of how many, and the largest error over the budget."""
    pairs = [
        (error, each.plan.budget.limit)
        for each in results
        for error in (each.unplanned if unplanned else each.planned)
    ]
    over = sum(error > limit for error, limit in pairs)
    worst = max(error / limit for error, limit in pairs)
    return f"{over} of {len(pairs)} ({100.0 * over / len(pairs):.1f} %), {worst:.2f}"


def compiled(found: Plan, family: str) -> float:
    """The cost of the plan's whole fragment program over the full one's, as RADV compiles them."""

    def program(shading: fr.Shading) -> Program:
        simple = simplify(found.scene, shading)
        (draw,) = shade_pass(simple, view_of(simple, 1.0), shading, 1).draws
        return draw.program

    own, full = cycles([program(found.shading), program(found.full)], family)
    return own / full


def brute(subject: Subject, renderer: fr.Renderer) -> tuple[int, int]:
    """How many shadings there are, and for how many budgets and prices a plan is dearer than the
    cheapest of them all that fits."""
    found = {
        (budget, kind): plan(subject.scene, budget, full=subject.full, cost=kind, renderer=renderer)
        for budget in BUDGETS
        for kind in KINDS
    }
    constants = found[BUDGETS[0], KINDS[0]].constants
    prices = {kind: load_prices(kind, subject.scene, ()) for kind in KINDS}

    def cost(shading: fr.Shading, kind: str) -> float:
        return prices[kind].cost(subject.scene, shading)[0]

    every = [
        each
        for each in candidates(subject.scene, subject.full, constants)
        if each == subject.full or any(cost(each, k) < cost(subject.full, k) for k in KINDS)
    ]
    errors = brute_force(renderer, subject, every)
    dearer = 0
    for (budget, kind), chosen in found.items():
        limit = Budget.parse(budget).limit - ROUNDING["display"]
        fitting = [each for each, error in zip(every, errors, strict=True) if error <= limit]
        cheapest = min(cost(each, kind) for each in fitting)
        dearer += chosen.cost.total > cheapest
    return len(every), dearer


def stale() -> Iterator[str]:
    """Tell what the document lacks of what is not measured."""
    return missing(OUTPUT, PAGE, (RATES_HEAD, CHECKS_HEAD, *map(cost_head, BUDGETS)))


def main() -> None:
    folder = scan_folder()
    scan = load_scan(folder) if folder else None
    modes: dict[str, Results] = {"one camera": {}, "eight cameras": {}, "guaranteed": {}}
    counts: dict[str, tuple[int, int]] = {}
    with fr.Renderer(SIZE) as renderer, fr.Renderer(SMALL, samples=1) as small:
        for subject in subjects(fr.load_mesh(), scan):
            print(subject.name, flush=True)
            around = fr.turntable(subject.scene.camera, TURNTABLE)
            planned = Views(renderer, subject, around)  # the first is the scene's own
            unplanned = Views(renderer, subject, cameras(UNPLANNED))
            for mode, kept in modes.items():
                settings = {
                    "one camera": {"renderer": renderer},
                    "eight cameras": {"renderer": renderer, "cameras": around},
                    "guaranteed": {"guarantee": True},
                }[mode]
                for budget, kind in product(BUDGETS, KINDS):
                    start = time.perf_counter()
                    found = plan(subject.scene, budget, full=subject.full, cost=kind, **settings)
                    seconds = time.perf_counter() - start
                    drawn = planned.errors(found.shading)[: len(found.cameras) or None]
                    others = unplanned.errors(found.shading)
                    kept[subject.name, budget, kind] = Result(found, seconds, drawn, others)
            counts[subject.name] = brute(subject, small)
        metadata = renderer.metadata
    OUTPUT.write_text(page(modes, counts, metadata), encoding="utf-8")


def page(
    modes: dict[str, Results], counts: dict[str, tuple[int, int]], metadata: dict[str, str]
) -> str:
    """Return docs/plan.md."""
    one, around, guaranteed = modes.values()
    rates = []
    for mode, kept in modes.items():
        for budget in BUDGETS:
            chosen = [each for key, each in kept.items() if key[1] == budget]
            rates.append([mode, budget, violations(chosen, False), violations(chosen, True)])
    checks = []
    for family in amd.FAMILIES:
        plans = [e.plan for kept in (one, around) for key, e in kept.items() if key[2] == family]
        off = [abs(each.cost.relative - compiled(each, family)) for each in plans]
        checks.append([NAMES[family], f"{max(off):.3f}", f"{statistics.median(off):.3f}"])
    numbers = [number for number, _ in counts.values()]
    return PAGE.format(
        one_tables=cost_tables(one, counts, BUDGETS),
        around_tables=cost_tables(around, counts, BUDGETS),
        guarantee=cost_tables(guaranteed, counts, BUDGETS[-1:]),
        rates=markdown_table(RATES_HEAD, rates),
        checks=markdown_table(CHECKS_HEAD, checks),
        shadings=f"{min(numbers)} to {max(numbers)}",
        dearer=sum(dearer for _, dearer in counts.values()),
        comparisons=len(counts) * len(BUDGETS) * len(KINDS),
        one=spread([each.seconds for each in one.values()]),
        eight=spread([each.seconds for each in around.values()]),
        count=len(counts),
        small=SMALL[0],
        unplanned=UNPLANNED,
        **metadata,
    )


def spread(seconds: list[float]) -> str:
    return f"{statistics.median(seconds):.1f} s (at most {max(seconds):.1f} s)"


if __name__ == "__main__":
    main()
