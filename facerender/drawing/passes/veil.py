"""Blended parts: drawn after all others, from the back to the front, over what is there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from facerender.drawing.facets import facets_of
from facerender.drawing.passes import Draw, Pass
from facerender.drawing.program import Program
from facerender.scenes.mesh import drawn_alpha
from facerender.scenes.scene import Scene
from facerender.scenes.view import View

PEELED = "peeled"  # the texture of what the layers of a veil before the one that is drawn hold
_CUT = ("UV", "OPACITY", "ALPHA", "TO_COVERAGE")  # how features begin that masks depend on


@dataclass(frozen=True, eq=False)
class Veil:
    """A blended part.

    Attributes
    ----------
    part : its number in the mesh
    order : of its triangles, from the back to the front by the depth of their middles
    layer : which of its surfaces before a pixel is meant, where only one is drawn: 0 is the nearest
    """

    part: int
    order: NDArray[np.int64]
    layer: int = 0

    def alone(self, scene: Scene, draws: Sequence[Draw]) -> tuple[Draw, ...]:
        """Return, of the draws of every part, that of its layer, behind the depth of what hides
        it."""
        own = draws[self.part]
        features = (*own.program.features, *(("PEEL",) * (self.layer > 0)))
        program = replace(own.program, features=features)
        hides = (hiding(draw) for draw in unveiled(scene, draws))
        return *hides, replace(own, program=program, order=self.order)


def veils(scene: Scene, view: View) -> list[Veil]:
    """Return the blended parts in the order in which they are drawn: that whose nearest vertex is
    farthest first."""
    found = []
    for number, (part, material) in enumerate(
        zip(scene.mesh.parts, scene.mesh.materials, strict=True)
    ):
        if drawn_alpha(part, material) == "blend":
            facets = facets_of(part, scene.mesh)
            depth = facets.positions @ view.forward
            order = np.argsort(-depth[facets.faces].sum(axis=1), kind="stable")
            found.append((float(depth.min()), Veil(number, order)))
    return [veil for _, veil in sorted(found, key=lambda each: -each[0])]


def unveiled(scene: Scene, draws: Sequence[Draw]) -> tuple[Draw, ...]:
    """Return the draws, of those of every part, of parts that are not blended."""
    parts = zip(scene.mesh.parts, scene.mesh.materials, draws, strict=True)
    return tuple(draw for part, material, draw in parts if drawn_alpha(part, material) != "blend")


def veiling(scene: Scene, view: View, draws: Sequence[Draw]) -> tuple[Draw, ...]:
    """Return the draws, of those of every part, of blended parts, in their order."""
    over = veils(scene, view)
    return tuple(replace(draws[each.part], order=each.order, depth="blend") for each in over)


def veil_over(shaded: Pass, image: Pass) -> list[Pass]:
    """Return the pass that draws the blended parts of another, and a pass that draws an image of
    one sample a pixel, with these over it."""
    hides = [hiding(draw) for draw in shaded.draws if draw.depth == "test"]
    over = [draw for draw in shaded.draws if draw.depth == "blend"]
    target = replace(shaded.target, sampled=True, number=1)
    veil = replace(shaded, name="veil", target=target, draws=(*hides, *over), clear=(0.0,) * 4)
    veiled = Draw(Program("veiled.frag", "screen.vert"), {"depth": -1.0}, depth="blend")
    return [veil, replace(image, draws=(*image.draws, veiled))]


def hiding(draw: Draw) -> Draw:
    """Return a draw of a part that leaves its depth alone."""
    program = Program("hide.frag", features=cut_features(draw.program.features))
    return replace(draw, program=program, depth="hide")


def cut_features(features: Sequence[str]) -> tuple[str, ...]:
    """Return what a program needs to know of a mask, where there is one."""
    cut = "ALPHA_MASK" in features
    return tuple(name for name in features if name.startswith(_CUT)) if cut else ()
