"""Scenes: a mesh with camera, lights, environment map and background."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal, get_args

from facerender.errors import InputError, quoted
from facerender.images.files import read_image
from facerender.images.image import ImageData
from facerender.mesh.mesh import Mesh
from facerender.scene.background import BACKGROUNDS, ENVIRONMENT, BackgroundSource
from facerender.scene.camera import ORBITS, Camera
from facerender.scene.environment import Environment, EnvironmentSource, load_environment
from facerender.scene.light import RIGS, Light
from facerender.values.fields import TEXT, Built, Several, field, record
from facerender.values.vectors import COLORS, Vector

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

AMBIENT: Vector = (0.26, 0.28, 0.31)  # without an environment map


@record()
class Scene:
    """A mesh with camera, lights, environment map and background.

    Parameters
    ----------
    mesh : a :class:`Mesh`, or any source that :func:`facerender.load_mesh` accepts
    environment : environment map that lights the mesh, or any value that
        :func:`facerender.load_environment` accepts, or None
    before : the scene in the frame before, for motion vectors, or None. Its mesh has the same
        triangles, usually in another pose, and its camera may differ
    """

    mesh: Mesh
    camera: Camera = field(
        Built(Camera),
        Camera(),
        f"a :class:`Camera`, or text: {ORBITS}",
    )
    lights: tuple[Light, ...] = field(
        Several(Light, RIGS),
        None,
        'each a :class:`Light`, a text of ``--light``, such as "key" or "key,no-shadow", or a rig: '
        f"{' or '.join(RIGS)}. None for portrait, or for no lights if there is an environment map",
    )
    ambient: float | Vector = field(
        COLORS,
        None,
        "ambient irradiance, E or R,G,B",
        unset=f"{','.join(map(str, AMBIENT))}; 0 with an environment map",
    )
    background: Vector | ImageData | str | None = field(
        BACKGROUNDS,
        (0.012, 0.013, 0.016),
        'linear background colour R,G,B, "none" for transparent, "environment" for the environment '
        "map, or an image: a file (Python: also an array), scaled to cover the background",
        ".jpg, .gif and .mp4 cannot be transparent. Exposure and tone leave colours and images as "
        "they are",
    )
    environment: Environment | None = None
    before: Scene | None = None
    anonymous: str | None = field(
        TEXT,
        None,
        "text that metadata and records contain instead of the name of the mesh; they then contain "
        "no names of parts, cameras and files",
        unset="none, and names appear",
    )

    if TYPE_CHECKING:

        def __init__(
            self,
            mesh: Mesh | MeshSource | None,
            camera: Camera | str = ...,
            lights: Sequence[Light | str] | Light | str | None = ...,
            ambient: float | Vector | None = ...,
            background: BackgroundSource = ...,
            environment: EnvironmentSource | None = ...,
            before: Scene | None = ...,
            anonymous: str | None = ...,
        ) -> None: ...

    def __post_init__(self) -> None:
        if self.mesh is None:  # load_mesh would return the built-in head
            raise InputError("mesh = None: give a facerender.Mesh, or the path of a mesh file")
        if not isinstance(self.mesh, Mesh):
            from facerender.loading import load_mesh

            object.__setattr__(self, "mesh", load_mesh(self.mesh))
        if self.environment is not None and not isinstance(self.environment, Environment):
            object.__setattr__(self, "environment", load_environment(self.environment))
        if isinstance(self.background, str) and self.background != ENVIRONMENT:
            object.__setattr__(self, "background", read_image(self.background))
        if not isinstance(self.before, Scene | None):
            raise InputError(f"before = {quoted(self.before)}: give the scene of the frame before")
        set_default_light(self)

    @property
    def labelled(self) -> Scene:
        """The scene with the names that metadata and records may contain; see ``anonymous``."""
        if self.anonymous is None:
            return self
        camera, back, light = replace(self.camera, name=""), self.background, self.environment
        if light is not None:
            light = replace(light, panorama=replace(light.panorama, name="environment map"))
        if isinstance(back, ImageData):
            back = back.renamed("background image")
        before = self.before and replace(self.before, anonymous=self.anonymous).labelled
        mesh = self.mesh.renamed(self.anonymous)
        return Scene(mesh, camera, self.lights, self.ambient, back, light, before, self.anonymous)


def default_lights(has_environment: bool) -> tuple[Light, ...]:
    """Return the lights of a scene that does not define any: an environment map replaces them."""
    return () if has_environment else RIGS["portrait"]


def set_default_light(scene: Any) -> None:
    """Set the lights and the ambient light of a new scene or job that does not define them."""
    has_environment = scene.environment is not None
    # Key, rim and fill over an environment map would light the face twice.
    if scene.lights is None:
        object.__setattr__(scene, "lights", default_lights(has_environment))
    if scene.ambient is None:
        object.__setattr__(scene, "ambient", (0.0, 0.0, 0.0) if has_environment else AMBIENT)
