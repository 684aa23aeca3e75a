"""Rendering passes as data. To draw an image, the renderer executes a list of the passes that the
scene needs. No OpenGL here.

The visibility pass finds the visible triangle at each sample; deferred shading then shades each
triangle once in every pixel where it is visible. Blended parts are drawn back to front over the
other parts; depth peeling draws one transparent layer of a part."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple, TypeVar
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from facerender.drawing.program import IN_ROW, Program, Uniforms, part_uniforms, table_features
from facerender.scenes.arrays import face_normals
from facerender.scenes.material import Material
from facerender.scenes.mesh import Mesh, Part, drawn_alpha
from facerender.scenes.scene import Scene, ShadingRate
from facerender.scenes.view import View

_EDGE_ON = 0.01  # sine of the angle between view ray and triangle

Floats = NDArray[np.floating[Any]]


class Area(NamedTuple):
    """A rectangle of an image: left column, lowest row, width and height in pixels."""

    left: int = 0
    low: int = 0
    width: int = 0
    height: int = 0

    @property
    def empty(self) -> bool:
        return not (self.width and self.height)


@dataclass(frozen=True, eq=False)
class TriangleSetup:
    """The triangles of a part.

    space : centre and radius of the mesh, which place the vertices in the renderer's space
    vertices : (N, 6) float32, vertex positions in the renderer's space, and normals
    faces : (F, 3) uint32, indices of vertices
    """

    space: tuple[float, ...]
    vertices: NDArray[np.float32]
    faces: NDArray[np.uint32]

    @classmethod
    def of(cls, part: Part, mesh: Mesh) -> TriangleSetup:
        """Return the triangle setup of a part of a mesh."""
        vertices = np.empty((len(part.positions), 6), dtype=np.float32)
        vertices[:, :3], vertices[:, 3:] = mesh.normalised(part.positions), part.normals
        faces = np.asarray(part.faces, dtype=np.uint32)
        return cls((*mesh.center.tolist(), mesh.radius), vertices, faces)

    @property
    def positions(self) -> NDArray[np.float32]:
        """Vertex positions in the renderer's space, (N, 3)."""
        return self.vertices[:, :3]

    @cached_property
    def bounds(self) -> Floats:
        """Corners of the vertices' bounding box, homogeneous, (8, 4)."""
        columns = np.ascontiguousarray(self.positions.T)
        sides = zip(columns.min(axis=1), columns.max(axis=1), strict=True)
        return np.stack(np.meshgrid(*sides, [1.0]), axis=-1).reshape(-1, 4)

    @cached_property
    def planes(self) -> NDArray[np.float32]:
        """Unit normal of each triangle, and the distance of the origin from its plane, (4, F)."""
        columns, faces = (np.ascontiguousarray(array.T) for array in (self.positions, self.faces))
        corners, normals = map(np.stack, face_normals([*columns], faces))
        normals /= np.maximum(np.linalg.norm(normals, axis=0), 1e-30)
        return np.vstack([normals, -np.einsum("ij,ij->j", normals, corners)])

    def facing(self, camera: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the indices of the triangles that can face a camera at the given position (3,).

        Triangles that are seen edge-on are included, because a driver rounds positions to fractions
        of a pixel before it decides which triangles are back faces.
        """
        edge_on = _EDGE_ON * (1.0 + np.linalg.norm(camera))
        return np.flatnonzero(np.append(camera, 1.0).astype(np.float32) @ self.planes > -edge_on)

    def area(self, view: View, size: tuple[int, int]) -> Area:
        """Return the bounds of the part in an image; empty if the part is outside the image.

        size : width and height of the image
        """
        clip = self.bounds @ view.matrix
        if clip[:, 3].min() <= 0.0:
            return Area(0, 0, *size)
        corners = (clip[:, :2] / clip[:, 3:] * 0.5 + 0.5) * size
        start = np.clip(np.floor(corners.min(axis=0)), 0, size).astype(int)
        end = np.clip(np.ceil(corners.max(axis=0)), 0, size).astype(int)
        return Area(*start.tolist(), *(end - start).tolist())


def around(areas: Sequence[Area]) -> Area:
    """Return the bounds of several areas. Empty areas are ignored."""
    non_empty = [area for area in areas if not area.empty] or [Area()]
    left, low = min(area.left for area in non_empty), min(area.low for area in non_empty)
    right = max(area.left + area.width for area in non_empty)
    return Area(left, low, right - left, max(area.low + area.height for area in non_empty) - low)


_made: WeakKeyDictionary[Part, TriangleSetup] = WeakKeyDictionary()


def triangle_setup_of(part: Part, mesh: Mesh) -> TriangleSetup:
    """Return the triangle setup of a part of a mesh, from a cache. Meshes with the same centre and
    radius share one setup."""
    setup = _made.get(part)
    if setup is None or setup.space != (*mesh.center.tolist(), mesh.radius):
        _made[part] = setup = TriangleSetup.of(part, mesh)
    return setup


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
    part: Part | None = None
    material: Material | None = None
    area: Area | None = None
    depth: Literal["test", "hide", "blend", "mark", "marked"] = "test"
    order: NDArray[np.int64] | None = None
    double_sided: bool | None = True

    @classmethod
    def of_part(cls, program: Program, part: Part, material: Material, /, **uniforms: Any) -> Draw:
        """Return the draw of a part, with the uniforms of the part and further uniforms."""
        values = {**part_uniforms(part, material), **uniforms}
        return cls(program, values, part, material, double_sided=material.double_sided)


@dataclass(frozen=True, eq=False)
class Pass:
    """A list of draws into one target.

    name : uniform name under which later passes read the first image of the target
    others : uniform names of the further images of the target
    area : rectangle to clear, as in :class:`Draw`; None for the whole target
    clear : initial value of all pixels: linear RGB and coverage
    uniforms : uniforms that all draws share
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


T = TypeVar("T")

_CUT = ("UV", "OPACITY", "ALPHA", "TO_COVERAGE")  # prefixes of the features that alpha masks use


@dataclass(frozen=True, eq=False)
class BlendedPart:
    """A blended part.

    part : index of the part in the mesh
    order : (F,) indices of the part's triangles, back to front by the depth of triangle centres
    layer : index of the surface that depth peeling shows at each pixel: 0 is the nearest surface
    """

    part: int
    order: NDArray[np.int64]
    layer: int = 0


def visible_draws(
    scene: Scene, draws: Sequence[Draw], blended_part: BlendedPart | None
) -> tuple[Draw, ...]:
    """Return the draws of all parts that are not blended. With a blended part, these draws write
    only depth, and the draw of its layer follows.

    draws : one draw for each part of the scene
    """
    opaque = unblended(scene, draws)
    if blended_part is None:
        return opaque
    draw, peels = draws[blended_part.part], blended_part.layer > 0
    program = draw.program.having(*("DEPTH_PEELING",) * peels)
    return *map(depth_only, opaque), replace(draw, program=program, order=blended_part.order)


def _blended(scene: Scene) -> list[tuple[int, TriangleSetup]]:
    """Return the index and the triangle setup of each blended part."""
    parts = zip(scene.mesh.parts, scene.mesh.materials, strict=True)
    return [
        (index, triangle_setup_of(part, scene.mesh))
        for index, (part, material) in enumerate(parts)
        if drawn_alpha(part, material) == "blend"
    ]


def blended_parts(scene: Scene, view: View) -> list[BlendedPart]:
    """Return the blended parts in drawing order. The part whose nearest vertex has the largest
    depth comes first."""
    pairs = []
    for index, setup in _blended(scene):
        depth = setup.positions @ view.forward
        order = np.argsort(-depth[setup.faces].sum(axis=1), kind="stable")
        pairs.append((float(depth.min()), BlendedPart(index, order)))
    return [part for _, part in sorted(pairs, key=lambda pair: -pair[0])]


def unblended(scene: Scene, values: Sequence[T]) -> tuple[T, ...]:
    """Return the values, such as draws, of parts that are not blended.

    values : one value for each part of the scene
    """
    parts = zip(scene.mesh.parts, scene.mesh.materials, values, strict=True)
    return tuple(value for part, material, value in parts if drawn_alpha(part, material) != "blend")


def blended_area(scene: Scene, view: View, size: tuple[int, int]) -> Area:
    """Return the bounds of all blended parts in an image; empty if there are none.

    size : width and height of the image
    """
    return around([setup.area(view, size) for _, setup in _blended(scene)])


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
