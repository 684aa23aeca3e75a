"""Hill climbing from the worst random samples to inputs where a shader's error is the largest
fraction of the bound that its header states."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from facerender.scene.shading import Term
from facerender.terms.lobe import MIN_SLOPE, lobe_entry
from facerender.terms.model import FRESNEL, MASKING, MODELS
from tests.verification.cases import ALL_LOBES, F0, Case, Each
from tests.verification.evaluate import Inputs

Make = Callable[[Inputs], Case]
Bounds = tuple[float, float]

_COOK_TORRANCE = Term("cook-torrance")
# Terms and their f0: together they contain every lobe, masking and Fresnel term.
VARIANTS = [
    *(
        (Term(model, lobe, small_slope=small), F0)
        for model in MODELS
        for lobe in ALL_LOBES
        for small in ((True, False) if lobe == "exact" else (True,))
    ),
    *(
        (replace(_COOK_TORRANCE, masking=name, lobe=x), F0)
        for name in MASKING
        for x in ("exact", "d16")
    ),
    *((replace(_COOK_TORRANCE, fresnel=name), F0) for name in FRESNEL),
    # The error of 1 - V.H shows where f0 is near 0.
    *((replace(_COOK_TORRANCE, lobe=x), f0) for x in ("exact", "d8") for f0 in (0.0, 1e-8)),
]


def slopes_of(term: Term) -> Bounds:
    """Return the lowest and the highest slope m at which a term's bound holds."""
    return MIN_SLOPE, 0.999 * lobe_entry(term.lobe).end(term.entry.k)


def rounded(vectors: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return vectors (..., 3) normalised in float64 and rounded to float32."""
    unit = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(unit, dtype=np.float32)


def climb(
    target: Each,
    make: Make,
    first: Inputs,
    slopes: Bounds,
    starts: int,
    steps: int,
    tries: int = 16,
) -> tuple[float, dict[str, list[float]]]:
    """Return the largest error that was found, as a fraction of the bound, and its inputs.

    Every step tries neighbours of each start, at distances from 1e-8 to 0.1, and keeps the worst.

    Parameters
    ----------
    make : returns the case of inputs n, l, v, unit vectors (N, 3), and m (N,)
    first : random inputs; the worst of them become the starts
    slopes : range of m
    starts, steps : number of starts and of steps
    tries : neighbours per start and step
    """
    random = np.random.default_rng(0)

    def shares(inputs: Inputs) -> NDArray[np.float64]:
        case = make(inputs)
        result = target.each(case.prelude, [case.expression], inputs)[0]
        sound = np.isfinite(result) & (result >= 0.0)
        return np.where(sound, case.share(result), np.inf)

    vectors = {axis: rounded(first[axis].astype(float)) for axis in "nlv"}
    inputs = {**vectors, "m": first["m"]}
    share = shares(inputs)
    worst = np.argsort(share)[-starts:]
    at = {name: values[worst] for name, values in inputs.items()}
    best = share[worst]
    rows = np.arange(starts)
    for _ in range(steps):
        near = {name: np.repeat(values, tries, axis=0) for name, values in at.items()}
        reach = 10.0 ** random.uniform(-8.0, -1.0, (starts * tries, 1))
        for axis in "nlv":
            moved = near[axis] + reach * random.normal(size=near[axis].shape)
            same = random.random((starts * tries, 1)) < 0.4
            near[axis] = np.where(same, near[axis], rounded(moved))
        factor = np.exp(reach[:, 0] * random.normal(size=starts * tries))
        near["m"] = np.clip(near["m"] * factor, *slopes).astype(np.float32)
        found = shares(near).reshape(starts, tries)
        chosen = found.argmax(axis=1)
        better = found[rows, chosen] > best
        best = np.where(better, found[rows, chosen], best)
        for name, values in near.items():
            candidate = values.reshape(starts, tries, *values.shape[1:])[rows, chosen]
            at[name][better] = candidate[better]
    top = int(best.argmax())
    return float(best[top]), {name: values[top].tolist() for name, values in at.items()}
