"""The class Job: a scene and its outputs as plain data for pickle, TOML or JSON. The command line
and programs create jobs; the renderer draws their scenes. This module does not use OpenGL."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

from facerender.errors import (
    InputError,
    check_known,
    check_path,
    check_type,
    each_of,
    number_of,
    parameters,
    short_repr,
    shown,
    warn,
)
from facerender.images.files import format_of
from facerender.loading import load_mesh
from facerender.loading.source import Source, check_normal_map_y, source_of
from facerender.material import MAPS, Material
from facerender.mesh.geometry import Geometry
from facerender.mesh.mesh import TRIANGLES, Mesh, names_of, warn_of_one_lobe
from facerender.mesh.simplify import simplified
from facerender.scene.camera import Camera, camera_of
from facerender.scene.detail import LevelOfDetail, Planned
from facerender.scene.environment import EnvironmentFile, environment_file
from facerender.scene.file import (
    KEYS,
    ImageSettings,
    Pose,
    from_table,
    part_tables,
    scene_value,
    toml_text,
    with_tuples,
)
from facerender.scene.light import Light, lights_of
from facerender.scene.scene import Only, Scene, background_of, check_only, default_light
from facerender.scene.shading import Shading
from facerender.values.ranges import EXPOSURES, check_fields, range_of, ranged
from facerender.values.vectors import BACKGROUNDS, COLORS, ROTATIONS, UP_NAMES, Vector

_SCENE_KEYS = [key for key in KEYS if key != "cameras"]
# The fields of MeshFile that are paths.
MESH_PATHS = ("path", "albedo", "normal_map", "specular_map", "roughness_map", "lobe_map")


@dataclass(frozen=True)
class MeshFile:
    """The files of a mesh, its selected parts, and its number of triangles. Parameters as in
    :func:`facerender.load_mesh` (paths as text), :meth:`facerender.Mesh.select` and
    :func:`facerender.simplified`. ``occlusion``: whether :func:`facerender.with_occlusion` is used.
    """

    path: str | None = None
    albedo: str | None = None
    normal_map: str | None = None
    specular_map: str | None = None
    roughness_map: str | None = None
    flip_v: bool = False
    triangles: int | None = ranged(TRIANGLES, None)
    lobe_map: str | None = None
    millimetres: float | None = ranged(range_of(Geometry, "millimetres"), None)
    occlusion: bool = False
    allow_outside: bool = False
    parts: tuple[str, ...] | None = None
    hide: tuple[str, ...] | None = None
    normal_map_y: str = "up"
    as_is: bool = False
    double_sided: bool = False
    up: str | None = None
    rotate: Vector | None = ranged(ROTATIONS, None)

    __repr__ = short_repr
    __getstate__ = parameters

    def __post_init__(self) -> None:
        for name in ("parts", "hide"):
            if (names := getattr(self, name)) is not None:
                object.__setattr__(self, name, names_of(f"mesh {name}", names) or None)
        for name in MESH_PATHS:
            if (path := getattr(self, name)) is not None:
                check_type(f"mesh {name}", path, str | os.PathLike, "a path as text")
                object.__setattr__(self, name, os.fspath(path))
        check_normal_map_y(self.normal_map_y)
        if self.up is not None:
            check_known("mesh up", self.up, UP_NAMES)
        check_fields(self, "mesh ")

    @cached_property
    def source(self) -> Source:
        """The mesh file, which is read once: :meth:`load` takes it over."""
        return source_of(self.path)

    def load(self, cache: bool | Literal["read"] = False) -> Mesh:
        """Load the mesh; errors and warnings as in the functions that :class:`MeshFile` names."""
        exclusions = ("path", "triangles", "occlusion")
        options = {name: value for name, value in _plain(self).items() if name not in exclusions}
        source = self.source
        object.__delattr__(self, "source")  # the content of the file takes memory
        mesh = load_mesh(source, cache=cache, **options)
        if self.occlusion:
            from facerender.mesh.occlusion import with_occlusion

            mesh = with_occlusion(mesh, cache=bool(cache))
        return mesh if self.triangles is None else simplified(mesh, self.triangles)


def parse_size(text: str, name: str = "size") -> tuple[int, int]:
    """Parse width and height from ``N`` or ``WxH``; raise InputError for other text, and for a size
    that no image can have."""
    try:
        numbers = [int(word) for word in text.lower().split("x")]
        width, height = numbers * 2 if len(numbers) == 1 else numbers
    except ValueError:
        raise InputError(f"{name} {shown(text)}: give N or WxH, such as 1024 or 640x480") from None
    return ImageSettings((width, height)).size


@dataclass(frozen=True)
class Output:
    """An image file to write.

    Parameters
    ----------
    path : path with the suffix .png, .exr, .jpg or .webp
    only : one term instead of the complete image, see :meth:`facerender.Renderer.render`
    exposure : exposure in stops, default 0; .exr files ignore it
    """

    path: str
    only: Only | None = None
    exposure: float = ranged(EXPOSURES, 0.0)

    __repr__ = short_repr

    def __post_init__(self) -> None:
        check_path("output path", self.path)
        object.__setattr__(self, "path", os.fspath(self.path))
        format_of(self.path)
        check_only(self.only)
        check_fields(self)


@dataclass(frozen=True)
class Job:
    """A render job: scene, shading, settings of the renderer, and the images to write.

    Parameters
    ----------
    mesh : files of the mesh
    material : factors of :class:`facerender.Material` that replace the factors of the skin, see
        :attr:`facerender.Mesh.skin`
    parts : factors of some parts, applied after ``material`` in the order of the table: for each
        name of parts, with wildcards, a table of factors and ``preset``; see
        :meth:`facerender.Mesh.with_material`
    camera, lights, ambient, background : see :class:`facerender.Scene`
    environment : file of the environment map, as in :func:`facerender.load_environment`, or None
    shading : a :class:`facerender.Shading`, or a table for :meth:`Shading.from_dict`
    pose : pose of the mesh
    before : pose of the mesh in the frame before, from which motion vectors start
    planned : images for which the shading was planned, with their level of detail; or None
    image : settings of the renderer, or a table of them
    outputs : image files
    landmarks : path of a landmark file, or None; see :func:`facerender.load_landmarks`

    Raises
    ------
    InputError : a value is outside its domain
    """

    mesh: MeshFile = MeshFile()
    material: Mapping[str, Any] = field(default_factory=dict)
    camera: Camera = Camera()
    lights: tuple[Light, ...] = None  # type: ignore[assignment]  # None: see default_light
    ambient: float | Vector = ranged(COLORS, None)
    background: Vector | None = ranged(BACKGROUNDS, Scene.background)
    shading: Shading = Shading()
    planned: Planned | None = None
    image: ImageSettings = ImageSettings()
    outputs: tuple[Output, ...] = ()
    environment: EnvironmentFile | None = None
    parts: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    pose: Pose = Pose()
    before: Pose = Pose()
    landmarks: str | None = None

    __repr__ = short_repr

    if TYPE_CHECKING:

        def __init__(
            self,
            mesh: MeshFile = ...,
            material: Mapping[str, Any] = ...,
            camera: Camera | str = ...,
            lights: Sequence[Light | str] | None = ...,
            ambient: float | Vector | None = ...,
            background: Vector | str | None = ...,
            shading: Shading | Mapping[str, Any] = ...,
            planned: Planned | None = ...,
            image: ImageSettings | Mapping[str, Any] = ...,
            outputs: Sequence[Output] = ...,
            environment: EnvironmentFile | str | os.PathLike[str] | None = ...,
            parts: Mapping[str, Mapping[str, Any]] = ...,
            pose: Pose = ...,
            before: Pose = ...,
            landmarks: str | None = ...,
        ) -> None: ...

    def __post_init__(self) -> None:
        lights, ambient = default_light(self.lights, self.ambient, self.environment is not None)
        self._set(ambient=ambient, lights=lights_of(lights), camera=camera_of(self.camera))
        self._set(background=background_of(self.background))
        if self.environment is not None:
            self._set(environment=environment_file(self.environment))
        if isinstance(self.shading, Mapping):
            self._set(shading=Shading.from_dict(self.shading))
        if isinstance(self.image, Mapping):
            self._set(image=from_table(ImageSettings, "image", self.image))
        check_type("mesh", self.mesh, MeshFile, "a MeshFile")
        check_type("shading", self.shading, Shading, "a Shading")
        check_type("image", self.image, ImageSettings, "an ImageSettings")
        for name in ("pose", "before"):
            check_type(name, getattr(self, name), Pose, "a facerender.Pose")
        check_type("planned", self.planned, Planned | None, "a facerender.scene.detail.Planned")
        check_type("outputs", self.outputs, list | tuple, "a list of Output")
        self._set(outputs=each_of("outputs", self.outputs, Output, "a list of Output"))
        if self.landmarks is not None:
            check_path("landmarks", self.landmarks)
            self._set(landmarks=os.fspath(self.landmarks))
        from_table(Material, "material", self.material, without=MAPS)  # only to validate
        self._set(material=with_tuples(self.material), parts=part_tables("parts", self.parts))
        check_fields(self)

    def _set(self, **values: Any) -> None:
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def scene(self, mesh: Mesh | None = None, moves: bool = False) -> Scene:
        """Return the scene.

        Parameters
        ----------
        mesh : result of ``self.mesh.load()``, which several jobs may share; None to load the mesh
        moves : whether the scene has the frame before (:attr:`Scene.before`), for motion vectors

        Raises
        ------
        InputError : a file cannot be used; warnings as in :func:`facerender.load_mesh`
        """
        loaded = self.mesh.load() if mesh is None else mesh
        previous_scene = None
        if moves or self.pose != Pose():
            from facerender.scene.vertices import posed

            previous_scene = Scene(posed(loaded, self.before), self.camera) if moves else None
            loaded = posed(loaded, self.pose)
        if self.material:
            loaded = loaded.with_skin(**self.material)
        for name, table in self.parts.items():
            loaded = loaded.with_material((name,), **table)
        if self.mesh.lobe_map and not any(material.two_lobes for material in loaded.materials):
            warn_of_one_lobe(loaded.name, "lobe_map")
        light = self.lights, self.ambient, self.background, self.environment
        return Scene(loaded, self.camera, *light, previous_scene)

    def detail(self, samples: int, name: str = "the scene") -> LevelOfDetail:
        """Return the level of detail of an image with the renderer's samples per pixel. The planned
        level is used only for the planned size and samples. Otherwise, a FacerenderWarning, which
        contains the name of the scene, is emitted, and all triangles are drawn."""
        if self.planned and self.planned.holds(self.image.size, samples):
            return self.planned.detail
        if self.planned:
            width, height = self.image.size
            warn(
                f"{name} was planned for {self.planned}: at {width} x {height} with "
                f"{number_of(self.image.samples, 'sample')} its error is unknown; plan for this "
                "size and samples"
            )
        return LevelOfDetail(self.image.samples, None)

    def as_dict(self) -> dict[str, Any]:
        """Return the job as plain data for JSON or TOML; see :meth:`from_dict`."""
        return {
            "mesh": _plain(self.mesh),
            "material": dict(self.material),
            **({"parts": dict(self.parts)} if self.parts else {}),
            "camera": _plain(self.camera),
            "lights": [_plain(light) for light in self.lights],
            **({"environment": _plain(self.environment)} if self.environment else {}),
            "ambient": self.ambient,
            "background": "none" if self.background is None else self.background,
            "shading": self.shading.as_dict(),
            **{n: _plain(pose) for n in ("pose", "before") if (pose := getattr(self, n)) != Pose()},
            **({"planned": _plain(self.planned)} if self.planned else {}),
            "image": _plain(self.image),
            **({"landmarks": self.landmarks} if self.landmarks else {}),
            "outputs": [_plain(output) for output in self.outputs],
        }

    @classmethod
    def from_dict(cls, tables: Mapping[str, Any]) -> Job:
        """Return the job that data from :meth:`as_dict` describe; missing keys get their defaults.

        Parameters
        ----------
        tables : the keys of a scene file (see :func:`facerender.load_scene`) except cameras, and
            the keys mesh, image and outputs

        Raises
        ------
        InputError : a key is unknown, or a value is outside its domain
        """
        if not isinstance(tables, Mapping):
            raise InputError(f"job = {tables!r}: give a table")
        return cls(**{key: job_value(key, value) for key, value in tables.items()})

    def toml(self) -> str:
        """Return the job as the text of a TOML file."""
        tables = self.as_dict()
        if not self.lights:
            tables["lights"] = tables.pop("lights")  # after the other values without tables
        return toml_text(tables | {"outputs": tables["outputs"] or None})


def job_value(key: str, value: Any) -> Any:
    """Convert the plain value of a key of a job, as :func:`scene_value` does for a scene."""
    check_known("key", key, (*_SCENE_KEYS, "mesh", "outputs", "landmarks"))
    if key == "mesh":
        return from_table(MeshFile, key, value)
    if key == "outputs":
        check_type(key, value, list, "a list of tables")
        return tuple(from_table(Output, key, table) for table in value)
    return value if key == "landmarks" else scene_value(key, value)


def _plain(instance: Any) -> dict[str, Any]:
    return {name: value for name, value in asdict(instance).items() if value not in (None, {})}
