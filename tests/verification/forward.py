"""The passes of forward shading with one sample per pixel, for tests of programs and for other ways
to draw them."""

from __future__ import annotations

from facerender.drawing.frame_passes import Structure, image_passes
from facerender.drawing.passes import Pass
from facerender.drawing.prepare import ResolvedScene
from facerender.drawing.shadows import shadow_texels
from facerender.scene.view import View


def forward_passes(resolved: ResolvedScene, view: View, size: tuple[int, int]) -> list[Pass]:
    """Return the passes of an image without scattering and refraction."""
    scene, look = resolved.scene, resolved.appearance
    texels = shadow_texels(look, view, size)
    background = scene.background or (0.0, 0.0, 0.0)
    return image_passes(
        Structure(look, scene.mesh, background, 1, lambda samples: False, texels=texels), None
    )
