"""Measure the noise reduction of importance sampling, and the effect of coupled diffuse light.

    python -m benchmarks.skin_lobes

Writes docs/measurements/skin_lobes.json. Needs an OpenGL context.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

import facerender as fr
from benchmarks.data import save
from tests.verification.lights import PLAIN_THREE

Float = NDArray[np.float64]
SLOPES, DEGREES, COUNT = (0.1, 0.3, 0.5), (30, 60), 200_000


def variances() -> dict[str, dict[str, float]]:
    """Return ratios of the variance of reflected light, by m and by the camera's angle in degrees.

    Each is the variance with cosine-weighted directions divided by the variance with directions
    that are sampled from the lobe.
    """
    n, random = np.array([0.0, 0.0, 1.0]), np.random.default_rng(1)
    ratios: dict[str, dict[str, float]] = {f"{m:g}": {} for m in SLOPES}
    for m, degrees in product(SLOPES, DEGREES):
        v = np.array([np.sin(np.radians(degrees)), 0.0, np.cos(np.radians(degrees))])
        u = random.random((COUNT, 3))
        own = fr.brdf.cook_torrance_sample(n, v, m, u)
        weights = _weights(n, own, v, m, fr.brdf.cook_torrance_pdf(n, own, v, m))
        z, turn = np.sqrt(u[:, 0]), 2.0 * np.pi * u[:, 1]
        s = np.sqrt(1.0 - z**2)
        even = np.stack([s * np.cos(turn), s * np.sin(turn), z], axis=-1)
        ratio = _weights(n, even, v, m, z / np.pi).var() / weights.var()
        ratios[f"{m:g}"][f"{degrees:g}"] = float(ratio)
    return ratios


def _weights(n: Float, l: Float, v: Float, m: float, density: Float) -> Float:
    value = fr.brdf.cook_torrance(n, l, v, m, 0.028) * np.maximum(l @ n, 0.0)
    return np.divide(value, density, out=np.zeros_like(value), where=value > 0.0)


def coupled() -> dict[str, float]:
    """Return the effect of coupled diffuse light on the lit pixels of the head: mean and 99th
    percentile of the difference, in levels."""
    scene = fr.Scene(fr.load_mesh(), fr.Camera(azimuth=-35.0, zoom=1.35), PLAIN_THREE)
    with fr.Renderer((420, 420)) as renderer:
        shadings = fr.Shading(), fr.Shading(diffuse="coupled")
        plain, own = (renderer.render(scene, each).srgb8().astype(int) for each in shadings)
    steps = np.abs(plain - own).max(axis=-1)[plain.max(axis=-1) > 40]
    return {"mean": float(steps.mean()), "p99": float(np.quantile(steps, 0.99))}


if __name__ == "__main__":
    save("skin_lobes", variances=variances(), coupled=coupled())
