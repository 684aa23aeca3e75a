"""What the renderer draws for an image: a list of passes, each a value. What a scene does not need
is no pass. No OpenGL here."""

from __future__ import annotations

from dataclasses import dataclass, field

from facerender.drawing.program import Program, Uniforms
from facerender.scenes.material import Material
from facerender.scenes.mesh import Part


@dataclass(frozen=True)
class Target:
    """What a pass draws into: float32 RGBA, with a depth buffer.

    Attributes
    ----------
    colors : how many images at once
    samples : per pixel
    size : width and height in pixels; None for the frame's
    sampled : whether later passes read its first image as the texture of the pass's name
    """

    colors: int = 1
    samples: int = 1
    size: tuple[int, int] | None = None
    sampled: bool = False


@dataclass(frozen=True, eq=False)
class Draw:
    """A part with its program; without a part, one triangle that covers the target."""

    program: Program
    uniforms: Uniforms
    part: Part | None = None
    material: Material | None = None


@dataclass(frozen=True, eq=False)
class Pass:
    """Some draws into one target.

    Attributes
    ----------
    name : for passes that read what it drew
    clear : linear RGB and coverage where nothing is drawn
    uniforms : that all draws share
    """

    name: str
    target: Target
    draws: tuple[Draw, ...]
    clear: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    uniforms: Uniforms = field(default_factory=dict)
