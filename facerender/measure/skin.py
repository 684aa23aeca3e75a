"""What the parts of skin cost and lose at several settings, each against its finest."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from facerender.drawing.renderer import Renderer
from facerender.errors import InputError
from facerender.images.srgb import linear_to_srgb
from facerender.measure.antialiasing import lost_of
from facerender.measure.measurement import PartSetting
from facerender.pricing.frame import ratios
from facerender.scenes.environment import Environment, studio
from facerender.scenes.scene import Scene
from facerender.shading import SCATTER_SAMPLES, Shading
from facerender.terms.lobe import MIN_SLOPE

_SOFT = 5.0  # degrees


@dataclass(frozen=True)
class _Way:
    name: str
    scene: Scene
    shading: Shading = Shading()


def skin_parts(renderer: Renderer, scene: Scene, repeats: int = 9) -> list[PartSetting]:
    """Measure shadows, lobes, diffuse light, scattering and environment light, a sample a pixel;
    the frames of a part take turns. Scattering is left out of a mesh of unknown size.

    Raises
    ------
    InputError : the scene cannot be drawn, or sees nothing of the mesh
    """
    measured: list[PartSetting] = []
    for part, ways in _parts(scene):
        draws = [partial(renderer.render, each.scene, each.shading, samples=1) for each in ways]
        finest = draws[-1]().linear
        seen = finest[..., 3] == 1.0
        if not seen.any():
            raise InputError(f"the camera sees nothing of {scene.mesh.name}")
        exact = linear_to_srgb(finest[seen][:, :3].astype(np.float64))
        for way, time, draw in zip(ways, ratios(draws, repeats), draws, strict=True):
            shown = linear_to_srgb(draw().linear[seen][:, :3].astype(np.float64))
            error = np.abs(shown - exact).max(axis=-1)
            measured.append(PartSetting(part, way.name, time, lost_of(error)))
    return measured


def _parts(scene: Scene) -> Iterator[tuple[str, list[_Way]]]:
    """Yield each part with its settings, from without it to the finest."""
    mesh, (key, *others) = scene.mesh, scene.lights

    def lit(**changes: object) -> Scene:
        return replace(scene, lights=(replace(key, **changes), *others))  # type: ignore[arg-type]

    yield (
        f"shadow of a light of {_SOFT:g} degrees",
        [
            _Way("none", lit(radius=_SOFT)),
            _Way("hard", lit(shadow=True)),
            _Way("soft", lit(radius=_SOFT, shadow=True)),
        ],
    )
    sharper = all(0.5 * material.m >= MIN_SLOPE for material in mesh.materials)
    lobes = mesh.with_material(second_slope=0.5 if sharper else 2.0, lobe_weight=0.8)
    yield "lobes", [_Way("1", scene), _Way("2", replace(scene, mesh=lobes))]
    coupled = Shading(diffuse="coupled")
    yield "diffuse light", [_Way("lambert", scene), _Way("coupled", scene, coupled)]
    if mesh.millimetres is not None:
        skin = replace(scene, mesh=mesh.with_material(scattering="skin"))
        counts = sorted(SCATTER_SAMPLES)
        yield (
            "samples of scattering",
            [_Way(str(count), skin, Shading(scatter_samples=count)) for count in counts],
        )
    around = replace(scene, lights=(), ambient=(0.0, 0.0, 0.0), environment=Environment(studio()))
    yield (
        "samples of an environment",
        [
            _Way(str(count), around, Shading(environment_samples=count))
            for count in (0, 8, 16, 32, 128)
        ],
    )
