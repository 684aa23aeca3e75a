"""The passes of forward shading with one sample per pixel, for tests of programs and for other ways
to draw them."""

from __future__ import annotations

from facerender.drawing.frame_passes import Structure, image_passes
from facerender.drawing.maps import Maps
from facerender.drawing.prepare import ResolvedScene
from facerender.drawing.program import Pass
from facerender.scene.background import clear_color
from facerender.scene.view import View


def forward_passes(resolved: ResolvedScene, view: View, size: tuple[int, int]) -> list[Pass]:
    """Return the passes of an image without scattering and refraction."""
    scene, look = resolved.scene, resolved.appearance
    maps = Maps(look, scene.mesh, view, size, refracts=False)
    background = clear_color(scene.background)
    return image_passes(Structure(look, scene.mesh, maps, background, 1), None)
