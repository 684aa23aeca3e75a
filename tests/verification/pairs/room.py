"""Draws the scene of a setting: unchanged, with changes, with a camera moved by less than a pixel,
or with another driver in a separate process."""

from __future__ import annotations

import os
from collections.abc import Callable, Hashable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from multiprocessing import get_context
from types import MappingProxyType
from typing import Any, cast

import moderngl
import numpy as np
from numpy.typing import NDArray

import facerender as fr
from facerender.drawing.context import Backend
from facerender.drawing.frame_passes import Structure
from facerender.drawing.program import Draw, Pass, Program
from facerender.scene.view import View, view_of
from tests.verification.pairs.scenes import Setting

Linear = NDArray[np.float32]
Patch = tuple[str, str]


@dataclass(frozen=True)
class Patched(Program):
    """A program with one passage of its GLSL replaced, if it has this passage."""

    old: str = ""
    new: str = ""

    def sources(self, version: str) -> dict[str, str]:
        stages = super().sources(version)
        assert stages["frag"].count(self.old) <= 1, self.old
        return stages | {"frag": stages["frag"].replace(self.old, self.new)}


class Retouched(fr.Renderer):
    """A renderer that replaces a passage in the GLSL of ``shade.frag``."""

    patch: Patch | None = None

    def _draw(
        self,
        name: str,
        of: Structure,
        key: Hashable,
        make: Callable[[], list[Pass]],
        view: View,
        inputs: Mapping[str, moderngl.Texture] = {},
    ) -> list[NDArray[np.float32]]:
        changed = partial(self._retouched, make)
        return super()._draw(name, of, (key, self.patch), changed, view, inputs)

    def _retouched(self, make: Callable[[], list[Pass]]) -> list[Pass]:
        """Return the passes with the patch in all programs that have the passage."""
        if self.patch is None:
            return make()
        old, new = self.patch

        def patched(draw: Draw) -> Draw:
            if draw.program.fragment != "shade.frag":
                return draw
            return replace(draw, program=Patched(**vars(draw.program), old=old, new=new))

        passes = [replace(step, draws=tuple(map(patched, step.draws))) for step in make()]
        programs = [draw.program for step in passes for draw in step.draws]
        assert any(new in program.sources("330")["frag"] for program in programs), self.patch
        return passes


class Room:
    """A setting with its renderer. Images are linear RGB and coverage, (H, W, 4)."""

    def __init__(self, setting: Setting, backend: Backend = "egl") -> None:
        self.setting = setting
        self.scene = setting.scene()
        self.size = (setting.size, setting.size)
        self.view = view_of(self.scene, 1.0)
        self.renderer = Retouched(
            self.size, samples=setting.samples, backend=backend, float_albedo=setting.float_albedo
        )

    def draw(
        self,
        *,
        shading: fr.Shading | None = None,
        patch: Patch | None = None,
        view: View | None = None,
        samples: int | None = None,
        **scene: object,
    ) -> Linear:
        """Draw the scene with some of its fields replaced.

        shading : default: the setting's shading
        patch : a passage of the GLSL and its replacement
        view : default: the view of the scene's camera
        samples : samples per pixel; default: as in the setting
        """
        own = replace(self.scene, **scene)  # type: ignore[arg-type]
        how = shading or self.setting.shading
        samples = samples or self.renderer.samples
        seen = view or view_of(own, 1.0)
        self.renderer.patch = patch
        resolved = self.renderer._resolved(own, how, seen, samples)
        of = self.renderer._structure(resolved, seen, samples)
        return self.renderer._radiance(of, resolved, seen, None)[0]

    @cached_property
    def golden(self) -> Linear:
        """The image of the unchanged scene."""
        return self.draw()

    @cached_property
    def surface(self) -> fr.GBuffer:
        """The G-buffer of the scene, without blended parts."""
        self.renderer.patch = None
        return self.renderer.gbuffer(self.scene, self.setting.shading, blended=False)

    def with_material(self, **changes: Any) -> Linear:
        """Draw with fields of every material replaced."""
        return self.draw(mesh=self.scene.mesh.with_material(**changes))

    def moved(self, pixels: tuple[float, float]) -> View:
        """Return the view of a camera that moves parallel to the image plane.

        pixels : how far a point at the depth of the mesh's centre moves to the left and up
        """
        deep = float(self.view.matrix[3, 3])  # w at the origin
        offset = np.zeros(3)
        for axis, by in enumerate(pixels):
            column = self.view.matrix[:3, axis]
            offset += by * 2.0 / self.size[axis] * deep * column / (column @ column)
        move = np.eye(4)
        move[3, :3] = -offset
        return replace(
            self.view, position=self.view.position + offset, matrix=move @ self.view.matrix
        )

    def mean(self, pattern: Sequence[tuple[float, float]]) -> Linear:
        """Return the mean of images with one sample per pixel, one per offset in ``pattern``."""
        images = [self.draw(view=self.view.shifted(at, self.size), samples=1) for at in pattern]
        return cast(Linear, np.mean(images, axis=0, dtype=np.float32))

    def mirrored(self, mesh: fr.Mesh) -> Linear:
        """Draw the mirrored scene, and mirror the image: only the sample positions are mirrored."""
        view = replace(self.view, matrix=self.view.matrix @ np.diag([-1.0, 1.0, 1.0, 1.0]))
        return np.ascontiguousarray(self.draw(view=view, mesh=mesh)[:, ::-1])

    def frame(self, linear: Linear, renderer: str = "") -> fr.Frame:
        """Return an image as a frame; ``renderer`` replaces the renderer's name in its metadata."""
        metadata = self.renderer.metadata
        metadata["GL_RENDERER"] = renderer or metadata["GL_RENDERER"]
        return fr.Frame(linear, None, self.scene.background is None, metadata)


def draw_elsewhere(
    setting: Setting, backend: Backend = "egl", variables: Mapping[str, str] = MappingProxyType({})
) -> fr.Frame:
    """Draw a setting in a new process with additional environment variables.

    Mesa chooses its driver when it is loaded, so this process cannot change it.
    """
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(_draw, setting, backend, dict(variables)).result()


def _draw(setting: Setting, backend: Backend, variables: Mapping[str, str]) -> fr.Frame:
    os.environ |= variables
    room = Room(setting, backend)
    frame = room.frame(room.golden)
    room.renderer.release()
    return frame
