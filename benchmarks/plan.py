"""Measure the choices, savings and errors of plans for ten scenes, and check them.

    python -m benchmarks.plan
    python -m benchmarks.plan frames

The first command writes docs/measurements/plan.json in 40 minutes. The second command prints the
measured costs of plans of whole frames for several fractions of the pixels, in ten minutes. Both
need an OpenGL context, and the first the compilers for RADV's estimates. Two scenes also need the
head scan.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from typing import Any
from unittest.mock import patch

import numpy as np

import facerender as fr
from benchmarks.data import save, scenes
from benchmarks.prices import amd
from benchmarks.prices.table import cycles
from facerender.drawing.prepare import resolve
from facerender.drawing.program import Program
from facerender.planning.budget import ROUNDING, Budget
from facerender.planning.candidates import DECISIONS, candidates, changed
from facerender.planning.plan import Plan, plan
from facerender.pricing.table import load_prices
from facerender.scene.view import view_of
from tests.verification.forward import forward_passes
from tests.verification.subjects import BUDGETS, KINDS, Subject, brute_force

SIZE = (512, 512)
SMALL = (64, 64)
TURNTABLES = {"one": 1, "around": 8}  # numbers of planned cameras, keyed by mode
TIMED = 3  # planning is timed for one scene in three
UNPLANNED = 10
FRAME = (256, 256)
FRACTIONS = (
    ("1/255", "100%"),
    ("1/255", "99.9%"),
    ("3/255", "100%"),
    ("1/255", "95%"),
    ("1/255", "90%"),
)
MODES = {"one": "one camera", "around": "eight cameras"}


def cameras(count: int) -> list[fr.Camera]:
    """Return random cameras that differ from the planned ones in direction and distance."""
    random = np.random.default_rng(7)
    return [
        fr.Camera(
            random.uniform(-180, 180),
            random.uniform(-30, 40),
            zoom=random.uniform(0.8, 2.5),
            frame="all",
        )
        for _ in range(count)
    ]


class Views:
    """OpenGL images of a subject at several cameras, and the largest errors of other shadings."""

    def __init__(self, renderer: fr.Renderer, subject: Subject, at: Sequence[fr.Camera]) -> None:
        self.renderer, self.subject = renderer, subject
        self.scenes = [replace(subject.scene, camera=each, background=None) for each in at]
        self.exact = [self._draw(scene, subject.full) for scene in self.scenes]
        self.known: dict[fr.Shading, list[float]] = {}

    def errors(self, shading: fr.Shading) -> list[float]:
        """Return the largest error at each camera, as a fraction of the encoded range."""
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
    """A plan, and the largest image errors at its cameras and at others."""

    plan: Plan
    planned: list[float]
    unplanned: list[float]


Results = dict[tuple[str, str, str], Result]  # by scene, budget and price table


def short(found: Plan) -> str:
    """Return a short description of a plan's choices."""
    shading, full = found.shading, found.full
    differs = changed(shading, full)
    if not differs:
        return "exact: nothing saved"
    words = {
        "lights": f"specular of {listed(shading.specular_lights or ())}",
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
    """Return the names of lights."""
    names = ("key", "rim", "fill")  # of scenes with several lights
    return " and ".join(names[light] for light in lights) or "no light"


def cost_rows(results: Results, names: Iterable[str], budget: str) -> list[dict[str, Any]]:
    """Return the plans of all scenes for a budget, by price table."""
    rows = []
    for name in names:
        row: dict[str, Any] = {"scene": name}
        for kind in KINDS:
            found = results[name, budget, kind].plan
            specular = found.cost.specular / found.cost.full_specular
            chosen = short(found)
            row[kind] = {"cost": found.cost.relative, "specular": specular, "chosen": chosen}
        rows.append(row)
    return rows


def violations(results: Iterable[Result], unplanned: bool) -> dict[str, Any]:
    """Return the number of cameras whose error exceeds the budget, the number of all cameras, and
    the largest ratio of error to budget."""
    pairs = [
        (error, each.plan.budget.limit)
        for each in results
        for error in (each.unplanned if unplanned else each.planned)
    ]
    over = sum(error > limit for error, limit in pairs)
    return {"over": over, "of": len(pairs), "largest": max(error / limit for error, limit in pairs)}


def rates(modes: dict[str, Results]) -> Iterator[dict[str, Any]]:
    """Yield how often plans exceed their budgets, at the planned cameras and at others."""
    for (mode, results), budget in product(modes.items(), BUDGETS):
        chosen = [each for key, each in results.items() if key[1] == budget]
        own, others = violations(chosen, False), violations(chosen, True)
        yield {"planned": MODES[mode], "budget": budget, "own": own, "others": others}


def checks(modes: dict[str, Results]) -> Iterator[dict[str, Any]]:
    """Yield the difference between sums of prices and RADV's estimate of the whole program."""
    for family in amd.FAMILIES:
        plans = [e.plan for kept in modes.values() for key, e in kept.items() if key[2] == family]
        off = [abs(each.cost.relative - compiled(each, family)) for each in plans]
        yield {"family": family, "largest": max(off), "median": statistics.median(off)}


@cache
def estimate(program: Program, family: str) -> float:
    """Return RADV's estimate of a fragment program in cycles."""
    (price,) = cycles([program], family)
    return price


def compiled(found: Plan, family: str) -> float:
    """Return RADV's estimate of the plan's fragment programs relative to the full programs.

    Parts are weighted by their numbers of faces, as in prices.
    """

    def total(shading: fr.Shading) -> float:
        resolved = resolve(found.scene, shading)
        *_, last = forward_passes(resolved, view_of(resolved.scene, 1.0), (64, 64))
        return sum(
            len(draw.part.part.faces) * estimate(draw.program, family)
            for draw in last.draws
            if draw.part
        )

    return total(found.shading) / total(found.full)


def brute(subject: Subject, renderer: fr.Renderer) -> tuple[int, int]:
    """Compare plans with an exhaustive search.

    Returns the number of candidate shadings, and the number of plans that cost more than the
    cheapest shading within the budget. There is a plan for each budget and price table.
    """
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


def plans_of(
    renderer: fr.Renderer, subject: Subject, modes: dict[str, Results], unplanned: Views
) -> None:
    """Add the plans of a scene for all budgets and price tables, with their image errors."""
    around = fr.turntable(subject.scene.camera, TURNTABLES["around"])
    planned = Views(renderer, subject, around)  # the first is the scene's camera
    for (mode, results), budget, kind in product(modes.items(), BUDGETS, KINDS):
        at = around[: TURNTABLES[mode]]
        found = plan(
            subject.scene, budget, full=subject.full, cost=kind, renderer=renderer, cameras=at
        )
        drawn = planned.errors(found.shading)[: len(found.cameras)]
        others = unplanned.errors(found.shading)
        results[subject.name, budget, kind] = Result(found, drawn, others)


def seconds_of(renderer: fr.Renderer, subject: Subject, count: int) -> float:
    """Return the time to compute a plan within 1/255 for several cameras."""
    around = fr.turntable(subject.scene.camera, count)
    start = time.perf_counter()
    plan(subject.scene, "1/255", full=subject.full, cost="auto", renderer=renderer, cameras=around)
    return time.perf_counter() - start


def frames() -> None:
    """Print the measured cost of each scene's plans, and the medians over the scenes."""
    costs: dict[str, list[float]] = {}
    with fr.Renderer(FRAME) as renderer:
        for subject, (budget, within) in product(scenes(), FRACTIONS):
            found = plan(subject.scene, budget, full=subject.full, within=within, renderer=renderer)
            kind = f"{budget} at {within}"
            costs.setdefault(kind, []).append(found.cost.relative)
            print(f"{kind}, {subject.name}: {found.cost}", flush=True)
    for kind, ratios in costs.items():
        print(f"{kind}: median {statistics.median(ratios):.2f}, {[round(r, 2) for r in ratios]}")


def main() -> None:
    if sys.argv[1:] == ["frames"]:
        frames()
        return
    modes: dict[str, Results] = {mode: {} for mode in MODES}
    counts: dict[str, tuple[int, int]] = {}
    seconds: dict[str, list[float]] = {mode: [] for mode in MODES}
    # The texts of a plan's decisions take most of the time, and no choice depends on them.
    choices_only = patch("facerender.planning.plan.decisions", lambda *_: ())
    with fr.Renderer(SIZE) as renderer, fr.Renderer(SMALL, samples=1) as small:
        for number, subject in enumerate(scenes()):
            print(subject.name, flush=True)
            if number % TIMED == 0:
                for mode, count in TURNTABLES.items():
                    seconds[mode].append(seconds_of(renderer, subject, count))
            with choices_only:
                plans_of(renderer, subject, modes, Views(renderer, subject, cameras(UNPLANNED)))
                counts[subject.name] = brute(subject, small)
    numbers = [number for number, _ in counts.values()]
    save(
        "plan",
        costs={
            mode: {each.split("/")[0]: cost_rows(results, counts, each) for each in BUDGETS}
            for mode, results in modes.items()
        },
        rates=[*rates(modes)],
        checks=[*checks(modes)],
        search={
            "shadings": [min(numbers), max(numbers)],
            "plans": len(counts) * len(BUDGETS) * len(KINDS),
            "scenes": len(counts),
            "dearer": sum(dearer for _, dearer in counts.values()),
        },
        seconds={mode: [statistics.median(times), max(times)] for mode, times in seconds.items()},
    )


if __name__ == "__main__":
    main()
