"""The passes of an image and of its data, with the reason for each. ``passes`` has the values that
this module returns, and ``compiled`` draws them.

An image (:func:`image_passes`) needs up to seven kinds of passes:

1. "shadow_map" and what is derived from it, if lights cast shadows (module ``shadows``)
2. "refraction_map", if a part such as a cornea refracts: the surfaces behind it (module
   ``refraction``). Both kinds of maps are kept while only the camera moves
3. "visible", if shading is deferred: the visible triangle of each sample. A part is then shaded
   only where it is visible, which is cheaper on a software driver
4. "shade": the radiance of the parts that are not blended; a cornea is not. With one sample, also
   the inputs of scattering: irradiance, position and albedo
5. for scattering with several samples, "visible" and these inputs at the centres of the pixels: the
   samples of a pixel may show different points
6. "transparent", if shading is deferred or light scatters: blended parts, such as lashes, in an
   image of their own. The other passes have one surface at each sample
7. "scatter", if light scatters: it leaves the skin away from the point where it entered

The last pass, "scatter" or else "shade", draws "transparent" over its result. If neither shading is
deferred nor light scatters, "shade" draws the blended parts itself, after all others.

Module ``data_passes`` has the passes of data images."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate
from typing import TYPE_CHECKING, Literal

import numpy as np

from facerender.drawing.passes import Bounds, Draw, Order, Pass, Target, depth_only
from facerender.drawing.prepare import Appearance, ResolvedPart
from facerender.drawing.program import (
    IN_ROW,
    Program,
    Uniforms,
    light_uniforms,
    shade_program,
    table_features,
)
from facerender.drawing.shadows import shadow_passes, shadow_uniforms
from facerender.mesh.mesh import Mesh
from facerender.mesh.part import Part
from facerender.scene.scattering import Scattering
from facerender.scene.scene import Only, ShadingRate
from facerender.terms.transport import scatter_uniforms
from facerender.values.vectors import Vector

if TYPE_CHECKING:
    from facerender.drawing.refraction import Refraction

# Drivers on which deferred shading can be cheaper: see docs/measurements/performance.md.
DRIVERS = ("llvmpipe",)
# With one sample per pixel, and more pixels per triangle than this, forward shading is faster.
_MOST_PIXELS = 30
_MOST_TRIANGLES = 1 << 24  # float32 represents all whole numbers up to this one exactly
_BRIGHTEST = 1e3  # largest background channel: float32 adds and subtracts 1e3 with an error of 6e-5


def can_defer(parts: Sequence[ResolvedPart], background: Vector | None, rows: int) -> bool:
    """Return whether deferred shading supports the parts that are not blended.

    No part may have an alpha mask, and some part must be opaque. Opaque parts must use one set of
    texture coordinates, and have fewer than 2^24 triangles. The triangle data of each part must fit
    into one texture. No channel of the background may exceed 1000.

    rows : largest height of a texture, in texels
    """
    counts = [len(part.part.faces) for part in parts]
    return (
        0 < sum(counts) < _MOST_TRIANGLES
        and max(counts) <= rows * IN_ROW
        and max(background or (0.0,)) <= _BRIGHTEST
        and not any(part.alpha == "mask" for part in parts)
        and not any(part.part.uv2 is not None and part.material.second_uv for part in parts)
    )


def deferred_is_cheaper(
    parts: Sequence[Part], size: tuple[int, int], samples: int, driver: str
) -> bool:
    """Return whether measurements found deferred shading cheaper than forward shading on a driver
    (GL_RENDERER)."""
    triangles = sum(len(part.faces) for part in parts)
    many = samples > 1 or triangles * _MOST_PIXELS > size[0] * size[1]
    return many and driver.startswith(DRIVERS)


@dataclass(frozen=True, eq=False)
class Structure:
    """The structure of a frame, which decides its passes. It leaves out the camera.

    mesh : the mesh in its pose, for refraction
    background : linear RGB behind the mesh
    samples : samples per pixel
    defers : whether shading is deferred, by the number of samples per pixel. See
        :func:`can_defer` and :func:`deferred_is_cheaper`
    rate : see :meth:`Renderer.render`
    texels : width of a shadow map; 0 without shadows
    refraction : None if no part refracts, or if refraction is left out
    scattering : None if no light scatters, or if scattering is left out
    cut : parts that only data images show, because the image blends them
    defers_data : whether data images show the visible triangles, too
    """

    look: Appearance
    mesh: Mesh
    background: Vector
    samples: int
    defers: Callable[[int], bool]
    rate: ShadingRate = "sample"
    texels: int = 0
    refraction: Refraction | None = None
    scattering: Scattering | None = None
    cut: tuple[ResolvedPart, ...] = ()
    defers_data: bool = False

    @property
    def key(self) -> Hashable:
        """A value that is equal for frames of one appearance with equal passes."""
        maps = self.refraction and (self.refraction.side, self.mesh.token)
        return self.background, self.samples, self.rate, self.texels, maps, self.scattering

    @cached_property
    def shared(self) -> Uniforms:
        """Uniforms of the lights and of their shadow maps."""
        return {**light_uniforms(self.look), **shadow_uniforms(self.look, self.texels)}

    def maps(self) -> list[Pass]:
        """Return the passes of the shadow maps, and of the refraction maps, which have shadows."""
        passes = shadow_passes(self.look, self.mesh, self.texels)
        if self.refraction:
            passes += self.refraction.passes(self.look, self.mesh, self.shared, self.texels)
        return passes

    def refracted(self, draws: list[Draw]) -> list[Draw]:
        """Return the draws of all parts, in which refracting parts show what is behind them."""
        return self.refraction.refracted(draws) if self.refraction else draws

    def deferred(
        self,
        parts: Sequence[ResolvedPart],
        draws: Sequence[Draw],
        samples: int,
        marks: bool = True,
    ) -> tuple[Draw, ...]:
        """Return deferred draws, two for each part: the first marks the pixels that show the part
        by a depth of its own, and the second draws these pixels.

        parts, draws : in the order in which "visible" counts triangles
        marks : false for one draw of each part, which discards the other pixels
        """
        rate, count = ("PIXEL_RATE",) * (self.rate == "pixel"), f"SAMPLES {samples}"
        program, deferred = Program("visible.frag", "screen.vert", (count,)), []
        for number, ((part, first), draw) in enumerate(zip(numbered(parts), draws, strict=True)):
            uniforms = {"triangles": (first, len(part.part.faces)), "depth": number / len(parts)}
            if marks:
                deferred.append(Draw(program, uniforms, part, "part", "mark"))
            features = "VISIBLE", *rate, count, *table_features(part.part)
            part_program = replace(draw.program, vertex="screen.vert").having(*features)
            all_uniforms = {**draw.uniforms, **uniforms}
            depth: Literal["marked", "visible"] = "marked" if marks else "visible"
            deferred.append(Draw(part_program, all_uniforms, part, "part", depth))
        if samples == 1:  # no pixel shows two parts: all marks first, for fewer changes of state
            deferred.sort(key=lambda draw: draw.depth == "marked")
        return tuple(deferred)

    def visible(self, samples: int) -> list[Pass]:
        """Return the pass that draws the index of the visible triangle of each sample, if shading
        is deferred. The index counts the triangles of all parts from 1; the background is 0."""
        if not self.defers(samples):
            return []
        return [visible_pass(numbered(self.look.unblended), samples)]

    def shaded(
        self,
        target: Target,
        draws: Sequence[Draw],
        background: Vector = (0.0, 0.0, 0.0),
        names: tuple[str, ...] = ("shade",),
    ) -> Pass:
        """Return the pass that shades the parts that are not blended.

        target : target of forward shading. Deferred shading of several samples adds them up
        draws : one for each part of the scene
        names : of the images
        """
        added = self.defers(target.samples)
        shared = {**self.shared, "background": np.asarray(background)}
        opaque: Sequence[Draw] = [draws[part.index] for part in self.look.unblended]
        if added:
            opaque = self.deferred(self.look.unblended, opaque, target.samples)
            target = replace(target, samples=1)
        clear = *background, 0.0
        return Pass(names[0], target, tuple(opaque), clear, shared, added, others=names[1:])


def numbered(parts: Sequence[ResolvedPart]) -> list[tuple[ResolvedPart, int]]:
    """Return parts, each with the index of its first triangle; see :meth:`Structure.visible`."""
    counts = accumulate((len(part.part.faces) for part in parts), initial=1)
    return list(zip(parts, counts, strict=False))


def visible_pass(parts: Sequence[tuple[ResolvedPart, int]], samples: int) -> Pass:
    """Return the pass that draws the visible triangles of numbered parts."""
    draws = []
    for part, first in parts:
        single = part.material.double_sided is False
        features = ("SELECTED", f"TRIANGLES_IN_ROW {IN_ROW}") if single else ()
        program = Program("visibility.frag", "visibility.vert", features)
        order: Order | None = "facing" if single else None
        draws.append(Draw(program, {"first": first}, part, None, "test", order, not single))
    target = Target((1,), samples, sampled=True, resolved=False)
    return Pass("visible", target, tuple(draws))


def image_passes(of: Structure, only: Only | None) -> list[Pass]:
    """Return the passes of an image; see the head of this module.

    only : term to draw, "specular" or "diffuse"; None for the whole image

    For errors see ``Appearance.terms`` and ``Appearance.slopes``.
    """
    look, samples, scattering = of.look, of.samples, of.scattering
    background, count = (0.0, 0.0, 0.0) if only else of.background, look.shading.scatter_samples
    draws = of.refracted(_shade_draws(look, samples, only))
    blends = tuple(
        replace(draws[part.index], order="sorted", depth="blend") for part in look.blended
    )
    visible = of.visible(samples)
    passes = [*of.maps(), *visible]
    if not scattering:
        image = of.shaded(Target(samples=samples), draws, background)
        if not visible:
            return [*passes, replace(image, draws=(*image.draws, *blends), results=(0,))]
    elif samples == 1:
        names: tuple[str, ...] = "image", "light", "place", "albedo"
        inputs = _scattering(draws, scattering)
        passes.append(of.shaded(Target((4,) * 4, sampled=True), inputs, names=names))
        image = scatter_pass(scattering, count, background, False, inside=of.defers(1))
    else:
        target = Target(samples=samples, sampled=True)
        passes.append(of.shaded(target, draws, background, ("image",)))
        passes += of.visible(1)
        # Only diffuse light enters the skin; refracted light does not scatter.
        inputs = _scattering(_shade_draws(look, 1, "diffuse"), scattering, "APART")
        names = "albedo", "light", "place"
        passes.append(of.shaded(Target((4,) * 3, sampled=True), inputs, names=names))
        image = scatter_pass(scattering, count, (0.0, 0.0, 0.0), True, inside=False)
    image = replace(image, results=(0,))
    if not blends:
        return [*passes, image]
    # Blended parts are hidden by the depth of "visible", or else by depths of their own.
    depth = visible[0].target if visible else None
    hides = () if visible else tuple(depth_only(draws[part.index]) for part in look.unblended)
    target = Target((4,), samples, sampled=True, number=1, resolved=not visible, depth_of=depth)
    blended = Pass("transparent", target, (*hides, *blends), uniforms=of.shared, area="blended")
    program = Program("transparent.frag", "screen.vert", (f"SAMPLES {samples if visible else 1}",))
    over = Draw(program, {"depth": -1.0}, area="blended", depth="blend")
    return [*passes, blended, replace(image, draws=(*image.draws, over))]


def _shade_draws(look: Appearance, samples: int, only: Only | None) -> list[Draw]:
    """Return the draws that shade all parts."""
    specular, count = only != "diffuse", len(look.parts)
    slopes = look.slopes if specular else [(0.0, 0.0)] * count
    terms = look.terms if specular and look.lighting.shining else [None] * count
    draws = []
    for part, term, (smallest_m, _) in zip(look.parts, terms, slopes, strict=True):
        program = shade_program(look, part, term, smallest_m, only)
        if samples > 1 and "ALPHA_MASK" in program.features:
            program = program.having(f"TO_COVERAGE {samples}")
        draws.append(Draw.of_part(program, part))
    return draws


def _scattering(draws: Sequence[Draw], scattering: Scattering, *features: str) -> list[Draw]:
    """Return draws that also write the inputs of scattering."""
    return [
        replace(
            draw,
            program=draw.program.having("SCATTER", *features),
            uniforms={**draw.uniforms, "profile": number},
        )
        for draw, number in zip(draws, scattering.numbers, strict=True)
    ]


def scatter_pass(
    scattering: Scattering, samples: int, behind: Vector, several: bool, inside: bool
) -> Pass:
    """Return the pass that adds subsurface scattering to the image of the surfaces.

    samples : samples of the light around a pixel
    behind : background; 0 if the image contains it
    several : whether the image has several samples per pixel
    inside : whether to draw only the bounds of the parts that are not blended
    """
    area: Bounds | None = "opaque" if inside else None
    shared = {"pixels": scattering.pixels, "background": np.asarray(behind)}
    draws = [Draw(Program("background.frag", "screen.vert"), {"depth": 1.0}, area=area)]
    mask_program = Program("scatter_mask.frag", "screen.vert", ("SEVERAL",) * several)
    for number, gaussians in enumerate(scattering.profiles, 1):
        mask = {"profile": number, "depth": 1.0 / (1.0 + number)}
        draws.append(Draw(mask_program, mask, area=area, depth="mark"))
        counts = f"FR_SCATTER_SAMPLES {samples}", f"FR_SCATTER_GAUSSIANS {len(gaussians)}"
        program = Program("scatter.frag", "screen.vert", counts + mask_program.features)
        uniforms = {**mask, **scatter_uniforms(gaussians, samples, scattering.millimetres)}
        draws.append(Draw(program, uniforms, area=area, depth="marked"))
    return Pass("scatter", Target(), tuple(draws), (*behind, 0.0), shared)
