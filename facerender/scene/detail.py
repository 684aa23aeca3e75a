"""Levels of detail: the settings of a frame, and the images that a scene's plan covers."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from operator import index
from typing import Any

from facerender.errors import InputError, shown
from facerender.images.files import MAX_SIDE
from facerender.mesh.mesh import TRIANGLES
from facerender.mesh.simplify import simplified
from facerender.scene.scene import Scene, ShadingRate, check_shading_rate
from facerender.values.ranges import IntegerRange, check_fields, ranged

_SAME_SHAPE = 1.01  # tolerance factor on the aspect ratio, because sizes are rounded


@dataclass(frozen=True)
class LevelOfDetail:
    """Settings that determine a frame's samples and triangles.

    samples, shading_rate : see :meth:`facerender.Renderer.render`
    triangles : triangle limit of the simplified mesh; None for all triangles
    cull_back_faces : whether all parts are drawn without back faces
    """

    samples: int
    triangles: int | None
    cull_back_faces: bool = False
    shading_rate: ShadingRate = "sample"

    @property
    def values(self) -> dict[str, Any]:
        """Keyword arguments for :meth:`facerender.Renderer.render`."""
        return {"samples": self.samples, "shading_rate": self.shading_rate}

    def of(self, scene: Scene) -> Scene:
        """Return the scene with its mesh simplified, and without back faces if they are culled. The
        frame before changes alike. Raises the errors of :func:`simplified`."""
        mesh = scene.mesh
        if self.triangles is not None:
            mesh = simplified(mesh, self.triangles)
        if self.cull_back_faces:
            mesh = mesh.single_sided
        if mesh is scene.mesh:
            return scene
        return replace(scene, mesh=mesh, before=scene.before and self.of(scene.before))


@dataclass(frozen=True)
class Planned:
    """The images for which a plan measured its error, and the settings that the plan chose.

    Parameters
    ----------
    sizes : width and height of each image in pixels
    samples : samples per pixel of these images if drawn without the plan
    drawn_samples : samples per pixel that the plan draws; None for the value of ``samples``
    triangles, cull_back_faces, shading_rate : see :class:`LevelOfDetail`

    Raises
    ------
    InputError : invalid sizes or samples
    """

    sizes: tuple[tuple[int, int], ...]
    samples: int
    drawn_samples: int | None = ranged(IntegerRange(1, math.inf), None)
    triangles: int | None = ranged(TRIANGLES, None)
    cull_back_faces: bool = False
    shading_rate: ShadingRate = "sample"

    def __post_init__(self) -> None:
        try:
            sizes = tuple((index(width), index(height)) for width, height in self.sizes)
            numbers = [index(self.samples), *(number for size in sizes for number in size)]
        except (TypeError, ValueError):
            numbers = []
        if len(numbers) < 3 or not 1 <= min(numbers) <= max(numbers) <= MAX_SIDE:
            raise InputError(
                f"planned sizes = {shown(self.sizes)}, samples = {shown(self.samples)}: give "
                f"widths and heights up to {MAX_SIDE}, such as [[512, 512], [1024, 1024]], and a "
                "number of samples"
            )
        check_fields(self, "planned ")
        check_shading_rate("planned shading_rate", self.shading_rate)
        object.__setattr__(self, "sizes", sizes)

    def holds(self, size: tuple[int, int], samples: int) -> bool:
        """Return whether the plan covers an image.

        The samples per pixel must be the planned number; size and aspect ratio must be in the
        planned ranges. One sample per pixel is also covered if the plan draws all triangles and
        back faces: that sample is at the pixel's centre, where every plan's error is measured.
        """
        centres = self.triangles is None and not self.cull_back_faces
        widths, heights = zip(*self.sizes, strict=True)
        shapes = [width / height for width, height in self.sizes]
        return (
            samples in (self.samples, 1 if centres else self.samples)
            and min(widths) <= size[0] <= max(widths)
            and min(heights) <= size[1] <= max(heights)
            and min(shapes) / _SAME_SHAPE <= size[0] / size[1] <= max(shapes) * _SAME_SHAPE
        )

    @property
    def detail(self) -> LevelOfDetail:
        """Level of detail that the plan draws for an image."""
        samples = self.drawn_samples or self.samples
        return LevelOfDetail(samples, self.triangles, self.cull_back_faces, self.shading_rate)

    def __str__(self) -> str:
        extremes = dict.fromkeys((min(self.sizes), max(self.sizes)))
        sizes = " to ".join(f"{width} x {height}" for width, height in extremes)
        return f"{sizes} pixels with {self.samples} sample{'s' if self.samples > 1 else ''}"
