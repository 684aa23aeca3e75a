"""Rendering passes as data. To draw an image, the renderer executes a list of the passes that the
scene needs. No OpenGL here.

The visibility pass finds the visible triangle at each sample; deferred shading then shades each
triangle once in every pixel where it is visible. Blended parts are drawn back to front over the
other parts; depth peeling draws one transparent layer of a part."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from facerender.drawing.prepare import ResolvedPart, ResolvedScene
from facerender.drawing.program import IN_ROW, Program, Uniforms, part_uniforms, table_features
from facerender.mesh.setup import Area
from facerender.scene.scene import Scene, ShadingRate
from facerender.scene.view import View

Floats = NDArray[np.floating[Any]]


def around(areas: Sequence[Area]) -> Area:
    """Return the bounds of several areas. Empty areas are ignored."""
    non_empty = [area for area in areas if not area.empty] or [Area()]
    left, low = min(area.left for area in non_empty), min(area.low for area in non_empty)
    right = max(area.left + area.width for area in non_empty)
    return Area(left, low, right - left, max(area.low + area.height for area in non_empty) - low)


@dataclass(frozen=True)
class Target:
    """The render target of a pass: a framebuffer with float32 images.

    colors : number of colour images
    samples : samples per pixel
    size : width and height in pixels; None for the size of the frame
    sampled : whether later passes read the images as textures
    values : content of a pixel: "color" for RGBA, "number" for one value
    number : number that distinguishes targets with otherwise equal attributes
    resolved : whether later passes read one value per pixel of colours with several samples
    depth_of : target whose depth buffer this target shares and leaves unchanged; None for an own
        depth buffer
    """

    colors: int = 1
    samples: int = 1
    size: tuple[int, int] | None = None
    sampled: bool = False
    values: Literal["color", "number"] = "color"
    number: int = 0
    resolved: bool = True
    depth_of: Target | None = None


@dataclass(frozen=True, eq=False)
class Draw:
    """One draw call: a part with its program. Without a part, one triangle covers the target.

    area : rectangle to draw; None for the whole target
    depth : the depth test, and the buffers that the draw writes:

        - "test": fragments that are not behind the stored depth write colour and depth
        - "hide": fragments that are not behind the stored depth write depth only
        - "blend": fragments that are not behind the stored depth are blended over the image
        - "mark": one triangle over the area writes depth only, without a test
        - "marked": one triangle over the area writes colour where the previous "mark" draw wrote
          the same depth. The draw's program reads the triangle table of the part
    order : (F,) indices of the part's triangles in drawing order; None for the part's own order
    double_sided : false to draw only front faces
    """

    program: Program
    uniforms: Uniforms
    part: ResolvedPart | None = None
    area: Area | None = None
    depth: Literal["test", "hide", "blend", "mark", "marked"] = "test"
    order: NDArray[np.int64] | None = None
    double_sided: bool | None = True

    @classmethod
    def of_part(cls, program: Program, part: ResolvedPart, /, **uniforms: Any) -> Draw:
        """Return the draw of a part, with the uniforms of the part and further uniforms."""
        values = {**part_uniforms(part), **uniforms}
        return cls(program, values, part, double_sided=part.material.double_sided)


@dataclass(frozen=True, eq=False)
class Pass:
    """A list of draws into one target.

    name : uniform name under which later passes read the first image of the target
    others : uniform names of the further images of the target
    area : rectangle to clear, as in :class:`Draw`; None for the whole target
    clear : initial value of all pixels: linear RGB and coverage
    added : whether draws add their colours to the image
    key : hashable value of everything that the image depends on. The pass is skipped if the target
        already holds an image with an equal key. None: the pass is always drawn
    """

    name: str
    target: Target
    draws: tuple[Draw, ...]
    clear: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    uniforms: Uniforms = field(default_factory=dict)
    added: bool = False
    key: Hashable = None
    others: tuple[str, ...] = ()
    area: Area | None = None


_CUT = ("UV", "OPACITY", "ALPHA", "TO_COVERAGE")  # prefixes of the features that alpha masks use


@dataclass(frozen=True, eq=False)
class BlendedPart:
    """A blended part of the mesh, by its index.

    order : (F,) indices of the part's triangles, back to front by the depth of triangle centres
    layer : index of the surface that depth peeling shows at each pixel: 0 is the nearest surface
    """

    part: int
    order: NDArray[np.int64]
    layer: int = 0


def visible_draws(draws: Sequence[Draw], blended_part: BlendedPart | None) -> tuple[Draw, ...]:
    """Return the draws of all parts that are not blended. With a blended part, these draws write
    only depth, and the draw of its layer follows.

    draws : one draw for each part of the scene
    """
    opaque = unblended(draws)
    if blended_part is None:
        return opaque
    draw = draws[blended_part.part]
    program = draw.program.having(*("DEPTH_PEELING",) * (blended_part.layer > 0))
    return *map(depth_only, opaque), replace(draw, program=program, order=blended_part.order)


def blended_parts(resolved: ResolvedScene, view: View) -> list[BlendedPart]:
    """Return the blended parts in drawing order. The part whose nearest vertex has the largest
    depth comes first."""
    pairs = []
    for part in resolved.appearance.blended:
        setup = resolved.scene.mesh.setups[part.index]
        depth = setup.positions @ view.forward
        order = np.argsort(-depth[setup.faces].sum(axis=1), kind="stable")
        pairs.append((float(depth.min()), BlendedPart(part.index, order)))
    return [part for _, part in sorted(pairs, key=lambda pair: -pair[0])]


def blended_area(resolved: ResolvedScene, view: View, size: tuple[int, int]) -> Area:
    """Return the bounds of all blended parts in an image; empty if there are none."""
    setups = (resolved.scene.mesh.setups[part.index] for part in resolved.appearance.blended)
    return around([setup.area(view.matrix, size) for setup in setups])


def unblended(draws: Iterable[Draw]) -> tuple[Draw, ...]:
    """Return the draws of parts that are not blended."""
    return tuple(draw for draw in draws if draw.part and draw.part.alpha != "blend")


def with_blended(shaded: Pass, image: Pass, area: Area, visible: Target | None) -> list[Pass]:
    """Return two passes. The first draws the blended parts of a shading pass into a texture. The
    second draws `image`, a pass of one sample per pixel, and composites that texture over it.

    shaded : forward shading pass of all parts
    area : bounds of the blended parts in the image
    visible : target that holds the depth of the other parts; None to draw this depth
    """
    hides = [depth_only(draw) for draw in shaded.draws if draw.depth == "test" and not visible]
    draws = (*hides, *(draw for draw in shaded.draws if draw.depth == "blend"))
    target = replace(
        shaded.target, sampled=True, number=1, resolved=visible is None, depth_of=visible
    )
    blended = replace(
        shaded, name="transparent", target=target, draws=draws, clear=(0.0,) * 4, area=area
    )
    samples = target.samples if visible else 1
    program = Program("transparent.frag", "screen.vert", (f"SAMPLES {samples}",))
    composite = Draw(program, {"depth": -1.0}, area=area, depth="blend")
    return [blended, replace(image, draws=(*image.draws, composite))]


def depth_only(draw: Draw) -> Draw:
    """Return a draw that writes only the depth of a part."""
    program = Program("depth.frag", features=mask_features(draw.program.features))
    return replace(draw, program=program, depth="hide")


def mask_features(features: Sequence[str]) -> tuple[str, ...]:
    """Return only the features that the part's alpha mask needs; () without a mask."""
    cut = "ALPHA_MASK" in features
    return tuple(name for name in features if name.startswith(_CUT)) if cut else ()


# Drivers on which deferred shading can be cheaper than forward shading: see
# docs/measurements/performance.md.
DRIVERS = ("llvmpipe",)
# With one sample per pixel, and more pixels per triangle than this, forward shading is faster.
_MOST_PIXELS = 30
_MOST_TRIANGLES = 1 << 24  # float32 represents all whole numbers up to this one exactly
_SELECTED = ("SELECTED", f"TRIANGLES_IN_ROW {IN_ROW}")
_BRIGHTEST = 1e3  # largest background channel: float32 adds and subtracts 1e3 with an error of 6e-5


def can_defer(resolved: ResolvedScene, rows: int) -> bool:
    """Return whether deferred shading supports a scene.

    No part may have an alpha mask, and some part must be opaque. Opaque parts must use one set of
    texture coordinates, and have fewer than 2^24 triangles. The triangle data of each part must fit
    into one texture. No channel of the background may exceed 1000.

    rows : largest height of a texture, in texels
    """
    parts = resolved.appearance.unblended
    counts = [len(part.part.faces) for part in parts]
    return (
        0 < sum(counts) < _MOST_TRIANGLES
        and max(counts) <= rows * IN_ROW
        and max(resolved.scene.background or (0.0,)) <= _BRIGHTEST
        and not any(part.alpha == "mask" for part in parts)
        and not any(part.part.uv2 is not None and part.material.second_uv for part in parts)
    )


def deferred_is_cheaper(scene: Scene, size: tuple[int, int], samples: int, driver: str) -> bool:
    """Return whether measurements found deferred shading cheaper than forward shading on a driver
    (GL_RENDERER)."""
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

    part: ResolvedPart
    first: int
    area: Area
    front: NDArray[np.int64] | None


@dataclass(frozen=True, eq=False)
class Visibility:
    """The visible triangle of each sample of an image of a view.

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
        resolved: ResolvedScene,
        view: View,
        size: tuple[int, int],
        samples: int,
        shading_rate: ShadingRate = "sample",
    ) -> Visibility:
        """Assign an index to each triangle, and compute the bounds of each part in the image."""
        parts, first = [], 1
        setups = resolved.scene.mesh.setups
        for part in resolved.appearance.unblended:
            setup = setups[part.index]
            area, front = setup.area(view.matrix, size), None
            if part.material.double_sided is False:
                front = setup.facing(view.position)
                area = area if len(front) else Area()
            parts.append(Visible(part, first, area, front))
            first += len(part.part.faces)
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
        """Convert a forward pass to a deferred pass of the visible triangles, without blended
        parts."""
        draws: list[Draw] = []
        opaque = (draw for draw in drawn.draws if draw.depth != "blend")
        for number, (draw, part) in enumerate(zip(opaque, self.parts, strict=True)):
            if not part.area.empty:
                draws += self._shaded(draw, part, number / len(self.parts))
        background = {"background": np.asarray(drawn.clear[:3])}
        uniforms = {**drawn.uniforms, **_rays(self.view, self.size), **background}
        target = replace(drawn.target, samples=1)
        return replace(drawn, target=target, draws=tuple(draws), uniforms=uniforms, added=True)

    def _shaded(self, draw: Draw, part: Visible, depth: float) -> tuple[Draw, Draw]:
        """Return two draws: the first writes `depth`, in [0, 1] and different for each part, at the
        pixels that show the part, and the second shades these pixels."""
        samples, rate = f"SAMPLES {self.samples}", ("PIXEL_RATE",) * (self.shading_rate == "pixel")
        mesh_part, area = part.part.part, part.area
        count = len(mesh_part.faces)
        uniforms = {"first": part.first, "triangle_count": count, "depth": depth}
        visible = Program("visible.frag", "screen.vert", (samples,))
        features = "VISIBLE", *rate, samples, *table_features(mesh_part)
        program = replace(draw.program, vertex="screen.vert").having(*features)
        shaded = Draw(program, {**draw.uniforms, **uniforms}, part.part, area, "marked")
        return Draw(visible, uniforms, area=area, depth="mark"), shaded


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
