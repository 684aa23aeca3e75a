"""Scenes: a mesh with camera, lights, environment map and background."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, get_args

from facerender.errors import InputError, check_known, check_type, short_repr, shown
from facerender.mesh.mesh import Mesh
from facerender.scene.camera import Camera, camera_of
from facerender.scene.environment import Environment, EnvironmentSource, load_environment
from facerender.scene.light import LIGHTS, Light, lights_of
from facerender.values.ranges import check_fields, ranged
from facerender.values.vectors import BACKGROUNDS, COLORS, Vector, numbers_in

if TYPE_CHECKING:
    from collections.abc import Sequence

    from facerender.loading import MeshSource

# Images of one term or layer of a scene. Images in DATA have one sample per pixel.
Data = Literal["albedo", "normal", "depth", "cosines", "visibility", "mask", "parts", "motion"]
Only = Literal["specular", "diffuse", Data]
DATA: tuple[Data, ...] = get_args(Data)
ONLY: tuple[Only, ...] = get_args(Only)

# A pixel is shaded at each of its samples ("sample"), or once for each part in it ("pixel").
ShadingRate = Literal["sample", "pixel"]
SHADING_RATES: tuple[ShadingRate, ...] = get_args(ShadingRate)

_BACKGROUND: Vector = (0.012, 0.013, 0.016)


def check_only(value: object) -> None:
    """Raise InputError unless a value is in ONLY, or None for the whole image."""
    if value is not None:
        check_known("term", value, ONLY)


def check_shading_rate(name: str, value: object) -> None:
    """Raise InputError if a value is not in SHADING_RATES."""
    if not isinstance(value, str) or value not in SHADING_RATES:
        raise InputError(f"{name} = {shown(value)}: give {' or '.join(SHADING_RATES)}")


def background_of(value: Any) -> Vector | None:
    """Return a background colour, which may be given as text: ``R,G,B``, or ``none``. Raises
    InputError if the text has another form, or a value is outside its range."""
    if value is None or (isinstance(value, str) and value == "none"):
        return None
    numbers = tuple(numbers_in(value.split(","))) if isinstance(value, str) else value
    if isinstance(value, str) and len(numbers) != 3:
        raise InputError(
            f"background = {shown(value)}: give 3 numbers in linear RGB, or none for a transparent "
            "background"
        )
    color: Vector = BACKGROUNDS.check("background", numbers)
    return color


@dataclass(frozen=True, init=False)
class Scene:
    """A mesh with camera, lights, environment map and background.

    Parameters
    ----------
    mesh : a :class:`Mesh`, or any source that :func:`facerender.load_mesh` accepts
    camera : a :class:`Camera`, or text: "front", "three-quarter", "profile", or
        "AZIMUTH,ELEVATION,ZOOM", of which the last two may be left out
    lights : each a :class:`Light`, or text: "key", "rim", "fill", "front", "top", or another text
        of ``--light``, such as "key,no-shadow". None (default) for key, rim and fill, or for no
        lights if there is an environment map
    ambient : irradiance of uniform ambient light, one number or linear RGB. None (default) for
        (0.26, 0.28, 0.31), or for 0 if there is an environment map
    background : linear RGB behind the mesh, or None or "none" for a transparent background
    environment : environment map that lights the mesh but is not visible behind it, or any value
        that :func:`facerender.load_environment` accepts, or None
    before : the scene in the frame before, for motion vectors, or None. Its mesh has the same
        triangles, usually in another pose, and its camera may differ
    """

    mesh: Mesh
    camera: Camera = Camera()
    lights: tuple[Light, ...] = (LIGHTS["key"], LIGHTS["rim"], LIGHTS["fill"])
    ambient: float | Vector = ranged(COLORS, (0.26, 0.28, 0.31))
    background: Vector | None = ranged(BACKGROUNDS, _BACKGROUND)
    environment: Environment | None = None
    before: Scene | None = None

    __repr__ = short_repr

    def __init__(
        self,
        mesh: Mesh | MeshSource,
        camera: Camera | str = camera,
        lights: Sequence[Light | str] | None = None,
        ambient: float | Vector | None = None,
        background: Vector | str | None = _BACKGROUND,
        environment: EnvironmentSource | None = None,
        before: Scene | None = None,
    ) -> None:
        if not isinstance(mesh, Mesh) and mesh is not None:
            from facerender.loading import load_mesh

            mesh = load_mesh(mesh)
        check_type("mesh", mesh, Mesh, "a Mesh, as facerender.load_mesh(FILE) returns it")
        check_type("before", before, Scene | None, "the facerender.Scene of the frame before")
        if environment is not None and not isinstance(environment, Environment):
            environment = load_environment(environment)
        lights, ambient = default_light(lights, ambient, environment is not None)
        values = {
            "mesh": mesh,
            "camera": camera_of(camera),
            "lights": lights_of(lights),
            "ambient": ambient,
            "background": background_of(background),
            "environment": environment,
            "before": before,
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)
        check_fields(self)


def default_light(lights: Any, ambient: Any, has_environment: bool) -> tuple[Any, Any]:
    """Return the lights and the ambient light of a scene. Replace None by the default: no
    light with an environment map, otherwise the lights of :class:`Scene`."""
    return (
        (() if has_environment else Scene.lights) if lights is None else lights,
        (0.0 if has_environment else Scene.ambient) if ambient is None else ambient,
    )
