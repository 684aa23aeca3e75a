"""Deferred shading: the visibility pass finds the visible triangle at each sample. The shading pass
then shades each triangle once in every pixel where the triangle is visible."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from facerender.drawing.passes import Area, Draw, Pass, Target
from facerender.drawing.passes.transparency import unblended
from facerender.drawing.program import IN_ROW, Program, Uniforms, table_features
from facerender.drawing.triangle_setup import around, triangle_setup_of
from facerender.scenes.mesh import Part, drawn_alpha
from facerender.scenes.scene import Scene, ShadingRate
from facerender.scenes.view import View

# Drivers on which deferred shading can be cheaper than forward shading: see
# docs/measurements/performance.md.
DRIVERS = ("llvmpipe",)
# With one sample per pixel, and more pixels per triangle than this, forward shading is faster.
_MOST_PIXELS = 30
_MOST_TRIANGLES = 1 << 24  # float32 represents all whole numbers up to this one exactly
_SELECTED = ("SELECTED", f"TRIANGLES_IN_ROW {IN_ROW}")
_BRIGHTEST = 1e3  # largest background channel: float32 adds and subtracts 1e3 with an error of 6e-5


def can_defer(scene: Scene, rows: int) -> bool:
    """Return whether deferred shading supports a scene.

    No part may have an alpha mask, and some part must be opaque. Opaque parts must use one set of
    texture coordinates, and have fewer than 2^24 triangles. The triangle data of each part must fit
    into one texture. No channel of the background may exceed 1000.

    rows : largest height of a texture, in texels
    """
    pairs = unblended(scene, [*zip(scene.mesh.parts, scene.mesh.materials, strict=True)])
    counts = [len(part.faces) for part, _ in pairs]
    return (
        0 < sum(counts) < _MOST_TRIANGLES
        and max(counts) <= rows * IN_ROW
        and max(scene.background or (0.0,)) <= _BRIGHTEST
        and not any(drawn_alpha(*pair) == "mask" for pair in pairs)
        and not any(part.uv2 is not None and material.second_uv for part, material in pairs)
    )


def deferred_is_cheaper(scene: Scene, size: tuple[int, int], samples: int, driver: str) -> bool:
    """Return whether measurements found deferred shading cheaper than forward shading.

    driver : value of GL_RENDERER
    """
    if not driver.startswith(DRIVERS):
        return False
    triangles = sum(len(part.faces) for part in scene.mesh.parts)
    return samples > 1 or triangles * _MOST_PIXELS > size[0] * size[1]


@dataclass(frozen=True, eq=False)
class Visible:
    """A part in the image of a visibility pass.

    first : value of the part's first triangle in the image, at least 1; the background has 0
    area : bounds of the part in the image; empty if the part is outside the image
    front : indices of the triangles that can face the camera; None if back faces are drawn too
    """

    part: Part
    first: int
    area: Area
    front: NDArray[np.int64] | None


@dataclass(frozen=True, eq=False)
class Visibility:
    """The visible triangle of each sample of an image.

    view : camera of the image
    size : width and height of the image in pixels
    samples : samples per pixel
    parts : parts of the scene that are not blended, in the order of the mesh
    shading_rate : "pixel" to shade one triangle for each part and pixel, "sample" to shade all
        visible triangles of a pixel
    """

    view: View
    size: tuple[int, int]
    samples: int
    parts: tuple[Visible, ...]
    shading_rate: ShadingRate = "sample"

    @classmethod
    def of(
        cls,
        scene: Scene,
        view: View,
        size: tuple[int, int],
        samples: int,
        shading_rate: ShadingRate = "sample",
    ) -> Visibility:
        """Assign an index to each triangle, and compute the bounds of each part in the image."""
        parts, first = [], 1
        pairs = [*zip(scene.mesh.parts, scene.mesh.materials, strict=True)]
        for part, material in unblended(scene, pairs):
            setup = triangle_setup_of(part, scene.mesh)
            area, front = setup.area(view, size), None
            if material.double_sided is False:
                front = setup.facing(view.position)
                area = area if len(front) else Area()
            parts.append(Visible(part, first, area, front))
            first += len(part.faces)
        return cls(view, size, samples, tuple(parts), shading_rate)

    @property
    def area(self) -> Area:
        """Bounds of all parts in the image."""
        return around([part.area for part in self.parts])

    @property
    def target(self) -> Target:
        """Target of the visibility pass."""
        return Target(samples=self.samples, sampled=True, values="number")

    def drawn(self) -> Pass:
        """Return the visibility pass."""
        draws = tuple(
            Draw(
                Program("visibility.frag", "visibility.vert", _SELECTED * (part.front is not None)),
                {"first": part.first},
                part.part,
                order=part.front,
                double_sided=part.front is None,
            )
            for part in self.parts
            if not part.area.empty
        )
        return Pass("visible", self.target, draws, uniforms={"view_projection": self.view.matrix})

    def shaded(self, drawn: Pass) -> Pass:
        """Convert a forward pass to a deferred pass, which shades the visible triangles. Blended
        parts are left out.
        """
        draws: list[Draw] = []
        opaque = (draw for draw in drawn.draws if draw.depth != "blend")
        for number, (draw, part) in enumerate(zip(opaque, self.parts, strict=True)):
            if not part.area.empty:
                draws += self._shaded(draw, part, number / len(self.parts))
        return replace(
            drawn,
            target=replace(drawn.target, samples=1),
            draws=tuple(draws),
            uniforms={
                **drawn.uniforms,
                **_rays(self.view, self.size),
                "background": np.asarray(drawn.clear[:3]),
            },
            added=True,
        )

    def _shaded(self, draw: Draw, part: Visible, depth: float) -> tuple[Draw, Draw]:
        """Return two draws: the first writes `depth` at the pixels that show a part, and the second
        shades these pixels.

        depth : depth value in [0, 1] that is different for each part
        """
        samples, rate = f"SAMPLES {self.samples}", ("PIXEL_RATE",) * (self.shading_rate == "pixel")
        uniforms = {"first": part.first, "triangle_count": len(part.part.faces), "depth": depth}
        visible = Program("visible.frag", "screen.vert", (samples,))
        program = replace(draw.program, vertex="screen.vert")
        shaded = replace(
            draw,
            program=program.having("VISIBLE", *rate, samples, *table_features(part.part)),
            uniforms={**draw.uniforms, **uniforms},
            area=part.area,
            depth="marked",
            double_sided=True,
        )
        return Draw(visible, uniforms, area=part.area, depth="mark"), shaded


def deferred(visibility: Visibility | None, forward: Pass) -> list[Pass]:
    """Return the passes of deferred shading for a forward pass. Without a visibility, return the
    forward pass."""
    return [visibility.drawn(), visibility.shaded(forward)] if visibility else [forward]


def _rays(view: View, size: tuple[int, int]) -> Uniforms:
    """Return the ray from the camera to the outer corner of pixel (0, 0), and the change of the ray
    per pixel in x and y."""
    back = np.linalg.inv(view.matrix)
    far_points = (np.array([x, y, 1.0, 1.0]) @ back for x, y in ((-1, -1), (1, -1), (-1, 1)))
    corner, right, up = (point[:3] / point[3] - view.position for point in far_points)
    return {"ray": corner, "ray_x": (right - corner) / size[0], "ray_y": (up - corner) / size[1]}
