"""What numbers of samples cost and lose, against 64 samples: at the silhouette and inside."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from facerender.drawing.frame import Frame
from facerender.drawing.renderer import Renderer
from facerender.errors import InputError
from facerender.images.srgb import linear_to_srgb
from facerender.job import MAX_SAMPLES
from facerender.measure.measurement import Lost, Sampled
from facerender.pricing.frame import ratios
from facerender.scenes.scene import SHADING_RATES, Scene
from facerender.shading import Shading


def antialiasing(
    renderer: Renderer,
    scene: Scene,
    samples: Sequence[int] = (1, 4, 8, 16),
    shading: Shading = Shading(),
    repeats: int = 9,
) -> list[Sampled]:
    """Measure numbers of samples, shaded once a pixel as well where that can be drawn; their
    frames take turns.

    Raises
    ------
    InputError : the scene cannot be drawn, or sees nothing of the mesh; a number out of 1 to 64
    """
    reference = renderer.render(scene, shading, samples=MAX_SAMPLES).linear
    parts = reference[..., 3]
    if not parts.any():
        raise InputError(f"the camera sees nothing of {scene.mesh.name}")
    silhouette, inside = (parts > 0.0) & (parts < 1.0), parts == 1.0
    shown = linear_to_srgb(reference[..., :3].astype(np.float64))

    def lost(draw: Callable[[], Frame]) -> tuple[Lost, Lost]:
        linear = draw().linear[..., :3].astype(np.float64)
        error = np.abs(linear_to_srgb(linear) - shown).max(axis=-1)
        return lost_of(error[silhouette]), lost_of(error[inside])

    ways = [
        (count, rate)
        for count in samples
        for rate in SHADING_RATES
        if rate == "sample" or renderer.can_shade_per_pixel(scene, count)
    ]
    draws = [
        partial(renderer.render, scene, shading, samples=count, shading_rate=rate)
        for count, rate in ((1, SHADING_RATES[0]), *ways)
    ]
    _, *times = ratios(draws, repeats)
    return [
        Sampled(count, ratio, *lost(draw), rate)
        for (count, rate), ratio, draw in zip(ways, times, draws[1:], strict=True)
    ]


def lost_of(errors: NDArray[np.float64]) -> Lost:
    """Return what errors of the displayed image come to, (N,) from 0 to 1."""
    if not errors.size:
        return Lost(0.0, 0.0, 0.0)
    return Lost(
        float(errors.mean()), float(np.quantile(errors, 0.99)), float((errors > 1 / 255).mean())
    )
