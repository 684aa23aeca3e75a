"""Random samples of every public function of the shader library, as many as there is time for:
finite, >= 0, BRDFs exactly 0 below the surface, and terms within the bounds of their headers.

python -m tests.verification.many COUNT [TARGET ...]      such as 1e9 "WGSL, Vulkan"; default: all

Targets share what float64 makes of the samples. COUNT is of samples of each kind, at the least;
what has been seen is printed each minute, and the exit code is 1 after a draw with a fault.
"""

from __future__ import annotations

import argparse
import itertools
import math
import os
import re
import sys
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.drawing.evaluate import Inputs
from facerender.shading import Term
from facerender.terms import MASKING
from tests.verification import cases
from tests.verification.cases import Case, Each, Singles, brdf_case, singles
from tests.verification.climb import VARIANTS, slopes_of
from tests.verification.targets import LAVAPIPE, TARGETS, UNTRANSLATED, Remote, groups_of

MANY = 2**20  # samples of one draw
SLOPES = 256  # of a draw, where they are compared with float64

OWN_INPUTS = (  # what is called with other inputs here than in tests/verification/cases.py
    *("fr_masking_v_cavity", "fr_masking_kelemen", "fr_masking_of", "fr_masking_v_cavity_ratio"),
    *(
        "fr_masking_kelemen_ratio",
        "fr_lobe_fitted_coefficients",
        "fr_slope_filtered",
        "fr_slope_variance_map",
    ),
    *("fr_slope_variance_pixel", "fr_slope_variance_disc", "fr_cosine_disc"),
    *("fr_shadow_hard", "fr_shadow_lit", "fr_shadow_disc"),
    *("fr_scatter_profile", "fr_scatter_turn", "fr_scatter"),
)
TO_DIVIDE = "p.y + p.z, 4.0 * p.x, p.y, p.z"  # dot(n, h), dot(h, h), dot(n, l), dot(n, v)
OF_VECTORS = "dot(n, l + v), dot(l + v, l + v), dot(n, l), dot(n, v)"
WIDE, NARROW = "vec4(1e7, 2e7, 0.0, -0.01)", "vec4(4e7, 3e7, 1e7, -9.0)"
GAUSSIANS = f"vec4[4]({WIDE}, {NARROW}, {WIDE}, {NARROW})"
DENSITIES = ["vec3(3.0 * n.xy, min(tan2, 1e12))", "vec3(-40.0 * l.xy, c)"]
SPIRAL = f"vec3[16]({', '.join(DENSITIES * 8)})"
OTHERS = (
    ("scatter", f"fr_scatter_profile(min(tan2, 1e18), {GAUSSIANS})[0]"),
    ("scatter", "fr_scatter_turn(ivec2(16384.0 * p.xy)) + 4.0"),
    (
        "scatter",
        "fr_scatter(light_texels, n_texels, ivec2(gl_FragCoord.xy), 2.0, "
        f"{GAUSSIANS}, p, {SPIRAL})[1]",
    ),
    ("masking", "fr_masking_v_cavity(c, p.x, p.y, p.z)"),
    ("masking", "fr_masking_kelemen(max(p.x, 0.5 * (p.y + p.z)), p.y, p.z)"),
    ("masking", f"length(fr_masking_v_cavity_ratio({TO_DIVIDE}))"),
    ("masking", "length(fr_masking_kelemen_ratio(dot(n, l), dot(n, v)))"),
    *(
        ("masking", f"length(fr_masking_of({each}, {x.macro}))")
        for each in (TO_DIVIDE, OF_VECTORS)
        for x in MASKING.values()
    ),
    *(("lobe/fitted", f"length(fr_lobe_fitted_coefficients(m, {k}) * m * m)") for k in (0, 4)),
    *(("lobe/fitted", f"length(fr_lobe_fitted_fine_coefficients(m, {k}) * m * m)") for k in (0, 4)),
    ("slope_variance", "fr_slope_filtered(m, min(tan2, 1e18))"),
    ("slope_variance", "fr_slope_variance_map(c)"),
    ("slope_variance", "fr_slope_variance_pixel(tan2 * n, n - l)"),
    ("slope_variance", "fr_slope_variance_disc(0.34 * c, 0.97, p.x)"),
    ("slope_variance", "fr_cosine_disc(dot(n, l), 0.5 * c, 1.0 - 0.06 * c)"),
    ("shadow", "fr_shadow_lit(c_texels, ivec3(7, 0, 64), 1.2 * n.xy, n.z)"),
    ("shadow", "fr_shadow_hard(c_texels, ivec3(7, 0, 64), 1.2 * n, 0.004)"),
    (
        "shadow",
        "fr_shadow_disc(c_texels, ivec3(7, 0, 64), 1.2 * n, 8.0 * l.xy, 0.36 * c, 2.0, 0.004, m)",
    ),
)
BRDF = re.compile(r"\bfr_(?!\w+_pdf)\w+\(n, l, v, m\b")
OWN = {
    "numbers": [(file, call) for file, call in OTHERS if file not in UNTRANSLATED],
    "images": [(file, call) for file, call in OTHERS if file in UNTRANSLATED],
}
GROUPS = (*(group for group in cases.GROUPS if group not in OWN_INPUTS), *OWN)


def cases_of(group: str) -> dict[str, Case]:
    """Return the cases of one of GROUPS by name; their inputs are left to the caller."""
    if group not in OWN:
        return cases.cases_of(group)
    return {call: Case(cases.include(file), call, {}, np.zeros(1)) for file, call in OWN[group]}


class Random:
    """Inputs of the shader functions, in float32, dense where formulas break."""

    def __init__(self, seed: int, count: int) -> None:
        self.random, self.count = np.random.default_rng(seed), count

    def pick(self, count: int) -> NDArray[np.int64]:
        return self.random.integers(count, size=self.count)

    def often(self, one_of: int) -> NDArray[np.bool_]:
        """True for one of so many."""
        return np.asarray(self.pick(one_of) == 0)

    def even(self) -> Singles:
        """[0, 1)"""
        return self.random.random(self.count, dtype=np.float32)

    def small(self) -> Singles:
        """(0, 1]: log-uniform down to a bound that is drawn too; a third lies below 1e-12."""
        return singles(np.exp2(-126 * self.even() * self.even()))

    def cosine(self) -> Singles:
        """[0, 1] and an ulp more: uniform, log-uniform towards 0, towards 1, and the ends."""
        kind, tiny = self.pick(8), self.small()
        ends = singles([0.0, 1.0, 1.00000012])[self.pick(3)]
        return singles(
            np.select([kind < 3, kind < 5, kind < 7], [self.even(), tiny, 1 - tiny], ends)
        )

    def direction(self) -> Singles:
        """A unit vector: a quarter points below z = 0, many lie in that plane or along an axis."""
        z = np.minimum(self.cosine(), 1)
        r = np.sqrt((1 - z) * (1 + z))
        turn = np.where(self.often(4), 0, np.float32(2.0 * np.pi) * self.even())
        return np.stack([r * np.cos(turn), r * np.sin(turn), np.where(self.often(4), -z, z)], -1)

    def stretched(self, x: Singles) -> Singles:
        by = np.where(self.often(2), 0, np.float32(1e-6) * (2 * self.even() - 1))
        return singles(x * (1 + by)[:, None])

    def inputs(self) -> dict[str, Singles]:
        """Unit vectors n, l, v; p in (0, 1] for products of them; m, f0, c; tan2 by three names."""
        light, eye = self.direction(), self.direction()
        kind = self.pick(4)[:, None]
        mirrored = light * singles([-1, -1, 1])
        eye = np.select([kind == 1, kind == 2, kind == 3], [mirrored, light, -light], eye)
        shifted = unit(eye + self.small()[:, None] / 2 * self.direction())
        eye = np.where(self.often(2)[:, None], shifted, eye)

        up = np.where(self.often(2)[:, None], singles([0, 0, 1]), self.direction())
        axes = singles([[0, 1, 0], [1, 0, 0]])
        across = unit(np.cross(axes[(np.abs(up[:, 0]) < 0.5).astype(int)], up))
        frame = np.stack([across, np.cross(up, across), up], -1)
        n = self.stretched(up)
        l, v = (self.stretched(np.einsum("nij,nj->ni", frame, x)) for x in (light, eye))

        m = np.clip(2 * np.exp2(np.float32(-14.3) * self.even()), np.float32(1e-4), 2)
        m = np.where(self.often(8), singles([1e-4, 2.0])[self.pick(2)], m)
        reflectances = singles([0.0, 1e-8, 0.028, 0.99999994])
        f0 = np.where(self.often(2), reflectances[self.pick(4)], np.float32(0.999) * self.even())
        p = np.stack([self.cosine(), self.cosine(), self.cosine()], -1).clip(np.float32(1e-37))
        kind, tan2 = self.pick(8), self.small()
        tan2 = np.select([kind == 0, kind > 4], [np.float32(0), 1 / tan2], tan2)
        vectors = {"n": n, "l": l, "v": v, "p": p}
        scalars = {"m": m, "f0": f0, "c": self.cosine()}
        scalars |= {"second_m": np.roll(m, 1), "lobe_weight": self.even()}
        vectors["map"] = np.stack([self.cosine(), self.even(), self.small()], -1)
        vectors["plane"] = 16.0 * vectors["map"] - 8.0
        vectors["light"] = np.float32(1e12) * p
        scalars["w"] = 12.6 * self.small()
        return vectors | scalars | dict.fromkeys(("tan2", "x", "steepness"), tan2)


def unit(x: NDArray[np.floating[Any]]) -> Singles:
    return singles(x / np.linalg.norm(x, axis=-1, keepdims=True))


def faults(evaluator: Each, tried: Mapping[str, Case], inputs: Inputs) -> list[str]:
    """Tell what is wrong with the values of cases at other inputs than theirs, and the inputs of
    the first value that is."""
    calls = {name: case.expression.replace("_texels", "") for name, case in tried.items()}
    words = {name: re.findall(r"\w+", call) for name, call in calls.items()}
    used = {x: inputs[x] for x in inputs if any(x in each for each in words.values())}
    there = {name: replace(case, inputs=used) for name, case in tried.items()}
    # a dot product of two float32 vectors may round to the other side of 0
    below = np.minimum(*((inputs["n"] * inputs[name]).sum(axis=-1) for name in "lv")) < -2e-7
    told = []
    for name, found in cases.evaluated(there, evaluator).items():
        lit = below & (found != 0.0) & bool(BRDF.search(tried[name].expression))
        wrong = lit | ~((found >= 0.0) & (found < np.inf))
        if wrong.any():
            first = wrong.argmax()
            bad = {
                "NaN": np.isnan(found),
                "infinite": np.isinf(found),
                "negative": found < 0.0,
                "not 0 below the surface": lit,
            }
            counts = ", ".join(f"{where.sum()} {what}" for what, where in bad.items())
            told.append(f"{name}: {counts} in {len(found)} samples; first: {found[first]:.9g} at")
            told += [f"{x} = {used[x][first].tolist()}" for x in used if x in words[name]]
    return told


class Count:
    """What a target has shown, to several threads.

    Attributes
    ----------
    finite, bounded : samples that were looked at, for the one and for the other
    worst : largest share of a bound, and the term that has it
    told : what is wrong
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self.finite, self.bounded = 0, 0
        self.worst = 0.0, ""
        self.told: list[str] = []

    def __str__(self) -> str:
        share, term = self.worst
        return (
            f"{self.finite:.3e} samples, {len(self.told)} faults; {self.bounded:.3e} samples, "
            f"{share:.3f} of the bound at most, of {term}"
        )

    def look(self, target: Each, group: str, inputs: Inputs) -> None:
        """Look for what is not finite, negative, or not 0 below the surface."""
        tried = cases_of(group)
        told = faults(target, tried, inputs)
        with self._lock:
            self.told += told
            self.finite += len(tried) * len(inputs["n"])

    def compare(self, target: Each, case: Case, name: str) -> None:
        """Compare with float64."""
        result = target.each(case.prelude, [case.expression], case.inputs)[0]
        fault, share = case.fault(result), float(case.share(result).max())
        with self._lock:
            self.told += [f"{name}: {fault}"] * bool(fault)
            self.worst = max(self.worst, (share, name))
            self.bounded += len(result)


def bounded(term: Term, f0: float, inputs: Inputs, seed: int) -> Case:
    """Return a term at directions of the inputs, at a few slopes: each has a peak to be found."""
    random = np.random.default_rng(seed)
    low, high = map(math.log, slopes_of(term))
    few = singles(np.exp(random.uniform(low, high, SLOPES)))
    slopes = random.choice(few, len(inputs["n"]))
    return brdf_case(term, {**{axis: inputs[axis] for axis in "nlv"}, "m": slopes}, f0=f0)


def draw(counts: Mapping[Remote, Count], seed: int, wanted: float) -> Iterator[None]:
    """Look at MANY samples of each expression, of the kinds of which there have not been enough, on
    all cores; yield now and then."""
    inputs = Random(seed, MANY).inputs()

    def compare(variant: tuple[Term, float]) -> None:
        case = bounded(*variant, inputs, seed)
        for target, count in counts.items():
            count.compare(target, case, "{}, f0 = {}".format(*variant))

    def look(group: str) -> None:
        for target, count in counts.items():
            if group in groups_of(target.name, GROUPS):
                count.look(target, group, inputs)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        if min(count.bounded for count in counts.values()) < wanted:
            yield from pool.map(compare, VARIANTS)
        if min(count.finite for count in counts.values()) < wanted:
            yield from pool.map(look, GROUPS)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.verification.many", description=__doc__)
    parser.add_argument("count", type=float, metavar="COUNT", help="such as 1e9")
    known = [*TARGETS, *LAVAPIPE]
    parser.add_argument("targets", nargs="*", metavar="TARGET", help=f"of {', '.join(known)}")
    parser.add_argument("--first", type=int, default=0, metavar="N", help="draw to begin with (0)")
    given = parser.parse_args()
    if unknown := set(given.targets).difference(known):
        parser.error(f"no target {', '.join(unknown)}; there are {', '.join(known)}")
    with ExitStack() as stack:
        counts = {stack.enter_context(Remote(name)): Count() for name in given.targets or known}
        last = time.monotonic()
        for seed in itertools.count(given.first):
            for _ in draw(counts, seed, given.count):
                if time.monotonic() > last + 60.0:
                    last = tell(counts, seed)
            tell(counts, seed)
            if any(count.told for count in counts.values()):
                return 1
            if all(min(count.finite, count.bounded) >= given.count for count in counts.values()):
                break
    return 0


def tell(counts: Mapping[Remote, Count], seed: int) -> float:
    """Print what has been seen, and return the time."""
    for target, count in counts.items():
        print(f"{target.name}, draw {seed}: {count}", *count.told, sep="\n", flush=True)
    return time.monotonic()


if __name__ == "__main__":
    sys.exit(main())
