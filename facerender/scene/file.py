"""Scene files in TOML, which contain neither a mesh nor its maps."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import MISSING, asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from facerender.errors import (
    InputError,
    check_known,
    check_path,
    check_type,
    clipped,
    short_repr,
    shown,
)
from facerender.images.files import MAX_SIDE
from facerender.material import MAPS, PRESETS, Material, preset
from facerender.mesh.mesh import Mesh
from facerender.scene.camera import Camera, camera_of
from facerender.scene.detail import Planned
from facerender.scene.environment import EnvironmentFile, parse_environment
from facerender.scene.light import Light, parse_light
from facerender.scene.scene import Scene, background_of
from facerender.scene.shading import Shading
from facerender.system.files import read_file, tables_of
from facerender.values.ranges import FRACTION, IntegerRange, Range, SizeRange, check_fields, ranged
from facerender.values.vectors import COLORS, ROTATIONS, SHAPE_WEIGHTS, Vector, numbers_in

KEYS = (
    *("camera", "cameras", "lights", "environment", "material", "parts", "shading", "planned"),
    *("ambient", "background", "pose", "before", "image"),
)
MAX_SAMPLES = 64
MOST_BYTES = 1 << 24  # largest size of a scene file, in bytes


@dataclass(frozen=True)
class ImageSettings:
    """Settings of the renderer; parameters as in :class:`facerender.Renderer`, which checks whether
    the driver supports them."""

    size: tuple[int, int] = ranged(SizeRange(1, MAX_SIDE, "pixels"), (1024, 1024))
    samples: int = ranged(IntegerRange(1, MAX_SAMPLES), 4)
    anisotropy: float = ranged(Range(1.0, 16.0), 1.0)
    float_albedo: bool = False
    full_maps: bool = False
    alpha_threshold: float = ranged(FRACTION, 0.5)

    __repr__ = short_repr

    def __post_init__(self) -> None:
        check_fields(self, "image ")


@dataclass(frozen=True)
class Pose:
    """Pose of a mesh. Without values, it is the pose that the mesh file stores.

    Parameters
    ----------
    weights : weight of each shape (morph target) by name; see :meth:`facerender.Mesh.with_pose`
    clip : name of an animation in the mesh file
    time : time in the clip in seconds; default 0
    vertices : path of a file with vertex positions: .npy of shape (frames, vertices, 3), or .npz
        with one such array for each part; see :meth:`facerender.Mesh.with_positions`
    frame : index of the frame in ``vertices``; 0 without vertices
    track : whether the framing follows the head; see :func:`facerender.tracked`
    joints : angles x, y, z in degrees by name of the joint; see :meth:`facerender.Mesh.with_pose`
    """

    weights: Mapping[str, float] = field(default_factory=dict)
    clip: str | None = None
    time: float | None = ranged(Range(0.0, 1e6, "s"), None)
    vertices: str | None = None
    frame: int = ranged(IntegerRange(0, 1 << 30), 0)
    track: bool = False
    joints: Mapping[str, Vector] = field(default_factory=dict)

    __repr__ = short_repr

    def __post_init__(self) -> None:
        tables = ("weights", "shape", SHAPE_WEIGHTS), ("joints", "joint", ROTATIONS)
        for name, noun, limits in tables:
            table = getattr(self, name)
            check_type(f"pose {name}", table, Mapping, f"a table of numbers by {noun} name")
            values = {str(k): limits.check(f"{name[:-1]} {k}", v) for k, v in table.items()}
            object.__setattr__(self, name, values)
        check_type("pose clip", self.clip, str | None, "the name of a clip")
        if self.vertices is not None:
            check_path("pose vertices", self.vertices)
            object.__setattr__(self, "vertices", os.fspath(self.vertices))
            if self.weights or self.joints or self.clip is not None or self.time is not None:
                raise InputError(
                    f"pose vertices = {shown(self.vertices)} exclude weights, joints, clip and "
                    "time: leave one of them out"
                )
        check_fields(self, "pose ")
        if self.frame and self.vertices is None:
            raise InputError(f"pose frame = {self.frame} needs vertices: give the file as well")


# The class of a table, or of each table in a list, and the parser of texts that replace the table.
_CLASSES: dict[str, tuple[type, Callable[[str], Any] | None]] = {
    **dict.fromkeys(("camera", "cameras"), (Camera, camera_of)),
    "lights": (Light, parse_light),
    "environment": (EnvironmentFile, parse_environment),
    **{"planned": (Planned, None), "pose": (Pose, None), "before": (Pose, None)},
}


def load_scene(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read the values of a scene file in TOML.

    Returns
    -------
    dict with the keys that the file contains: camera (Camera), cameras (tuple of Camera, the camera
    path of ``facerender plan``), lights (tuple of Light), environment (EnvironmentFile), ambient
    and background (as in :class:`Scene`), material (dict of the factors of :class:`Material`),
    parts (see :func:`part_tables`), shading (dict for :meth:`Shading.from_dict`), planned,
    pose and before (Planned and Pose), image (dict of the fields of :class:`ImageSettings`).
    Without cameras, they are keyword arguments of :class:`facerender.Job`

    Raises
    ------
    InputError : the file cannot be read, or has an unknown key or a value outside its range
    """
    check_path("scene file", path)
    name = clipped(Path(path).name)
    tables = tables_of(read_file(path, "a scene file", MOST_BYTES), name)
    try:
        return {key: scene_value(key, value) for key, value in tables.items()}
    except InputError as error:
        raise InputError(f"{name}: {error}") from None


def scene_value(key: str, value: Any) -> Any:
    """Convert the TOML value of a key to the type that :func:`load_scene` returns for the key.
    Raises InputError if the key is unknown, or a value is outside its range."""
    check_known("key", key, KEYS)
    if key in ("cameras", "lights"):
        if not isinstance(value, list) or (key == "cameras" and not value):
            raise InputError(f"{key} = {shown(value)}: give a list of names or tables")
        return tuple(_parsed(key, element) for element in value)
    if key == "parts":
        return part_tables(key, value)
    if key == "background":
        return background_of(value)
    if key == "ambient":
        return COLORS.check(key, value)
    if key == "shading":
        Shading.from_dict(value)
    elif key == "material":
        from_table(Material, key, value, without=MAPS)
    elif key == "image":
        from_table(ImageSettings, key, value)
    else:
        return _parsed(key, value)
    return value  # the calls above only check it


def _parsed(key: str, value: Any) -> Any:
    kind, parse = _CLASSES[key]
    return parse(value) if parse and isinstance(value, str) else from_table(kind, key, value)


def parse_vertices(text: str) -> tuple[str, int | None]:
    """Parse a path and the index of a frame from ``FILE[,FRAME]``; without FRAME, None. Raises
    InputError if the path is empty."""
    file, comma, frame = text.rpartition(",")
    if not comma or not frame.isdecimal():
        file, frame = text, ""
    if not file:
        raise InputError(f"--vertices {shown(text)}: give FILE[,FRAME]")
    return file, int(frame[:10]) if frame else None


def parse_entry(option: str, text: str) -> tuple[str, Any]:
    """Parse a name and its values from the text of --weight, ``NAME=WEIGHT``, or of --joint,
    ``NAME=X,Y,Z``. Raises InputError if the text has another form."""
    count, form = {
        "weight": (1, "WEIGHT, such as jawOpen=0.6"),
        "joint": (3, "X,Y,Z, such as head=0,20,0"),
    }[option]
    name, _, words = text.rpartition("=")
    numbers = numbers_in(words.split(","))
    if not name or len(numbers) != count:
        raise InputError(f"--{option} {shown(text)}: give NAME={form}")
    return name, numbers[0] if count == 1 else numbers


def with_tuples(table: Mapping[str, Any]) -> dict[str, Any]:
    """Return a table of factors with tuples instead of lists."""
    return {k: tuple(v) if isinstance(v, list) else v for k, v in table.items()}


def part_tables(name: str, tables: Any) -> dict[str, dict[str, Any]]:
    """Check the materials of parts.

    tables : for each name of parts, which may have wildcards, a table of fields of
        :class:`Material` except its maps, and ``preset``

    Raises InputError for a value of a wrong type, an unknown key or preset, or a value outside its
    range.
    """
    check_type(name, tables, Mapping, "a table of parts, such as {'lash*': {'preset': 'lashes'}}")
    materials = {}
    for pattern, table in tables.items():
        if not isinstance(pattern, str) or not pattern.strip():
            raise InputError(f"{name} has the key {shown(pattern)}: give the name of a part")
        place = f"{name}.{pattern}"
        check_type(place, table, Mapping, "a table of factors, or a preset, such as {'m': 0.3}")
        factors = with_tuples(table)
        overrides = dict(factors)
        base = preset(overrides.pop("preset")) if "preset" in factors else {}
        from_table(Material, place, {**base, **overrides}, without=MAPS)  # only checks the values
        materials[pattern] = factors
    return materials


def parse_part(text: str) -> tuple[str, dict[str, Any]]:
    """Parse the material of parts from the text ``NAME=PRESET``, ``NAME,FIELD=VALUE,...`` or
    ``NAME=PRESET,FIELD=VALUE,...``. A colour is three numbers with commas. Raises InputError if the
    text has another form, or a value is outside its range."""
    first, *words = re.split(",(?=[^,]*=)", text)
    pattern, _, preset = first.partition("=")
    if not pattern or "," in first or not (preset or words):
        raise InputError(
            f"--part {shown(text)}: give NAME=PRESET or NAME,FIELD=VALUE, such as 'eye*=sclera' or "
            f"'lash*,opacity=0.8'; presets: {', '.join(PRESETS)}"
        )
    table: dict[str, Any] = {"preset": preset} if preset else {}
    for word in words:
        field, _, value = word.partition("=")
        table[field.strip()] = _value(value.split(","))
    return pattern, part_tables("--part", {pattern: table})[pattern]


def _value(words: list[str]) -> Any:
    if words in (["true"], ["false"]):
        return words == ["true"]
    if not (numbers := tuple(numbers_in(words))):
        return ",".join(words)
    return numbers if len(numbers) > 1 else numbers[0]


def part_text(pattern: str, table: Mapping[str, Any]) -> str:
    """Return the text of the materials of parts that :func:`parse_part` parses."""
    factors = dict(table)
    preset = f"={factors.pop('preset')}" if "preset" in factors else ""
    words = [
        f"{name}={','.join(f'{number:g}' for number in value)}"
        if isinstance(value, tuple | list)
        else f"{name}={str(value).lower() if isinstance(value, bool) else value}"
        for name, value in factors.items()
    ]
    return ",".join([f"{pattern}{preset}", *words])


def scene_toml(scene: Scene, shading: Shading, planned: Planned | None = None) -> str:
    """Return a scene, without its mesh and maps, as TOML text that :func:`load_scene` parses.

    The table ``material`` contains the factors that are equal for all parts of the skin, the table
    ``parts`` the other factors of each part. The table ``planned`` contains the fields of
    :class:`Planned`.
    """
    source = scene.environment
    materials = [scene.mesh.materials[i] for i in scene.mesh.skin]
    values = ((name, {getattr(m, name) for m in materials}) for name in _factor_names(*materials))
    shared = {name: several.pop() for name, several in values if len(several) == 1}
    tables = {
        "ambient": scene.ambient,
        "background": "none" if scene.background is None else scene.background,
        "camera": _changes(scene.camera),
        "lights": [*map(_changes, scene.lights)],
        "environment": source
        and {"file": source.panorama.name, "rotation": source.rotation, "scale": source.scale},
        "material": shared,
        "parts": _differing_factors(scene.mesh, shared) or None,
        "shading": shading.as_dict(),
        "planned": planned and asdict(planned),
    }
    return toml_text(tables)


def toml_text(values: Mapping[str, Any]) -> str:
    """Return TOML text for values, tables of values, and lists of such tables. Keys whose value is
    None are omitted."""
    tables: list[tuple[str, Mapping[str, Any]]] = []
    plain = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            tables.append((f"[{key}]", value))
        elif isinstance(value, list) and value:
            tables += [(f"[[{key}]]", table) for table in value]
        else:
            plain[key] = value
    blocks = []
    for head, table in [*([("", plain)] if plain else []), *tables]:
        entries = {key: value for key, value in table.items() if value is not None}
        lines = [f"{_key(key)} = {_toml(value)}" for key, value in entries.items()]
        blocks.append("\n".join(filter(None, [head, *lines])) + "\n")
    return "\n".join(blocks)


def _changes(instance: Camera | Light) -> dict[str, Any]:
    """Return the fields of a camera or light that differ from their defaults."""
    values = ((member, getattr(instance, member.name)) for member in fields(instance))
    return {member.name: value for member, value in values if value != member.default}


def _factor_names(*materials: Material) -> list[str]:
    """Return the names of the factors that have an effect on some of the materials."""
    mapped = any(material.roughness_map is not None for material in materials)
    unused = (*MAPS, "m" if mapped else "roughness_factor")
    return [member.name for member in fields(Material) if member.name not in unused]


def _differing_factors(mesh: Mesh, shared: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return, for each named part, its factors, without the ``shared`` factors of the skin."""
    tables: dict[str, dict[str, Any]] = {}
    for number, (part, material) in enumerate(zip(mesh.parts, mesh.materials, strict=True)):
        omitted = shared if number in mesh.skin else ()
        names = [name for name in _factor_names(material) if name not in omitted]
        if names and part.name:
            values = {name: getattr(material, name) for name in names}
            tables[part.name] = {n: "none" if v is None else v for n, v in values.items()}
    return tables


def _key(name: str) -> str:
    """Return a key of TOML, in quotes unless its characters need none."""
    return name if re.fullmatch("[A-Za-z0-9_-]+", name) else json.dumps(name, ensure_ascii=False)


def _toml(value: Any) -> str:
    if isinstance(value, bool | str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, Mapping):
        pairs = (f"{_key(key)} = {_toml(entry)}" for key, entry in value.items())
        return "{ " + ", ".join(pairs) + " }"
    if isinstance(value, tuple | list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return repr(value.item() if isinstance(value, np.generic) else value)


def from_table(kind: type[Any], key: str, table: Any, without: Collection[str] = ()) -> Any:
    """Create an instance of a dataclass from the values of a TOML table, which must not contain the
    fields ``without``. Raises InputError if the value is no table, a key is unknown or missing, or
    a value is out of range."""
    names = [member.name for member in fields(kind) if member.name not in without]
    if not isinstance(table, Mapping) or (unknown := [name for name in table if name not in names]):
        bad = f"key {shown(unknown[0])}" if isinstance(table, Mapping) else f"value {shown(table)}"
        raise InputError(f"unknown {bad} in {key}; known: {', '.join(names)}")
    needed = [f.name for f in fields(kind) if f.default is f.default_factory is MISSING]
    if lacking := [name for name in needed if name not in table]:
        raise InputError(f"{key} {shown(dict(table))} lacks {lacking[0]}: add it")
    return kind(**table)
