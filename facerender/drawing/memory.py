"""Memory that drawing takes: how much is told before it is taken. No OpenGL here."""

from __future__ import annotations

import math

from facerender.drawing.prepare import part_maps
from facerender.errors import InputError
from facerender.scenes.mips import Kind
from facerender.scenes.scene import Scene
from facerender.scenes.texture import Texture
from facerender.system.memory import MIB, limit

# Bytes, measured on llvmpipe: of the package and a context, of programs, of a triangle, of a pixel,
# and of each of its samples.
_ALWAYS, _PROGRAMS = 110 * MIB, 90 * MIB
_OF_TRIANGLE, _OF_PIXEL, _OF_SAMPLE = 500, 48, 20


def check_memory(
    scene: Scene, size: tuple[int, int], samples: int, albedo: Kind, most: float | None
) -> None:
    """Raise InputError where drawing a scene takes more memory than it may.

    Parameters
    ----------
    scene : as it is drawn
    samples : per pixel, as the driver draws them at once
    albedo : kind of albedo maps, "color" or "linear-color"
    most : MiB that the process may have; None for what the system has left
    """
    if (needed := needed_memory(scene, size, samples, albedo)) > (free := limit(most)):
        raise InputError(
            f"{scene.mesh.name} at {size[0]} x {size[1]} with {samples} samples takes about "
            f"{needed:.0f} MiB of {free:.0f}: give a smaller size, fewer samples or smaller maps"
        )


def needed_memory(scene: Scene, size: tuple[int, int], samples: int, albedo: Kind) -> float:
    """Return about how many MiB the process has at the most when it draws a scene; parameters as of
    :func:`check_memory`."""
    mesh = scene.mesh
    maps: dict[tuple[Texture, Kind], None] = {}
    for part, material in zip(mesh.parts, mesh.materials, strict=True):
        for _, texture, kind in part_maps(part, material, albedo, slope_filter=True):
            maps[texture, kind] = None
    kept = _ALWAYS + _OF_TRIANGLE * float(sum(len(part.faces) for part in mesh.parts))
    decoding = 0.0
    for texture, kind in maps:
        chain = math.prod(texture.size) * (8 if kind == "linear-color" else 4) * 4.0 / 3.0
        image = 4.0 * math.prod(texture.decoded_size)
        kept += chain if texture.coarse else 2.0 * chain
        decoding = max(decoding, image if texture.coarse else 2.0 * image + 0.25 * chain)
    drawing = _PROGRAMS + math.prod(size) * (_OF_PIXEL + samples * _OF_SAMPLE)
    return (kept + max(decoding, drawing)) / MIB
