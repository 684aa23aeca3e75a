"""Rendering passes as data. To draw an image, the renderer executes a list of the passes that the
scene needs. No OpenGL here."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from facerender.drawing.program import Program, Uniforms, part_uniforms
from facerender.drawing.triangle_setup import Area as Area
from facerender.scenes.material import Material
from facerender.scenes.mesh import Part


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
