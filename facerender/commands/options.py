"""Options of the commands. An option that sets a field of a record takes its text, range, unit and
default from the field, so that options, docstrings and checks cannot disagree. The value is checked
by the record that the options become part of, see ``scene.py``."""

from __future__ import annotations

import argparse
import os
import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from facerender.commands.output import Help, print_message
from facerender.errors import InputError, quoted
from facerender.loading import MeshFile
from facerender.loading.source import FORMATS, named_files
from facerender.material import PRESETS, Material
from facerender.scene.camera import ORBITS, Camera
from facerender.scene.environment import STUDIO, EnvironmentFile
from facerender.scene.job import ImageSettings, Output
from facerender.scene.light import LIGHTS, RIGS, Light
from facerender.scene.pose import Pose
from facerender.scene.scene import Scene
from facerender.scene.shading import Shading
from facerender.system.files import check_writable, remove_abandoned
from facerender.system.process import Bar
from facerender.values import fields
from facerender.values.vectors import MILLIMETRES, ROTATIONS, SHAPE_WEIGHTS

WHERE = (
    f"{ORBITS}, where AZIMUTH may be a name; standard, for all seven standard views, frontal to "
    "superior; turntable[:N[,FROM..TO]], for N views around the mesh (8), or on an arc; "
    "gltf[:NAME], for cameras of the mesh file; or a camera file: .toml with [[cameras]], .json or "
    ".npz with K and [R|t]"
)
SIDE = f"{ImageSettings.size[0]}"  # default of --size
# Options that set fields of records, keyed by the record's key in a job: the record, and its fields
# with the names of the options' values.
FIELDS: dict[str, tuple[Any, str]] = {
    "mesh": (
        MeshFile,
        "albedo=FILE normal_map=FILE specular_map=FILE roughness_map=FILE lobe_map=FILE flip_v "
        "normal_map_y allow_outside parts=NAME,... hide=NAME,... as_is double_sided up "
        "rotate=X,Y,Z millimetres=MM occlusion triangles=N",
    ),
    "material": (
        Material,
        "m=M f0 ks kd second_slope=F lobe_weight=W scattering normal_strength=X",
    ),
    "shading": (
        Shading,
        "model fresnel masking lobe outside scatter_samples=N diffuse slope_filter "
        "environment_samples=N environment_lights=N",
    ),
    "image": (
        ImageSettings,
        "size=N|WxH samples=N anisotropy=N float_albedo full_maps alpha_threshold=ALPHA",
    ),
    "pose": (Pose, "clip=NAME time=SECONDS vertices=FILE[,FRAME] track"),
    "camera": (Camera, "frame fov=DEGREES orthographic target=X,Y,Z"),
    "scene": (Scene, "background=R,G,B|FILE ambient=E"),
    "outputs": (Output, "exposure=STOPS tone only bits=N dpi=N scale_bar"),
}
_BY_NAME = {
    word.partition("=")[0]: (record, word.partition("=")[2])
    for record, words in FIELDS.values()
    for word in words.split()
}


def add_options(command: argparse.ArgumentParser, text: str, **changes: Mapping[str, Any]) -> None:
    """Add options to a command.

    text : lines of three forms; further lines of one entry are indented. ``[TITLE]`` begins or
        continues a group of options. Names without "-" stand for fields in FIELDS and for options
        in SHARED. Others are new options: ``--NAME VALUE | text | default | note``, see
        :class:`Help`, of which default ("off") and note may be left out. An option without VALUE
        and choices is a flag
    changes : for the option NAME, parts of its help (text, unset, note, and limits or
        their text) and arguments of argparse
    """
    # argparse names the group of options without a title "options".
    groups: dict[str, Any] = {"options": command}
    group = groups["options"]
    for line in _lines(text):
        if line.startswith("["):
            title = line[1:-1]
            group = groups.get(title) or groups.setdefault(title, command.add_argument_group(title))
        elif "|" in line:
            _add(group, line, changes)
        else:
            for name in line.split():
                _add(group, SHARED.get(name) or name, changes)


def _lines(text: str) -> list[str]:
    """Return the entries of a text whose further lines are indented."""
    return re.sub(r"\n +", " ", text).strip().split("\n")


def _add(group: Any, line: str, changes: Mapping[str, Mapping[str, Any]]) -> None:
    """Add an option: a line as in :func:`add_options`, or the name of a field."""
    keywords: dict[str, Any] = {}
    if "|" in line:
        names, text, *rest = (part.strip() for part in line.split(" | "))
        unset, note = (*rest, *("off", "")[len(rest) :])
        flags = [word for word in names.split() if word.startswith("-")]
        metavar = names.split()[-1] if len(names.split()) > len(flags) else ""
        name = (flags or [metavar.lower()])[-1].strip("-").replace("-", "_")
        option: dict[str, Any] = {"text": text, "unset": unset, "note": note}
        option |= {"limits": "", "bounds": ""}
    else:
        name, flags, (record, metavar) = line, [f"--{line.replace('_', '-')}"], _BY_NAME[line]
        option = fields.described(record, name)
        limits = option["limits"]
        if limits is fields.SWITCH:
            both = argparse.BooleanOptionalAction
            # None, not False: an option that is not given must not replace the scene file's value.
            keywords = {"default": None, "action": both if option["default"] else "store_true"}
        elif isinstance(limits, fields.Choice) and isinstance(next(iter(limits.names)), int):
            option["bounds"] = " or ".join(option["bounds"].rsplit(", ", 1))
            keywords["type"] = number_parser(True, option["bounds"])
        elif isinstance(limits, fields.Choice):
            keywords["choices"] = tuple(limits.names)
        else:
            metavar = metavar or name.upper()
    for key, value in changes.get(name, {}).items():
        (option if key in ("text", "unset", "note", "limits") else keywords)[key] = value
    limits, bounds = option["limits"], option["bounds"] or str(option["limits"])
    unit = limits.unit if isinstance(limits, fields.Limits) else ""
    has_parts = isinstance(limits, fields.VectorRange | fields.SizeRange)
    if isinstance(limits, fields.Range) and not has_parts:
        keywords["type"] = number_parser(isinstance(limits, fields.IntegerRange), bounds)
    if "choices" in keywords:
        bounds = ""
    elif metavar := keywords.get("metavar", metavar):
        keywords["metavar"] = metavar
    else:
        keywords.setdefault("action", "store_true")
    values = bounds.removesuffix(unit).strip()
    keywords["help"] = Help(option["text"], option["unset"], values, option["note"], unit)
    group.add_argument(*(flags or [name]), **keywords)


def number_parser(whole: bool, values: str) -> Callable[[str], float]:
    """Return a function that parses the number of an option, for argparse. Its message on other
    text states the valid values."""

    def parse(text: str) -> float:
        with suppress(ValueError):
            return int(text) if whole else float(text)
        noun = "a whole number" if whole else "a number"
        raise argparse.ArgumentTypeError(f"{quoted(text)} is not {noun}: give {values}")

    return parse


PARTS = "parts hide part as_is double_sided up rotate"
_LISTED = "the mesh file's | facerender info lists the names"
NEW_FILE = "in the current directory, which must not exist yet"
# Options without a field that several commands have, by name.
SHARED = {
    line.split()[0].strip("-").lower(): line
    for line in _lines(
        f"""
MESH | mesh file: {", ".join([*FORMATS][:-1])} or {[*FORMATS][-1]} | the built-in head
--quiet | print only warnings and errors on standard error
--verbose | log each step and its start time on standard error
--backend | OpenGL backend | auto
--anonymous | leave names of files, parts and cameras, and their paths, out of all output
    | off | Warnings and errors are only counted, since they may contain names
--id ID | text that replaces the name of the mesh with --anonymous | anonymous
--within FRACTION | fraction of each image's covered pixels that must meet the budget | 100%
--part NAME=PRESET | material of some parts; repeat for other parts | the mesh file's
    | Give NAME=PRESET, NAME,FACTOR=VALUE,... or both, such as 'eye*=sclera' or
    'lash*,alpha=blend,opacity=0.8'. Factors are the fields of Material; presets:
    {", ".join(PRESETS)}
--camera CAMERA | camera; repeat for several views | front | Give {WHERE}. Ranges: azimuth
    {fields.range_of(Camera, "azimuth")}, elevation {fields.range_of(Camera, "elevation")}, zoom
    {fields.range_of(Camera, "zoom")}
--weight NAME=WEIGHT | weight of a shape; repeat for others | {_LISTED}
--joint NAME=X,Y,Z | angles of a joint about x, y and z; repeat for others | {_LISTED}
--light LIGHT | light; repeat for several lights | key, rim, fill; none with --environment
    | Give {", ".join(LIGHTS)}, AZIMUTH,ELEVATION[,IRRADIANCE] in degrees, or
    point:X,Y,Z[,IRRADIANCE] in mesh units. IRRADIANCE is E or R,G,B,
    {fields.range_of(Light, "irradiance")}. Append ,radius=DEGREES,
    {fields.range_of(Light, "radius")}, for the angular radius of an area light, ,no-shadow for a
    light without shadows, and ,follow for a light that follows the camera: its angles are then
    relative to the camera's
--lights RIG | named lights: {" or ".join(RIGS)} | as --light
    | softbox has two large soft lights at 45 degrees and a fill light, which follow the camera
--mm-per-pixel MM | side of a pixel of orthographic views | the framed region fits
    | Requires the length of a mesh unit: see --millimetres
--shadows | shadows of all lights and of the environment map | as each light specifies
--environment FILE[,ROTATION[,SCALE]] | environment map: .hdr, .exr, .npy, .npz or {STUDIO} | none
    | ROTATION is {fields.range_of(EnvironmentFile, "rotation")}; SCALE, a factor on the radiance,
    is {fields.range_of(EnvironmentFile, "scale")}. An environment map replaces the default lights
    and the default ambient light. Requires pip install 'facerender[hdr]' for .hdr,
    'facerender[exr]' for .exr
--scene FILE.toml | scene file with camera, lights, material and shading | none
"""
    )
}
# The note of --budget, whose text differs, and --within.
BUDGET = (
    "1/255 is one 8-bit level, 0.5% is relative radiance, '0.02 flip' is the FLIP metric\nwithin"
)
# The options of a scene, without MESH.
SCENE = f"""[reflectance]
model fresnel masking m f0 ks diffuse kd slope_filter second_slope lobe_weight scattering
scatter_samples
[maps, which replace the maps of the skin]
albedo normal_map specular_map roughness_map lobe_map flip_v normal_map_y
normal_strength allow_outside anisotropy float_albedo full_maps
[scene]
{PARTS} millimetres camera frame fov orthographic
weight joint clip time vertices track light lights shadows environment
environment_samples environment_lights ambient occlusion background scene
"""
# Changes of :func:`add_options` for --backend, and for the options of a scene.
BACKEND: dict[str, Any] = {
    "default": "auto",
    "note": "auto tries egl, then osmesa; on Windows and macOS, auto is native (WGL, CGL). On "
    "Linux, native is GLX, which requires an X server. current is the OpenGL context of the "
    "calling program",
}
_APPENDED = {"action": "append"}
SCENE_CHANGES: dict[str, dict[str, Any]] = {
    "mesh": {"nargs": "?"},
    **dict.fromkeys(("part", "camera", "light"), _APPENDED),
    "weight": _APPENDED | {"limits": str(SHAPE_WEIGHTS)},
    "joint": _APPENDED | {"limits": ROTATIONS},
    "shadows": {"action": argparse.BooleanOptionalAction},
    "lights": {"choices": tuple(RIGS)},
    "mm_per_pixel": {"limits": MILLIMETRES},
    "time": {"unset": "the whole clip"},
    "vertices": {"text": "vertex positions, all frames or one"},
    "m": {
        "note": "Replaces the roughness map. Like other factors and maps, it applies only to skin: "
        "to no part that transmits light or has a name of eyes, lashes, teeth or hair. If no part "
        "is skin, it applies to all. facerender info lists the skin; --part changes any part"
    },
    "ks": {"note": ""},
    "lobe_weight": {"note": ""},
    "within": {"limits": "above 0, at most 1 or 100%"},
    "scattering": {
        "note": "Requires the length of a mesh unit: see --millimetres",
        "choices": ("skin", "none"),
    },
}


def step_log(options: argparse.Namespace) -> Callable[[str], None]:
    """Return a function that logs a step, but only with --verbose."""
    if options.quiet and options.verbose:
        raise InputError("--quiet and --verbose exclude each other: leave one of them out")
    began = time.monotonic()

    def log(step: str) -> None:
        if options.verbose:
            print_message(f"facerender: {time.monotonic() - began:.2f} s: {step}")

    return log


def progress_bar(options: argparse.Namespace) -> Bar:
    """Return a progress bar, or a log of the steps if --verbose is given."""
    log = step_log(options)
    return Bar(options.quiet, log if options.verbose else None)


def check_outputs(
    written: Iterable[str | Path | None],
    read: Iterable[str | Path | None] = (),
    default: str | None = None,
) -> None:
    """Check the output files of a command before it starts to work. Raise InputError if an output
    file cannot be written, appears twice, or is also an input file, for example through a link.

    written : output files; None is ignored
    read : input files; the iterable is used only if an output file already exists
    default : name of the output without -o, which replaces no file; None with -o
    """
    paths = [path for path in written if path]
    if default and (existing := [*filter(os.path.lexists, paths)]):
        raise InputError(f"{existing[0]} exists: give -o {default} to replace it, or another name")
    names: dict[object, str | Path] = {}
    for name in paths:
        check_writable(name)
        if (identity := _identity(name)) in names:
            raise InputError(f"{name} is written twice: give another name")
        names[identity] = name
    # A killed command leaves files of other names than the outputs, which nobody else would delete.
    for folder in {Path(name).parent for name in names.values()}:
        remove_abandoned(folder)
    if not (replaceable := {key: name for key, name in names.items() if os.path.exists(name)}):
        return
    for path in read:
        if path and (replaced := replaceable.get(_identity(path))):
            raise InputError(f"{replaced} is both input and output: give another output file")


def _identity(name: str | Path) -> object:
    """Return a value that is equal for all paths of one file."""
    try:
        status = os.stat(name)
        return status.st_dev, status.st_ino
    except (OSError, ValueError):  # no such file yet
        return os.path.realpath(name)


def mesh_files(mesh: MeshFile) -> Iterator[str | Path | None]:
    """Yield the input files of a mesh, and all possible paths of files that its file refers to."""
    yield from mesh.files
    if mesh.path is not None:
        for path in named_files(mesh.source):
            yield from (path, Path(mesh.path).with_name(path.name))
