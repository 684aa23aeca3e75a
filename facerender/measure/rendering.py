"""Measures cost and error of renderer settings: samples per pixel, and parts of skin shading.

The reference is an image with 64 samples per pixel, or with the finest setting of the part.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from facerender.drawing.renderer import Renderer
from facerender.errors import InputError
from facerender.images.srgb import linear_to_srgb
from facerender.measure.measurement import DisplayError, PartSetting, SampleSetting
from facerender.pricing.frame import ratios
from facerender.scenes.environment import Environment, studio
from facerender.scenes.file import MAX_SAMPLES
from facerender.scenes.scene import SHADING_RATES, Scene
from facerender.shading import SCATTER_SAMPLES, Shading
from facerender.terms.lobe import MIN_SLOPE

_SOFT = 5.0  # angular radius of the area light, degrees


def display_error(
    image: NDArray[np.float32], reference: NDArray[np.float32], where: NDArray[np.bool_]
) -> DisplayError:
    """Return the error of the displayed image at the pixels where the mask (H, W) is true.

    Both images are linear, (H, W, 4).
    """
    a, b = (
        linear_to_srgb(pixels[where][:, :3].astype(np.float64)) for pixels in (image, reference)
    )
    errors = np.abs(a - b).max(axis=-1)
    if not errors.size:
        return DisplayError(0.0, 0.0, 0.0)
    return DisplayError(
        float(errors.mean()), float(np.quantile(errors, 0.99)), float((errors > 1 / 255).mean())
    )


def antialiasing(
    renderer: Renderer,
    scene: Scene,
    samples: Sequence[int] = (1, 4, 8, 16),
    shading: Shading = Shading(),
    repeats: int = 9,
) -> list[SampleSetting]:
    """Measure cost and error of each number of samples per pixel; the frames are drawn in turns.

    Per-pixel shading is measured as well if the renderer supports it.

    Raises
    ------
    InputError : the scene cannot be drawn, the mesh is not in view, or a number of samples is not
        in [1, 64]
    """
    reference = renderer.render(scene, shading, samples=MAX_SAMPLES).linear
    coverage = reference[..., 3]
    if not coverage.any():
        raise InputError(f"{scene.mesh.name} is not in view: change the camera")
    silhouette, inside = (coverage > 0.0) & (coverage < 1.0), coverage == 1.0
    settings = [
        (count, rate)
        for count in samples
        for rate in SHADING_RATES
        if rate == "sample" or renderer.can_shade_per_pixel(scene, count)
    ]
    draws = [
        partial(renderer.render, scene, shading, samples=count, shading_rate=rate)
        for count, rate in ((1, SHADING_RATES[0]), *settings)
    ]
    _, *times = ratios(draws, repeats)
    measured = []
    for (count, rate), time, draw in zip(settings, times, draws[1:], strict=True):
        image = draw().linear
        at_edges, within = (display_error(image, reference, mask) for mask in (silhouette, inside))
        measured.append(SampleSetting(count, time, at_edges, within, rate))
    return measured


@dataclass(frozen=True)
class _Setting:
    name: str
    scene: Scene
    shading: Shading = Shading()


def skin_parts(renderer: Renderer, scene: Scene, repeats: int = 9) -> list[PartSetting]:
    """Measure cost and error of shadows, lobes, diffuse light, scattering and environment light.

    Frames have one sample per pixel; frames with the settings of a part are drawn in turns.
    Scattering is skipped for a mesh of unknown size.

    Raises
    ------
    InputError : the scene cannot be drawn, or the mesh is not in view
    """
    measured: list[PartSetting] = []
    for part, settings in _parts(scene):
        draws = [
            partial(renderer.render, setting.scene, setting.shading, samples=1)
            for setting in settings
        ]
        finest = draws[-1]().linear
        covered = finest[..., 3] == 1.0
        if not covered.any():
            raise InputError(f"{scene.mesh.name} is not in view: change the camera")
        for setting, time, draw in zip(settings, ratios(draws, repeats), draws, strict=True):
            error = display_error(draw().linear, finest, covered)
            measured.append(PartSetting(part, setting.name, time, error))
    return measured


def _parts(scene: Scene) -> Iterator[tuple[str, list[_Setting]]]:
    """Yield each part of skin shading with its settings, from the simplest to the finest."""
    mesh, (key, *other_lights) = scene.mesh, scene.lights
    other_lights = [replace(light, shadow=False) for light in other_lights]

    def lit(radius: float, shadow: bool) -> Scene:
        return replace(scene, lights=(replace(key, radius=radius, shadow=shadow), *other_lights))

    yield (
        f"shadow of a light of {_SOFT:g} degrees",
        [
            _Setting("none", lit(_SOFT, False)),
            _Setting("hard", lit(0.0, True)),
            _Setting("soft", lit(_SOFT, True)),
        ],
    )
    sharper = all(0.5 * material.m >= MIN_SLOPE for material in mesh.materials)
    lobes = mesh.with_material(second_slope=0.5 if sharper else 2.0, lobe_weight=0.8)
    yield "lobes", [_Setting("1", scene), _Setting("2", replace(scene, mesh=lobes))]
    coupled = Shading(diffuse="coupled")
    yield "diffuse light", [_Setting("lambert", scene), _Setting("coupled", scene, coupled)]
    if mesh.millimetres is not None:
        skin = replace(scene, mesh=mesh.with_material(scattering="skin"))
        counts = sorted(SCATTER_SAMPLES)
        yield (
            "samples of scattering",
            [_Setting(str(count), skin, Shading(scatter_samples=count)) for count in counts],
        )
    around = replace(scene, lights=(), ambient=(0.0, 0.0, 0.0), environment=Environment(studio()))
    yield (
        "samples of an environment",
        [
            _Setting(str(count), around, Shading(environment_samples=count))
            for count in (0, 8, 16, 32, 128)
        ],
    )
