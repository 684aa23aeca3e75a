"""Levels of detail: the settings of a frame, and the images that a scene's plan covers."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

from facerender.errors import InputError, quoted
from facerender.images.files import MAX_SIDE
from facerender.mesh.mesh import TRIANGLES
from facerender.mesh.simplify import simplified
from facerender.scene.scene import SHADING_RATES, Scene, ShadingRate
from facerender.values.fields import SWITCH, Choice, IntegerRange, SizeRange, field, record

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


class _Sizes(SizeRange):
    """Several sizes of images."""

    def check(self, name: str, value: Any) -> Any:
        sizes = value.tolist() if hasattr(value, "tolist") else value
        pairs = isinstance(sizes, list | tuple) and all(isinstance(s, list | tuple) for s in sizes)
        if not (pairs and sizes):
            raise InputError(f"{name} = {quoted(value)}: give sizes, such as [[512, 512]]")
        return tuple(super(_Sizes, self).check(name, size) for size in sizes)


@record("planned ")
class Planned:
    """The images for which a plan measured its error, and the settings that the plan chose."""

    sizes: tuple[tuple[int, int], ...] = field(
        _Sizes(1, MAX_SIDE, "pixels"), text="width and height of each image"
    )
    samples: int = field(
        IntegerRange(1, MAX_SIDE), text="samples per pixel of these images without the plan"
    )
    drawn_samples: int | None = field(
        IntegerRange(1, math.inf),
        None,
        "samples per pixel that the plan draws; None for the value of ``samples``",
    )
    triangles: int | None = field(TRIANGLES, None, "see :class:`LevelOfDetail`")
    cull_back_faces: bool = field(SWITCH, False, "see :class:`LevelOfDetail`")
    shading_rate: ShadingRate = field(
        Choice(SHADING_RATES), "sample", "see :meth:`facerender.Renderer.render`"
    )

    def covers(self, size: tuple[int, int], samples: int) -> bool:
        """Return whether the plan covers an image: its samples per pixel are the planned number,
        and its size and aspect ratio are in the planned ranges. One sample per pixel is also
        covered if the plan draws all triangles and back faces."""
        # One sample is at the pixel's centre, where every plan's error is measured.
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
