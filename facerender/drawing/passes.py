"""Passes, draws and render targets as values. They depend on what a scene shows and on the settings
of a frame, but not on camera and pose: ``compiled`` draws them again for each view. No OpenGL here.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from facerender.drawing.prepare import ResolvedPart
from facerender.drawing.program import Program, Uniforms, part_uniforms
from facerender.mesh.setup import Area

# Bounds in the image of a view: of the draw's part, of all blended parts, or of all other parts.
Bounds = Literal["part", "blended", "opaque"]
# Triangles of a view: all that can face the camera; or all triangles, back to front.
Order = Literal["facing", "sorted"]


@dataclass(frozen=True)
class Target:
    """The render target of a pass: a framebuffer with float32 images.

    channels : number of channels of each colour image
    samples : samples per pixel
    size : width and height in pixels; None for the size of the frame
    sampled : whether later passes read the images as textures
    number : number that distinguishes targets with otherwise equal attributes
    resolved : whether later passes read one value per pixel of colours with several samples
    depth_of : target whose depth buffer this target shares and does not clear; None for a depth
        buffer of its own
    """

    channels: tuple[int, ...] = (4,)
    samples: int = 1
    size: tuple[int, int] | None = None
    sampled: bool = False
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
        - "visible": like "marked" without marks, for cheap programs, which discard other pixels
    order : indices (F,) of the part's triangles in drawing order, or the name of the order; None
        for the order of the part. Consecutive "sorted" draws are drawn back to front
    double_sided : false to draw only front faces
    """

    program: Program
    uniforms: Uniforms
    part: ResolvedPart | None = None
    area: Area | Bounds | None = None
    depth: Literal["test", "hide", "blend", "mark", "marked", "visible"] = "test"
    order: NDArray[np.int64] | Order | None = None
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
    results : indices of the images that the frame returns
    area : rectangle to clear, as in :class:`Draw`; None for the whole target
    clear : initial value of all pixels: linear RGB and coverage. None: the pass draws over the
        target's images and depths
    uniforms : uniforms of all draws. The compiled frame adds the camera's
    added : whether draws add their colours to the image
    key : value of everything except the pose that the image depends on. The pass is skipped if the
        target already holds an image of this pose with an equal key. None: it is always drawn
    """

    name: str
    target: Target
    draws: tuple[Draw, ...]
    clear: tuple[float, float, float, float] | None = (0.0, 0.0, 0.0, 0.0)
    uniforms: Uniforms = field(default_factory=dict)
    added: bool = False
    key: Hashable = None
    others: tuple[str, ...] = ()
    results: tuple[int, ...] = ()
    area: Area | Bounds | None = None


_CUT = ("UV", "OPACITY", "ALPHA", "TO_COVERAGE")  # prefixes of the features that alpha masks use


def depth_only(draw: Draw) -> Draw:
    """Return a draw that writes only the depth of a part."""
    program = Program("depth.frag", features=mask_features(draw.program.features))
    return replace(draw, program=program, depth="hide")


def mask_features(features: Sequence[str]) -> tuple[str, ...]:
    """Return only the features that the part's alpha mask needs; () without a mask."""
    cut = "ALPHA_MASK" in features
    return tuple(name for name in features if name.startswith(_CUT)) if cut else ()
