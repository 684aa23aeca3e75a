"""What is rendered: camera, lights, material, and the scene that joins them with a mesh; scenes
from TOML files. Angles are in degrees here, lengths in the mesh's units. No OpenGL."""

from __future__ import annotations

import json
import math
import os
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, check_range, reason
from facerender.lobes import MAX_SLOPE, MIN_SLOPE
from facerender.shading import MAX_WEIGHT, Shading
from facerender.texture import Texture, pack

if TYPE_CHECKING:
    from facerender.mesh import Mesh

Vector = tuple[float, float, float]

SKIN_ALBEDO: Vector = (0.48, 0.28, 0.21)  # linear; where a mesh brings no colour of its own


def _vector(name: str, value: Any) -> Vector:
    """Return three finite numbers; one number stands for three equal ones."""
    try:
        array = np.broadcast_to(np.asarray(value, dtype=np.float64), 3)
    except (TypeError, ValueError):
        array = np.array([math.nan])
    if not np.isfinite(array).all():
        raise InputError(f"{name} = {value!r}: give a finite number, or three")
    x, y, z = (float(component) for component in array)
    return x, y, z


def _non_negative(name: str, value: Any) -> Vector:
    """Return three finite numbers, none below 0, such as a colour or an irradiance."""
    vector = _vector(name, value)
    if min(vector) < 0.0:
        raise InputError(f"{name} = {vector} is negative")
    return vector


def _direction(azimuth: float, elevation: float) -> NDArray[np.float64]:
    """Unit vector from the subject: azimuth 0 is +z (in front), 90 is +x; elevation 90 is +y."""
    a, e = math.radians(azimuth), math.radians(elevation)
    return np.array([math.sin(a) * math.cos(e), math.sin(e), math.cos(a) * math.cos(e)])


@dataclass(frozen=True)
class Camera:
    """A perspective camera, which orbits the mesh and frames it, or stands where it is told.

    Parameters
    ----------
    azimuth, elevation : degrees; 0, 0 looks at the face, azimuth 90 sees the side at +x
    fov : vertical angle of view, degrees in [1, 150]
    zoom : magnification relative to the framing that holds the whole mesh at every azimuth
    target : what the centre of the image shows; None for the centre of the mesh's bounds
    position : the eye; None for the orbit
    """

    azimuth: float = 0.0
    elevation: float = 0.0
    fov: float = 25.0
    zoom: float = 1.0
    target: Vector | None = None
    position: Vector | None = None

    def __post_init__(self) -> None:
        ends = {"azimuth": (-3600, 3600), "elevation": (-90, 90), "fov": (1, 150)}
        for name, (low, high) in (ends | {"zoom": (0.01, 1000)}).items():
            check_range(f"camera {name}", getattr(self, name), low, high)
            object.__setattr__(self, name, float(getattr(self, name)))
        for name in ("target", "position"):
            if (value := getattr(self, name)) is not None:
                object.__setattr__(self, name, _vector(f"camera {name}", value))


@dataclass(frozen=True)
class Light:
    """A distant light, or a point light when it has a position.

    Parameters
    ----------
    azimuth, elevation : degrees, the direction in which a distant light stands, as for the camera
    irradiance : what a surface facing the light receives, one number or linear RGB; of a point
        light: at the centre of the mesh. pi shows a white diffuse surface as 1.
    position : of a point light, in the mesh's units; azimuth and elevation then do not count
    """

    azimuth: float = 0.0
    elevation: float = 0.0
    irradiance: float | Vector = math.pi
    position: Vector | None = None

    def __post_init__(self) -> None:
        check_range("light azimuth", self.azimuth, -3600, 3600)
        check_range("light elevation", self.elevation, -90, 90)
        irradiance = _non_negative("light irradiance", self.irradiance)
        object.__setattr__(self, "irradiance", irradiance)
        if self.position is not None:
            object.__setattr__(self, "position", _vector("light position", self.position))

    @property
    def direction(self) -> NDArray[np.float64]:
        """Unit vector towards a distant light."""
        return _direction(self.azimuth, self.elevation)


# Key and rim are high and oblique, where the highlight of skin shows.
LIGHTS: Mapping[str, Light] = {
    "key": Light(azimuth=-50.0, elevation=42.0, irradiance=(3.6, 3.4, 3.1)),
    "rim": Light(azimuth=100.0, elevation=33.0, irradiance=(2.4, 2.5, 2.7)),
    "fill": Light(azimuth=50.0, elevation=5.0, irradiance=(0.34, 0.36, 0.4)),
    "front": Light(azimuth=0.0, elevation=10.0, irradiance=2.5),
    "top": Light(azimuth=0.0, elevation=75.0, irradiance=2.5),
}


def parse_light(text: str) -> Light:
    """Read a light from ``NAME``, ``AZIMUTH,ELEVATION[,IRRADIANCE]`` or
    ``point:X,Y,Z[,IRRADIANCE]``, the irradiance being E or R,G,B.

    Raises
    ------
    InputError : neither a known name nor numbers of that form
    """
    if text in LIGHTS:
        return LIGHTS[text]
    kind, _, rest = text.rpartition(":")
    try:
        values = [float(word) for word in rest.split(",")]
        count = {"": 2, "point": 3}[kind]
        where, irradiance = values[:count], values[count:] or [math.pi]
        if len(where) != count or len(irradiance) not in (1, 3):
            raise ValueError
    except (KeyError, ValueError):
        raise InputError(
            f"unknown light {text!r}; give {', '.join(LIGHTS)}, or AZIMUTH,ELEVATION[,IRRADIANCE],"
            " or point:X,Y,Z[,IRRADIANCE]"
        ) from None
    received = _vector("light irradiance", irradiance if irradiance[1:] else irradiance[0])
    if kind == "point":
        return Light(irradiance=received, position=_vector("light position", where))
    return Light(where[0], where[1], received)


@dataclass(frozen=True)
class Material:
    """Reflectance of a part: factors, and the maps that they multiply.

    Parameters
    ----------
    albedo : linear RGB
    m : rms slope of the microfacets, in [1e-4, 2], where there is no roughness map
    roughness_factor : in [0, 1], of the roughness map: m is (factor times texel)^2, as in glTF
    f0 : Fresnel reflectance at normal incidence, in [0, 1)
    ks, kd : specular and diffuse weights, >= 0. 1 is a bare dielectric; 0.18, from GPU Gems 3
        chapter 14, suits powdered skin
    albedo_map, normal_map, roughness_map, specular_map, occlusion_map : textures or None; only the
        albedo is sRGB-encoded; green of the normal map points up; occlusion dims ambient light
    """

    albedo: Vector = SKIN_ALBEDO
    m: float = 0.3
    roughness_factor: float = 1.0
    f0: float = 0.028
    ks: float = 1.0
    kd: float = 1.0
    albedo_map: Texture | None = None
    normal_map: Texture | None = None
    roughness_map: Texture | None = None
    specular_map: Texture | None = None
    occlusion_map: Texture | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "albedo", _non_negative("albedo", self.albedo))
        check_range("m", self.m, MIN_SLOPE, MAX_SLOPE)
        check_range("roughness_factor", self.roughness_factor, 0.0, 1.0)
        check_range("f0", self.f0, 0.0, 0.999)
        check_range("ks", self.ks, 0.0, MAX_WEIGHT)
        check_range("kd", self.kd, 0.0, MAX_WEIGHT)
        for name in ("albedo_map", "normal_map", "roughness_map", "specular_map", "occlusion_map"):
            value = getattr(self, name)
            if value is not None and not isinstance(value, Texture):
                raise InputError(f"{name} = {value!r}: give facerender.Texture.open(FILE) or None")

    @cached_property
    def slopes(self) -> tuple[float, float]:
        """The smallest and largest m, of the roughness map if there is one, which is then
        decoded."""
        if self.roughness_map is None or self.property_map is None:
            return self.m, self.m
        roughness = self.property_map.levels("data").result()[0][..., 1]
        ends = (
            self.roughness_factor * float(end) / 255.0
            for end in (np.min(roughness), np.max(roughness))
        )
        low, high = (max(end**2, MIN_SLOPE) for end in ends)
        return low, high

    @cached_property
    def property_map(self) -> Texture | None:
        """Occlusion, roughness and specular weight as one texture, so that one fetch serves."""
        maps = (self.occlusion_map, self.roughness_map, self.specular_map)
        return pack(*maps) if any(maps) else None


@dataclass(frozen=True)
class Scene:
    """A mesh under lights before a camera.

    Parameters
    ----------
    mesh : from :func:`facerender.load_mesh`
    camera, lights : see there
    ambient : irradiance from everywhere, one number or linear RGB
    background : linear RGB behind the mesh, or None for transparent
    """

    mesh: Mesh
    camera: Camera = Camera()
    lights: tuple[Light, ...] = (LIGHTS["key"], LIGHTS["rim"], LIGHTS["fill"])
    ambient: float | Vector = (0.26, 0.28, 0.31)
    background: Vector | None = (0.012, 0.013, 0.016)

    def __post_init__(self) -> None:
        object.__setattr__(self, "lights", tuple(self.lights))
        object.__setattr__(self, "ambient", _non_negative("ambient", self.ambient))
        if self.background is not None:
            background = _non_negative("background", self.background)
            object.__setattr__(self, "background", background)


def turntable(camera: Camera = Camera(), count: int = 8) -> tuple[Camera, ...]:
    """Return cameras all around, beginning with this one, at its elevation."""
    turns = (camera.azimuth + 360.0 * turn / count for turn in range(count))
    return tuple(replace(camera, azimuth=azimuth, position=None) for azimuth in turns)


def slope_ranges(scene: Scene) -> list[tuple[float, float]]:
    """Return the smallest and the largest m of each part; without texture coordinates no map
    counts."""
    parts = zip(scene.mesh.parts, scene.mesh.materials, strict=True)
    return [(at.m, at.m) if part.uv is None else at.slopes for part, at in parts]


def point_lights(scene: Scene) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return positions and intensities of the point lights in the renderer's space, (3,) each.

    The intensity is the irradiance that the light gives at the mesh's centre, times the square of
    its distance from there.

    Raises
    ------
    InputError : a light stands at the centre itself
    """
    result = []
    for light in scene.lights:
        if light.position is None:
            continue
        position = scene.mesh.normalised(light.position)
        distance2 = float(position @ position)
        if distance2 < 1e-12:
            raise InputError(f"point light {light.position} is at the mesh's centre; move it")
        result.append((position, np.asarray(light.irradiance) * distance2))
    return result


@dataclass(frozen=True)
class View:
    """A camera in the renderer's space, where the mesh's bounding sphere is the unit sphere.

    Attributes
    ----------
    eye : (3,) float64
    forward : (3,) float64, unit vector of the viewing direction
    matrix : (4, 4) float64, view times projection for row vectors, as pyrr has it; image row 0 is
        on top, that is at clip y = -1, so that a framebuffer is read in the order of image rows
    """

    eye: NDArray[np.float64]
    forward: NDArray[np.float64]
    matrix: NDArray[np.float64]


def view_of(scene: Scene, aspect: float) -> View:
    """Place the camera of a scene for images of the given aspect ratio, width over height.

    Raises
    ------
    InputError : the eye stands at the target
    """
    from pyrr import matrix44

    mesh, camera = scene.mesh, scene.camera
    target = np.zeros(3)
    if camera.target is not None:
        target = mesh.normalised(camera.target)
    if camera.position is None:
        distance = _framing_distance(mesh, camera.elevation, camera.fov, aspect) / camera.zoom
        eye = target + distance * _direction(camera.azimuth, camera.elevation)
    else:
        eye = mesh.normalised(camera.position)
    gaze = target - eye
    distance = float(np.linalg.norm(gaze))
    if distance < 1e-6:
        raise InputError(f"camera position {camera.position} is at its target; move one of them")
    forward = gaze / distance
    up = np.array([0.0, 1.0, 0.0])
    if abs(forward[1]) > 0.9999:  # seen from above, the back of the head is on top
        up = -_direction(camera.azimuth, 0.0) * np.sign(-forward[1])
    depth = float(eye @ -forward)  # of the mesh's centre
    far = max(depth + 1.0, 0.02)
    near = max(depth - 1.0, far * 1e-3)
    projection = matrix44.create_perspective_projection(camera.fov, aspect, near, far)
    projection[:, 1] *= -1.0
    return View(eye, forward, matrix44.create_look_at(eye, target, up) @ projection)


def _framing_distance(mesh: Mesh, elevation: float, fov: float, aspect: float) -> float:
    """Distance at which every vertex, turned to any azimuth, lies inside the view, with a margin.

    A vertex at height y and distance r from the axis runs through a circle; each bound below is
    the largest value on that circle of what must stay under the distance.
    """
    r, y = mesh.profile.T
    sine, cosine = math.sin(math.radians(elevation)), math.cos(math.radians(elevation))
    vertical = math.tan(math.radians(fov) / 2.0)
    horizontal = vertical * aspect
    top = y * (sine + cosine / vertical) + r * abs(cosine - sine / vertical)
    bottom = y * (sine - cosine / vertical) + r * abs(cosine + sine / vertical)
    side = y * sine + r * math.hypot(1.0 / horizontal, cosine)
    return 1.04 * float(max(top.max(), bottom.max(), side.max()))


def load_scene(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read camera, lights, ambient, background and material from a TOML file.

    Returns
    -------
    dict with any of: camera (Camera), cameras (tuple of Camera, a path for ``facerender plan``),
    lights (tuple of Light), ambient, background, material (dict of the factors of
    :class:`Material`), shading (dict for :meth:`Shading.from_dict`)

    Raises
    ------
    InputError : the file cannot be read, or has an unknown key or a value outside its domain
    """
    name = Path(path).name
    try:
        tables = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"cannot read {path}: {reason(error)}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{name} is not TOML: {error}") from None

    scene: dict[str, Any] = {}
    for key, value in tables.items():
        try:
            if key == "camera":
                scene[key] = _from_table(Camera, key, value)
            elif key == "lights":
                if not isinstance(value, list):
                    raise InputError(f"lights = {value!r}: give a list of names or tables")
                scene[key] = tuple(
                    parse_light(item) if isinstance(item, str) else _from_table(Light, key, item)
                    for item in value
                )
            elif key == "cameras":
                if not isinstance(value, list) or not value:
                    raise InputError(f"cameras = {value!r}: give a list of tables")
                scene[key] = tuple(_from_table(Camera, key, item) for item in value)
            elif key == "shading":
                Shading.from_dict(value)  # validates
                scene[key] = value
            elif key == "material":
                _from_table(Material, key, value)  # validates
                scene[key] = value
            elif key in ("ambient", "background"):
                transparent = key == "background" and value == "none"
                scene[key] = None if transparent else _vector(key, value)
            else:
                raise InputError(
                    f"unknown key {key!r}; known: camera, cameras, lights, material, shading, "
                    "ambient, background"
                )
        except InputError as error:
            raise InputError(f"{name}: {error}") from None
    return scene


def scene_toml(scene: Scene, shading: Shading) -> str:
    """Return the text of a TOML file that :func:`load_scene` reads: camera, lights, ambient,
    background, shading, and the factors of the material that all parts share. Mesh and maps are not
    in it."""
    background = "none" if scene.background is None else scene.background
    dark: dict[str, Any] = {} if scene.lights else {"lights": []}
    tables: list[tuple[str, Mapping[str, Any]]] = [
        ("", {"ambient": scene.ambient, "background": background} | dark),
        ("[camera]", _changed(scene.camera)),
        *(("[[lights]]", _changed(light)) for light in scene.lights),
        ("[material]", _shared_factors(scene.mesh.materials)),
        ("[shading]", shading.as_dict()),
    ]
    blocks = []
    for head, table in tables:
        lines = [f"{key} = {_toml(value)}" for key, value in table.items() if value is not None]
        blocks.append("\n".join(filter(None, [head, *lines])) + "\n")
    return "\n".join(blocks)


def _changed(value: Camera | Light) -> dict[str, Any]:
    """The fields that are not the default."""
    return {
        each.name: getattr(value, each.name)
        for each in fields(value)
        if getattr(value, each.name) != each.default
    }


def _shared_factors(materials: Sequence[Material]) -> dict[str, Any]:
    names = [each.name for each in fields(Material) if not each.name.endswith("_map")]
    mapped = any(each.roughness_map is not None for each in materials)
    names.remove("m" if mapped else "roughness_factor")
    values = {name: {getattr(each, name) for each in materials} for name in names}
    return {name: found.pop() for name, found in values.items() if len(found) == 1}


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return json.dumps(value)
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {_toml(item)}" for key, item in value.items()) + " }"
    if isinstance(value, tuple | list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return repr(value.item() if isinstance(value, np.generic) else value)


def _from_table(kind: type[Any], key: str, table: Any) -> Any:
    known = [each.name for each in fields(kind) if not each.name.endswith("_map")]
    if not isinstance(table, dict) or (unknown := set(table) - set(known)):
        what = f"key {sorted(unknown)[0]!r}" if isinstance(table, dict) else f"value {table!r}"
        raise InputError(f"unknown {what} in {key}; known: {', '.join(known)}")
    return kind(**table)
