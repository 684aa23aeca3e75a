"""Random inputs of every public function of the shader library, dense where formulas break, and a
check of the results: finite, not negative, and 0 below the surface."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.terms.model import MASKING
from tests.verification import cases
from tests.verification.cases import Case, Each, Singles, singles
from tests.verification.evaluate import Inputs

MANY = 2**20  # samples of one draw

OWN_INPUTS = (  # groups whose inputs here differ from tests/verification/cases.py
    *("fr_masking_v_cavity", "fr_masking_kelemen", "fr_masking_of", "fr_masking_v_cavity_ratio"),
    *(
        "fr_masking_kelemen_ratio",
        "fr_lobe_fitted_coefficients",
        "fr_slope_filtered",
        "fr_slope_variance_map",
    ),
    *("fr_slope_variance_disc", "fr_cosine_disc"),
    *("fr_shadow_depth", "fr_shadow_weight", "fr_shadow_hard", "fr_shadow_disc"),
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
        f"fr_scatter(light_texels, n_texels, at, 2.0, {GAUSSIANS}, p, {SPIRAL})[1]",
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
    ("slope_variance", "fr_slope_variance_disc(0.34 * c, 0.97, p.x)"),
    ("slope_variance", "fr_cosine_disc(dot(n, l), 0.5 * c, 1.0 - 0.06 * c)"),
    ("shadow", "fr_shadow_depth(c_texels, ivec3(7, 0, 64), 64.0 * n.xy)"),
    ("shadow", "fr_shadow_weight(2.0 * n.xy, l.xy, 1.0 + 2.0 * c)"),
    ("shadow", "fr_shadow_hard(c_texels, ivec3(7, 0, 64), 1.2 * n, 8.0 * l.xy, 2.0, 0.004)"),
    (
        "shadow",
        "fr_shadow_disc(c_texels, ivec3(7, 0, 64), 1.2 * n, 8.0 * l.xy, 0.36 * c, 2.0, 0.004, 1.0, "
        "normalize(v.xy), vec2(0.5))",
    ),
)
BRDF = re.compile(r"\bfr_(?!\w+_pdf)\w+\(n, l, v, m\b")
GROUPS = (*(group for group in cases.GROUPS if group not in OWN_INPUTS), "others")


def cases_of(group: str) -> dict[str, Case]:
    """Return the cases of one of GROUPS by name; the caller replaces their inputs."""
    if group != "others":
        return cases.cases_of(group)
    return {call: Case(cases.include(file), call, {}, np.zeros(1)) for file, call in OTHERS}


class Random:
    """Random inputs of the shader functions, in float32, dense where formulas break."""

    def __init__(self, seed: int, count: int) -> None:
        self.random, self.count = np.random.default_rng(seed), count

    def pick(self, count: int) -> NDArray[np.int64]:
        return self.random.integers(count, size=self.count)

    def often(self, one_of: int) -> NDArray[np.bool_]:
        """Return True for one in ``one_of`` samples, at random."""
        return np.asarray(self.pick(one_of) == 0)

    def even(self) -> Singles:
        """Return numbers in [0, 1), uniformly distributed."""
        return self.random.random(self.count, dtype=np.float32)

    def small(self) -> Singles:
        """Return numbers in (0, 1], log-uniform down to a random bound; 1/3 are below 1e-12."""
        return singles(np.exp2(-126 * self.even() * self.even()))

    def cosine(self) -> Singles:
        """Return numbers in [0, 1 + 1 ulp]: uniform, dense near 0 and near 1, and the ends."""
        kind, tiny = self.pick(8), self.small()
        ends = singles([0.0, 1.0, 1.00000012])[self.pick(3)]
        return singles(
            np.select([kind < 3, kind < 5, kind < 7], [self.even(), tiny, 1 - tiny], ends)
        )

    def direction(self) -> Singles:
        """Return unit vectors: 1/4 have z < 0, and many lie near the plane z = 0 or an axis."""
        z = np.minimum(self.cosine(), 1)
        r = np.sqrt((1 - z) * (1 + z))
        turn = np.where(self.often(4), 0, np.float32(2.0 * np.pi) * self.even())
        return np.stack([r * np.cos(turn), r * np.sin(turn), np.where(self.often(4), -z, z)], -1)

    def stretched(self, x: Singles) -> Singles:
        by = np.where(self.often(2), 0, np.float32(1e-6) * (2 * self.even() - 1))
        return singles(x * (1 + by)[:, None])

    def inputs(self) -> dict[str, Singles]:
        """Return all inputs by name; tan2, x and steepness are the same numbers.

        n, l and v are unit vectors up to 1e-6; p has three numbers in (0, 1] for dot products.
        """
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


def faults(evaluator: Each, given: Mapping[str, Case], inputs: Inputs) -> list[str]:
    """Return messages about wrong values of cases at other inputs, with the first wrong input."""
    calls = {name: case.expression.replace("_texels", "") for name, case in given.items()}
    words = {name: re.findall(r"\w+", call) for name, call in calls.items()}
    used = {x: inputs[x] for x in inputs if any(x in each for each in words.values())}
    replaced = {name: replace(case, inputs=used) for name, case in given.items()}
    # In float32 the sign of a dot product near 0 is uncertain.
    below = np.minimum(*((inputs["n"] * inputs[name]).sum(axis=-1) for name in "lv")) < -2e-7
    faulty = []
    for name, found in cases.evaluated(replaced, evaluator).items():
        lit = below & (found != 0.0) & bool(BRDF.search(given[name].expression))
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
            faulty.append(f"{name}: {counts} in {len(found)} samples; first: {found[first]:.9g} at")
            faulty += [f"{x} = {used[x][first].tolist()}" for x in used if x in words[name]]
    return faulty


def faults_of_draw(evaluator: Each, seed: int) -> list[str]:
    """Return messages about wrong values of every case at the MANY samples of a seed."""
    inputs = Random(seed, MANY).inputs()
    return [each for group in GROUPS for each in faults(evaluator, cases_of(group), inputs)]
