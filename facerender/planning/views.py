"""Frames drawn by OpenGL: choose the level of detail, and measure errors of frames."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.drawing.passes.visibility import deferred_is_cheaper
from facerender.drawing.renderer import Renderer
from facerender.errors import InputError
from facerender.planning.budget import Budget, highest_but
from facerender.planning.candidates import alone, groups, values
from facerender.scenes.lod import LevelOfDetail
from facerender.scenes.scene import Scene
from facerender.shading import Shading

Float = NDArray[np.float64]

_FEWEST = 500  # smallest number of triangles of a level of detail
_MOST_SCATTERED = 8  # largest number of scattering images that a viewpoint caches


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """A place where errors are measured: a scene with its camera, and a renderer."""

    scene: Scene
    renderer: Renderer


def draw(viewpoint: Viewpoint, shading: Shading, detail: LevelOfDetail) -> NDArray[np.float32]:
    """Return the linear image (H, W, 4) of a viewpoint."""
    scene, options = detail.of(viewpoint.scene), detail.values
    return viewpoint.renderer.render(scene, shading, **options).linear


def _saves_shading(viewpoint: Viewpoint, samples: int) -> bool:
    """Return whether per-pixel shading is possible, and cheaper according to measurements."""
    scene, renderer = viewpoint.scene, viewpoint.renderer
    cheaper = deferred_is_cheaper(scene, renderer.size, samples, renderer.context.renderer)
    return cheaper and renderer.can_shade_per_pixel(scene, samples)


class ScatteredLight:
    """Changes of a viewpoint's radiance that scattering causes, drawn with OpenGL.

    A pixel's scattered light depends on other pixels; float64 would take seconds to compute it.
    """

    def __init__(self, viewpoint: Viewpoint) -> None:
        self.viewpoint = viewpoint
        self.known: dict[Shading, Float] = {}

    def __call__(self, shading: Shading) -> Float:
        """Return the change of each pixel's radiance that scattering causes, (H, W, 3)."""
        names, m = ["scatter_samples", "shadow_lights", "normal_map", "ambient", "diffuse"], None
        if shading.diffuse == "coupled":  # this term also depends on m and the added names
            names, m = [*names, "ks", "two_lobes", "slope_filter"], shading.term.m
        light = Shading(**{name: getattr(shading, name) for name in names}, m=m)
        if light not in self.known:
            if len(self.known) >= _MOST_SCATTERED:
                del self.known[next(iter(self.known))]
            render, scene = self.viewpoint.renderer.render, self.viewpoint.scene
            scattered, local = (
                render(scene, variant, "diffuse", samples=1).linear[..., :3].astype(np.float64)
                for variant in (light, light.replace(scatter_samples=0))
            )
            self.known[light] = scattered - local
        return self.known[light]


class DrawnViews:
    """Views that OpenGL draws.

    With several samples per pixel, OpenGL also shades silhouettes that cover no pixel's centre. If
    a single change exceeds the budget in these images, shadings with this change are not tried.

    Attributes
    ----------
    triangles : number of the mesh's triangles
    finest : level of detail of the full frame
    detail : level of detail of the frames that are tried
    tried : levels of detail that were tried, each with its error
    """

    def __init__(self, viewpoints: Sequence[Viewpoint], full: Shading, budget: Budget) -> None:
        self.viewpoints, self.full, self.budget = viewpoints, full, budget
        self.triangles = sum(len(part.faces) for part in viewpoints[0].scene.mesh.parts)
        self.finest = self.detail = LevelOfDetail(viewpoints[0].renderer.samples, None)
        self.exact = [
            draw(viewpoint, full, self.finest).astype(np.float64) for viewpoint in viewpoints
        ]
        self.tried: list[tuple[LevelOfDetail, float]] = []
        self.failed: list[tuple[Sequence[str], dict[str, Any]]] = []

    def coarsen(self) -> None:
        """Choose the coarsest level of detail at which the full shading stays within the budget.

        Try in this order: cull the back faces of double-sided parts, take fewer samples, shade per
        pixel, and halve the triangles repeatedly.
        """
        if any(material.double_sided for material in self.viewpoints[0].scene.mesh.materials):
            self._first([replace(self.detail, cull_back_faces=True)])
        samples = [count for count in (4, 1) if count < self.finest.samples]
        self._first(replace(self.detail, samples=count) for count in reversed(samples))
        if all(_saves_shading(viewpoint, self.detail.samples) for viewpoint in self.viewpoints):
            self._first([replace(self.detail, shading_rate="pixel")])
        count = self.triangles // 2
        with suppress(InputError):  # the package for levels of detail may be missing
            while count >= _FEWEST and self._first([replace(self.detail, triangles=count)]):
                count //= 2

    def _first(self, details: Iterable[LevelOfDetail]) -> bool:
        for detail in details:
            error = self.error(self.full, detail)
            self.tried.append((detail, error))
            if error <= self.budget.limit:
                self.detail = detail
                return True
        return False

    def accepts(self, shading: Shading) -> bool:
        """Return whether a shading is within the budget; if not, note which single changes fail."""
        if self._within(shading):
            return True
        for names in groups(shading, self.full).values():
            if not self._within(alone(shading, self.full, names)):
                self.failed.append((names, values(shading, names)))
        return False

    def rejects(self, shading: Shading) -> bool:
        """Return whether a shading has a change that failed on its own."""
        return any(values(shading, names) == failed for names, failed in self.failed)

    def _within(self, shading: Shading) -> bool:
        return all(error <= self.budget.limit for _, error in self.errors(shading))

    def error(self, shading: Shading, detail: LevelOfDetail | None = None) -> float:
        """Return the largest error of all images without the spared pixels."""
        return max(within for _, within in self.errors(shading, detail))

    def errors(
        self, shading: Shading, detail: LevelOfDetail | None = None
    ) -> Iterator[tuple[float, float]]:
        """Yield two errors per image: the largest error with and without the spared pixels.

        Pixels that the full frame does not cover count too, since FLIP compares neighbourhoods.

        detail : level of detail; default: ``self.detail``
        """
        for errors, exact in zip(self.maps(shading, detail), self.exact, strict=True):
            spared = self.budget.spared(int(np.count_nonzero(exact[..., 3])))
            yield float(errors.max()), highest_but(errors, spared)

    def maps(self, shading: Shading, detail: LevelOfDetail | None = None) -> Iterator[Float]:
        """Yield the error of every pixel (H, W) of each image; ``detail`` as in :meth:`errors`."""
        for viewpoint, exact in zip(self.viewpoints, self.exact, strict=True):
            image = draw(viewpoint, shading, detail or self.detail)[..., :3].astype(np.float64)
            yield self.budget.errors(image, exact[..., :3])
