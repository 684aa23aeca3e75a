"""Scenes: a mesh with camera, lights, environment map and background."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

from facerender.errors import InputError, check_type, each_of, shown
from facerender.scenes import sources
from facerender.scenes.camera import Camera
from facerender.scenes.light import LIGHTS, Light
from facerender.scenes.mesh import Mesh
from facerender.scenes.vectors import BACKGROUNDS, COLORS, Vector
from facerender.terms.ranges import check_fields, ranged

if TYPE_CHECKING:
    from collections.abc import Sequence

    from facerender.scenes.environment import Environment
    from facerender.scenes.sources import MeshSource

Only = Literal[
    "specular",
    "diffuse",
    "albedo",
    "normal",
    "depth",
    "cosines",
    "visibility",
    "mask",
    "parts",
    "motion",
]

# A pixel is shaded at each of its samples ("sample"), or once for each part in it ("pixel").
ShadingRate = Literal["sample", "pixel"]
SHADING_RATES: tuple[ShadingRate, ...] = get_args(ShadingRate)

# Images of one term or layer of a scene. Images in DATA have one sample per pixel.
ONLY: tuple[Only, ...] = get_args(Only)
DATA = tuple(name for name in ONLY if name not in ("specular", "diffuse"))


def check_shading_rate(name: str, value: object) -> None:
    """Raise InputError if a value is not in SHADING_RATES."""
    if not isinstance(value, str) or value not in SHADING_RATES:
        raise InputError(f"{name} = {shown(value)}: give {' or '.join(SHADING_RATES)}")


@dataclass(frozen=True)
class Scene:
    """A mesh with camera, lights, environment map and background.

    Parameters
    ----------
    mesh : a :class:`Mesh`, or any source that :func:`facerender.load_mesh` accepts
    camera, lights : see :class:`Camera` and :class:`Light`
    ambient : irradiance of uniform ambient light, one number or linear RGB
    background : linear RGB behind the mesh, or None for a transparent background
    environment : environment map that lights the mesh but is not visible behind it, or None
    before : the scene in the frame before, for motion vectors, or None. Its mesh has the same
        triangles, usually in another pose, and its camera may differ
    """

    mesh: Mesh
    camera: Camera = Camera()
    lights: tuple[Light, ...] = (LIGHTS["key"], LIGHTS["rim"], LIGHTS["fill"])
    ambient: float | Vector = ranged(COLORS, (0.26, 0.28, 0.31))
    background: Vector | None = ranged(BACKGROUNDS, (0.012, 0.013, 0.016))
    environment: Environment | None = None
    before: Scene | None = None

    if TYPE_CHECKING:

        def __init__(
            self,
            mesh: Mesh | MeshSource,
            camera: Camera = ...,
            lights: Sequence[Light] = ...,
            ambient: float | Vector = ...,
            background: Vector | None = ...,
            environment: Environment | None = ...,
            before: Scene | None = ...,
        ) -> None: ...

    def __post_init__(self) -> None:
        if sources.reader and not isinstance(self.mesh, Mesh) and self.mesh is not None:
            object.__setattr__(self, "mesh", sources.reader(self.mesh))
        check_type("mesh", self.mesh, Mesh, "a Mesh, as facerender.load_mesh(FILE) returns it")
        check_type("camera", self.camera, Camera, "a facerender.Camera")
        lights = each_of("lights", self.lights, Light, "several facerender.Light")
        object.__setattr__(self, "lights", lights)
        check_fields(self)
        check_type("before", self.before, Scene | None, "the facerender.Scene of the frame before")
        if self.environment is not None:
            from facerender.scenes.environment import Environment

            remedy = "an Environment, as facerender.load_environment returns it"
            check_type("environment", self.environment, Environment, remedy)
