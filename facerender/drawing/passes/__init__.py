"""What the renderer draws for an image: a list of passes, each a value. What a scene does not need
is no pass. No OpenGL here."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from facerender.drawing.program import Program, Uniforms
from facerender.drawing.triangle_setup import TriangleSetup
from facerender.scenes.material import Material
from facerender.scenes.mesh import Part

Area = tuple[int, int, int, int]


@dataclass(frozen=True)
class Target:
    """What a pass draws into.

    Attributes
    ----------
    colors : how many images at once
    samples : per pixel
    size : width and height in pixels; None for the frame's
    sampled : whether later passes read its images as textures
    values : float32, RGBA or one number
    number : tells targets apart that are alike
    """

    colors: int = 1
    samples: int = 1
    size: tuple[int, int] | None = None
    sampled: bool = False
    values: Literal["color", "number"] = "color"
    number: int = 0


@dataclass(frozen=True, eq=False)
class Draw:
    """A part with its program; without a part, one triangle that covers the target.

    Attributes
    ----------
    setup : of the part's triangles: only their positions are drawn, in their order
    area : left, lowest row, width and height in pixels of the target; None for all of it
    depth : "test", what is behind is hidden; "hide", the same, and depth alone is drawn; "blend",
        the same, and what is drawn, which hides nothing, lies over what is there; "mark", depth
        alone is drawn, over whatever is there; "marked", what is drawn shows where the draw before
        marked. With the last two one triangle covers the area, whose program reads the setup
    order : of the part's triangles, their numbers as they are drawn; None for their own order
    """

    program: Program
    uniforms: Uniforms
    part: Part | None = None
    material: Material | None = None
    setup: TriangleSetup | None = None
    area: Area | None = None
    depth: Literal["test", "hide", "blend", "mark", "marked"] = "test"
    order: NDArray[np.int64] | None = None


@dataclass(frozen=True, eq=False)
class Pass:
    """Some draws into one target.

    Attributes
    ----------
    name : for passes that read its first image
    others : names of its other images, for passes that read them
    clear : linear RGB and coverage where nothing is drawn
    uniforms : that all draws share
    added : whether draws add to what is there
    cull_back_faces : whether only front faces are drawn
    key : of all that its image depends on: it is not drawn while its target holds the same; None
        where it is always drawn
    """

    name: str
    target: Target
    draws: tuple[Draw, ...]
    clear: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    uniforms: Uniforms = field(default_factory=dict)
    added: bool = False
    cull_back_faces: bool = False
    key: Hashable = None
    others: tuple[str, ...] = ()
