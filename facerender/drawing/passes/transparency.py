"""Blended parts, which are drawn back to front over the other parts, and depth peeling, which draws
one transparent layer of a part."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from facerender.drawing.passes import Area, Draw, Pass, Target
from facerender.drawing.program import Program
from facerender.drawing.triangle_setup import TriangleSetup, around, triangle_setup_of
from facerender.scenes.mesh import drawn_alpha
from facerender.scenes.scene import Scene
from facerender.scenes.view import View

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
