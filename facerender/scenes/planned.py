"""For which images the shading of a scene was planned, and how finely they are drawn then: what a
scene file says of that."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from operator import index
from typing import Any

from facerender.errors import InputError, shown
from facerender.images.decode import MAX_SIDE
from facerender.scenes.lod import simplified
from facerender.scenes.mesh import TRIANGLES
from facerender.scenes.scene import Scene, ShadingRate, check_shading_rate
from facerender.terms.ranges import IntegerRange, check_fields, ranged

_SAME_SHAPE = 1.01  # width over height, of rounded sizes


@dataclass(frozen=True)
class LevelOfDetail:
    """How finely a frame is drawn.

    Attributes
    ----------
    samples : per pixel
    triangles : of the mesh, at most; None for all
    cull_back_faces, shading_rate : see :meth:`facerender.Renderer.render`
    """

    samples: int
    triangles: int | None
    cull_back_faces: bool = False
    shading_rate: ShadingRate = "sample"

    @property
    def values(self) -> dict[str, Any]:
        """The parameters of :meth:`facerender.Renderer.render` but for the triangles."""
        return {
            "samples": self.samples,
            "cull_back_faces": self.cull_back_faces,
            "shading_rate": self.shading_rate,
        }

    def of(self, scene: Scene) -> Scene:
        """Return a scene whose mesh has no more triangles; errors as of :func:`simplified`."""
        if self.triangles is None:
            return scene
        return replace(scene, mesh=simplified(scene.mesh, self.triangles))


@dataclass(frozen=True)
class Planned:
    """The images at which the error of a shading was measured.

    Parameters
    ----------
    sizes : width and height of each, in pixels
    samples : of each pixel
    drawn_samples, triangles : with how many samples and at most how many triangles the frame is
        drawn that stands for such an image; None for all
    cull_back_faces, shading_rate : how it is drawn, see :meth:`facerender.Renderer.render`

    Raises
    ------
    InputError : no such sizes or samples
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
                "number"
            )
        check_fields(self, "planned ")
        check_shading_rate("planned shading_rate", self.shading_rate)
        object.__setattr__(self, "sizes", sizes)

    def holds(self, size: tuple[int, int], samples: int) -> bool:
        """Tell whether an image is of the planned samples, and neither smaller nor larger nor of
        another shape than the planned ones. One sample is, with all triangles and
        their back faces: it is the pixel's centre, where every plan is measured."""
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
        """How finely the frame is drawn that stands for a planned one."""
        samples = self.drawn_samples or self.samples
        return LevelOfDetail(samples, self.triangles, self.cull_back_faces, self.shading_rate)

    def __str__(self) -> str:
        ends = dict.fromkeys((min(self.sizes), max(self.sizes)))
        sizes = " to ".join(f"{width} x {height}" for width, height in ends)
        return f"{sizes} pixels with {self.samples} sample{'s' if self.samples > 1 else ''}"
