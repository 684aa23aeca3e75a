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

Data images need the G-buffer (:func:`surface_passes`), the visible fraction of each light
(:func:`fraction_passes`) or the visible triangles (:func:`triangle_pass`)."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from facerender.drawing.passes import Bounds, Draw, Order, Pass, Target, depth_only, mask_features
from facerender.drawing.prepare import Appearance
from facerender.drawing.program import (
    IN_ROW,
    Program,
    Uniforms,
    light_uniforms,
    shade_program,
    shadow_features,
    surface_features,
    table_features,
)
from facerender.drawing.shadows import MOST, shadow_passes, shadow_uniforms
from facerender.mesh.mesh import Mesh
from facerender.mesh.part import Part
from facerender.scene.scattering import Scattering
from facerender.scene.scene import Only, Scene, ShadingRate
from facerender.terms.transport import scatter_uniforms
from facerender.values.vectors import Vector

if TYPE_CHECKING:
    from facerender.drawing.refraction import Refraction

# Triangles per unit of the second channel that depth.frag writes: float32 does not represent all
# indices above 2^24.
INDEX_BASE = 4096
# Drivers on which deferred shading can be cheaper: see docs/measurements/performance.md.
DRIVERS = ("llvmpipe",)
# With one sample per pixel, and more pixels per triangle than this, forward shading is faster.
_MOST_PIXELS = 30
_MOST_TRIANGLES = 1 << 24  # float32 represents all whole numbers up to this one exactly
_BRIGHTEST = 1e3  # largest background channel: float32 adds and subtracts 1e3 with an error of 6e-5


def can_defer(look: Appearance, background: Vector | None, rows: int) -> bool:
    """Return whether deferred shading supports an appearance.

    No part may have an alpha mask, and some part must be opaque. Opaque parts must use one set of
    texture coordinates, and have fewer than 2^24 triangles. The triangle data of each part must fit
    into one texture. No channel of the background may exceed 1000.

    rows : largest height of a texture, in texels
    """
    parts = look.unblended
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

    def opaque(self, draws: Sequence[Draw], samples: int) -> tuple[Draw, ...]:
        """Return the draws of the parts that are not blended, as deferred draws where shading is
        deferred. Each deferred part has two: the first marks the pixels that show the part by a
        depth of its own, and the second shades these pixels.

        draws : one for each part of the scene
        """
        parts = self.look.unblended
        if not self.defers(samples):
            return tuple(draws[part.index] for part in parts)
        count, first, deferred = f"SAMPLES {samples}", 1, []
        rate = ("PIXEL_RATE",) * (self.rate == "pixel")
        visible = Program("visible.frag", "screen.vert", (count,))
        for number, part in enumerate(parts):
            draw, triangles = draws[part.index], len(part.part.faces)
            uniforms = {"triangles": (first, triangles), "depth": number / len(parts)}
            features = "VISIBLE", *rate, count, *table_features(part.part)
            program = replace(draw.program, vertex="screen.vert").having(*features)
            deferred += [
                Draw(visible, uniforms, part, "part", "mark"),
                Draw(program, {**draw.uniforms, **uniforms}, part, "part", "marked"),
            ]
            first += triangles
        if samples == 1:  # no pixel shows two parts: all marks first, for fewer changes of state
            deferred.sort(key=lambda draw: draw.depth == "marked")
        return tuple(deferred)

    def visible(self, samples: int) -> list[Pass]:
        """Return the pass that draws the index of the visible triangle of each sample, if shading
        is deferred. The index counts the triangles of all parts from 1; the background is 0."""
        if not self.defers(samples):
            return []
        draws, first = [], 1
        for part in self.look.unblended:
            single = part.material.double_sided is False
            features = ("SELECTED", f"TRIANGLES_IN_ROW {IN_ROW}") if single else ()
            program = Program("visibility.frag", "visibility.vert", features)
            order: Order | None = "facing" if single else None
            draws.append(Draw(program, {"first": first}, part, None, "test", order, not single))
            first += len(part.part.faces)
        target = Target(samples=samples, sampled=True, values="number")
        return [Pass("visible", target, tuple(draws))]

    def shaded(
        self,
        target: Target,
        draws: Sequence[Draw],
        background: Vector = (0.0, 0.0, 0.0),
        names: tuple[str, ...] = ("shade",),
    ) -> Pass:
        """Return the pass that shades the parts that are not blended.

        target : target of forward shading. Deferred shading of several samples adds them up
        draws : see :meth:`opaque`
        names : of the images
        """
        added = self.defers(target.samples)
        shared = {**self.shared, "background": np.asarray(background)}
        opaque = self.opaque(draws, target.samples)
        target = replace(target, samples=1) if added else target
        return Pass(names[0], target, opaque, (*background, 0.0), shared, added, others=names[1:])


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
            return [*passes, replace(image, draws=(*image.draws, *blends))]
    elif samples == 1:
        names: tuple[str, ...] = "image", "light", "place", "albedo"
        inputs = _scattering(draws, scattering)
        passes.append(of.shaded(Target(4, sampled=True), inputs, names=names))
        image = scatter_pass(scattering, count, background, False, inside=of.defers(1))
    else:
        target = Target(samples=samples, sampled=True)
        passes.append(of.shaded(target, draws, background, ("image",)))
        passes += of.visible(1)
        # Only diffuse light enters the skin; refracted light does not scatter.
        inputs = _scattering(_shade_draws(look, 1, "diffuse"), scattering, "APART")
        names = "albedo", "light", "place"
        passes.append(of.shaded(Target(3, sampled=True), inputs, names=names))
        image = scatter_pass(scattering, count, (0.0, 0.0, 0.0), True, inside=False)
    if not blends:
        return [*passes, image]
    # Blended parts are hidden by the depth of "visible", or else by depths of their own.
    depth = visible[0].target if visible else None
    hides = () if visible else tuple(depth_only(draws[part.index]) for part in look.unblended)
    target = Target(1, samples, sampled=True, number=1, resolved=not visible, depth_of=depth)
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


# --- data ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Layer:
    """One layer of a blended part. Depth peeling shows the surface with this index at each pixel; 0
    is the nearest surface.

    part : index of the part
    """

    part: int
    index: int = 0


def surface_images(scene: Scene, layer: bool) -> tuple[str, ...]:
    """Return the names of the images of a G-buffer in drawing order:

    - position: position, index of the part plus 1
    - normal: normal, m
    - albedo: albedo, specular weight
    - uv: texture coordinates, occlusion, and either facing (if a part scatters) or opacity (of a
      layer)
    - lobes: m of the second lobe and weight of the first lobe, if a part has two lobes
    - emitted: emission, with the refracted light, if a part emits or refracts light
    - layer: depth, and index of the triangle in drawing order, of a layer

    layer : whether the G-buffer is one layer of a blended part
    """
    materials = scene.mesh.materials
    lobes = ("lobes",) * any(material.two_lobes for material in materials)
    emitted = ("emitted",) * any(material.emits for material in materials)
    return ("position", "normal", "albedo", "uv", *lobes, *emitted, *("layer",) * layer)


def surface_passes(of: Structure, images: Sequence[str], layer: Layer | None) -> list[Pass]:
    """Return the passes that draw the G-buffer of all parts that are not blended, or of a layer.

    images : see :func:`surface_images`
    """
    look, draws = of.look, []
    further = [f"{name.upper()} {index}" for index, name in enumerate(images[4:], 4)]
    for part in look.parts:
        features = (
            *surface_features(part, look.shading),
            *("EMISSIVE",) * any(part.material.emissive),
            # Every program must write all images of the pass, also for parts with one lobe.
            *("TWO_LOBES",) * ("lobes" in images and not part.material.two_lobes),
            *("SCATTER",) * (of.scattering is not None),
            *further,
        )
        program = Program("gbuffer.frag", features=features)
        draws.append(Draw.of_part(program, part, part=part.index + 1))
    passes = of.maps() if of.refraction else []  # only refracted light has shadows
    target = Target(len(images))
    if layer:  # two targets alternate, as each layer reads the previous one
        target = replace(target, sampled=True, number=layer.index % 2)
    return passes + _data_passes(of, "surface", target, of.refracted(draws), layer)


def fraction_passes(of: Structure, layer: Layer | None, casting: Appearance) -> list[Pass]:
    """Return the passes that draw the visible fraction of each light that casts shadows, in the
    order of ``Lighting.lights``.

    casting : appearance whose parts cast the shadows
    """
    look, draws = of.look, []
    for part in look.parts:
        features = surface_features(part, look.shading) + shadow_features(look.lighting)
        program = Program("light_visibility.frag", features=features, lights=look.lighting.groups)
        draws.append(Draw.of_part(program, part))
    passes = shadow_passes(casting, of.mesh, of.texels)
    return passes + _data_passes(of, "light_visibility", Target(MOST // 4), draws, layer)


def _data_passes(
    of: Structure, name: str, target: Target, draws: Sequence[Draw], layer: Layer | None
) -> list[Pass]:
    if layer is None:
        return [*of.visible(1), of.shaded(target, draws, names=(name,))]
    draw = draws[layer.part]
    program = draw.program.having(*("DEPTH_PEELING",) * (layer.index > 0))
    hides = tuple(depth_only(draws[part.index]) for part in of.look.unblended)
    peeled = (*hides, replace(draw, program=program, order="sorted"))
    return [Pass(name, target, peeled, uniforms=of.shared)]


def triangle_pass(look: Appearance) -> Pass:
    """Return the pass that draws the visible triangle at the centre of each pixel: the index of the
    part plus 1, and two channels with the index of the triangle in drawing order."""
    draws = []
    for part in look.unblended:
        features = mask_features(surface_features(part, look.shading))
        program = Program("depth.frag", features=(*features, f"TRIANGLE {INDEX_BASE}"))
        order: Order | None = "facing" if part.material.double_sided is False else None
        draws.append(replace(Draw.of_part(program, part, part=part.index + 1), order=order))
    return Pass("triangles", Target(), tuple(draws))
