"""The names and fields of Python, scene files and the command line, side by side."""

from __future__ import annotations

from argparse import Action
from collections.abc import Mapping
from dataclasses import fields
from functools import cache

from facerender.commands import parser_of
from facerender.commands.output import commands_of, groups_of
from facerender.loading import MeshFile
from facerender.material import MAPS, PRESETS, Material
from facerender.scene.camera import AZIMUTHS_BY_NAME, FRAMES, STANDARD_ANGLES, Camera
from facerender.scene.environment import STUDIO, EnvironmentFile
from facerender.scene.job import ImageSettings
from facerender.scene.light import LIGHTS, RIGS, Light
from facerender.scene.pose import Pose
from facerender.scene.scene import ONLY, Scene
from facerender.scene.shading import DIFFUSE, OUTSIDE, Shading
from facerender.terms.lobe import LOBES
from facerender.terms.model import FRESNEL, MASKING, MODELS
from facerender.terms.transport import PROFILES
from tools.docs.tables import markdown_table

KINDS: tuple[type, ...] = (
    *(Scene, Camera, Light, EnvironmentFile, Material, Shading, Pose, ImageSettings),
    *(MeshFile,),
)
# Options of ``facerender render`` that are no values of an image: files and messages.
OF_THE_COMMAND = {
    *("--help", "--output", "--scene", "--format", "--json", "--quiet", "--verbose"),
}
# Keys of a scene file, and options, that hold the fields of a class.
_TABLES: Mapping[type, str] = {
    Camera: "[camera]",
    Light: "[[lights]]",
    EnvironmentFile: "[environment]",
    Material: "[material]",
    Shading: "[shading]",
    Pose: "[pose]",
    ImageSettings: "[image]",
}
_MAPS = {(Material, name) for name in MAPS}
_PLACE = "--camera AZIMUTH,ELEVATION,ZOOM"
_FILE = "--camera FILE"
_OPTIONS: Mapping[type, Mapping[str, str]] = {
    Scene: {
        **{"mesh": "MESH", "lights": "--light LIGHT, --lights RIG", "before": "--only motion"},
        "anonymous": "--anonymous --id ID",
    },
    Camera: {
        **dict.fromkeys(("azimuth", "elevation", "zoom"), _PLACE),
        **dict.fromkeys(("extrinsics", "intrinsics", "size", "distortion", "position"), _FILE),
        "view_height": "--mm-per-pixel MM",
        "target": "--target X,Y,Z",
    },
    Light: {
        **dict.fromkeys(("azimuth", "elevation"), "--light AZIMUTH,ELEVATION"),
        "irradiance": "--light AZIMUTH,ELEVATION,IRRADIANCE",
        "position": "--light point:X,Y,Z",
        "radius": "--light ...,radius=DEGREES",
        "shadow": "--light ...,no-shadow, --shadows, --no-shadows",
        "follow": "--light ...,follow",
    },
    EnvironmentFile: {
        "file": "--environment FILE",
        "rotation": "--environment FILE,ROTATION",
        "scale": "--environment FILE,ROTATION,SCALE",
    },
    Pose: {
        "weights": "--weight NAME=WEIGHT",
        "frame": "--vertices FILE,FRAME",
        "joints": "--joint NAME=X,Y,Z",
    },
    MeshFile: {"path": "MESH"},
    Shading: dict.fromkeys(
        ("m", "small_slope", "ks", "normal_map", "ambient", "environment", "lights"), ""
    ),
    Material: {"albedo": "--part NAME,albedo=R,G,B", "albedo_map": "--albedo FILE"},
}
_CALLS: Mapping[tuple[type, str], str] = {
    (MeshFile, "path"): "fr.load_mesh(FILE)",
    (MeshFile, "triangles"): "fr.simplified(mesh, triangles)",
    (MeshFile, "occlusion"): "fr.with_occlusion(mesh)",
}
# Arguments without a field of their own: Python, scene file, option.
_OTHERS = (
    ("mesh.with_material(PART, ...)", "[parts.PART]", "--part NAME,FACTOR=VALUE"),
    ("fr.turntable(count=..., arc=...)", "", "--camera turntable:N,FROM..TO"),
    ("fr.load_cameras(FILE)", "[[cameras]]", "--camera FILE"),
    ("renderer.render(scene, only=...)", "", "--only NAME"),
    ("fr.plan(scene, budget, within=...)", "[planned]", "--budget ERROR, --within FRACTION"),
    ("fr.Renderer(backend=...)", "", "--backend NAME"),
    ("fr.Renderer(memory=...)", "", "--memory MIB"),
    ("frame.save(FILE, exposure=...)", "", "--exposure STOPS"),
    ("frame.save(FILE, tone=...)", "", "--tone NAME"),
    ("frame.save(FILE, bits=...)", "", "--bits N"),
    ("frame.save(FILE, dpi=...)", "", "--dpi N"),
    ("frame.save(FILE, scale_bar=...)", "", "--scale-bar"),
    ("fr.save_animation(FILE, images, fps=...)", "", "--fps N"),
    ("fr.load_mesh(FILE, cache=...)", "", "--no-cache"),
    ("fr.sheet(frames)", "", "--sheet"),
)


def blocks() -> dict[str, str]:
    return {"names": _names(), "fields": _fields()}


def _names() -> str:
    """Return a table: the values that have a name, and the places that accept the name."""
    rows = (
        (
            "camera",
            (*AZIMUTHS_BY_NAME, *STANDARD_ANGLES),
            'fr.Scene(camera="NAME")',
            'camera = "NAME"',
            "--camera",
        ),
        ("light", LIGHTS, 'fr.Scene(lights=("NAME",))', 'lights = ["NAME"]', "--light"),
        ("rig", RIGS, 'fr.Scene(lights="NAME")', 'lights = "NAME"', "--lights"),
        ("environment", [STUDIO], *_everywhere("fr.Scene", "environment")),
        ("background", ["none", "environment"], *_everywhere("fr.Scene", "background")),
        ("frame", FRAMES, *_everywhere("fr.Camera", "frame", "camera")),
        ("preset", PRESETS, 'mesh.with_material(PART, "NAME")', *_preset()),
        ("model", MODELS, *_everywhere("fr.Shading", "model", "shading")),
        ("lobe", LOBES, *_everywhere("fr.Shading", "lobe", "shading")),
        ("Fresnel term", FRESNEL, *_everywhere("fr.Shading", "fresnel", "shading")),
        ("masking term", MASKING, *_everywhere("fr.Shading", "masking", "shading")),
        ("diffuse term", DIFFUSE, *_everywhere("fr.Shading", "diffuse", "shading")),
        ("outside", OUTSIDE, *_everywhere("fr.Shading", "outside", "shading")),
        ("scattering", [*PROFILES, "none"], *_everywhere("fr.Material", "scattering", "material")),
        ("term or data", ONLY, 'renderer.render(scene, only="NAME")', "", "--only"),
    )
    head = ("value", "names", "Python", "scene file", "option")
    return markdown_table(
        head,
        [
            [what, ", ".join(map(_code, names)), *map(_code, (python, file, option))]
            for what, names, python, file, option in rows
        ],
    )


def _everywhere(owner: str, name: str, table: str = "") -> tuple[str, str, str]:
    key = f"{table}.{name}" if table else name
    return f'{owner}({name}="NAME")', f'{key} = "NAME"', f"--{name}"


def _preset() -> tuple[str, str]:
    return 'parts.PART.preset = "NAME"', "--part PART=NAME"


def _fields() -> str:
    """Return a table: each field of the public classes, and the places that accept it."""
    options = _options()
    rows = [
        (python(kind, each.name), _key(kind, each.name), _option(kind, each.name))
        for kind in KINDS
        for each in fields(kind)
    ]
    rows = [(own, key, options.get(option, option)) for own, key, option in rows]
    return markdown_table(
        ("Python", "scene file", "option"), [[*map(_code, row)] for row in (*rows, *_OTHERS)]
    )


def python(kind: type, name: str) -> str:
    """Return the Python expression that sets a field."""
    if (kind, name) in _CALLS:
        return _CALLS[kind, name]
    owner = {ImageSettings: "Renderer", MeshFile: "load_mesh"}.get(kind, kind.__name__)
    return f"fr.{owner}({name}=...)"


def _key(kind: type, name: str) -> str:
    if kind is Scene:
        return {"mesh": "", "camera": "[camera]", "lights": "[[lights]]", "before": "[before]"}.get(
            name, name
        )
    return f"{_TABLES[kind]} {name}" if kind in _TABLES and (kind, name) not in _MAPS else ""


def _option(kind: type, name: str) -> str:
    """Return the option for a field, or "" if there is none."""
    if (own := _OPTIONS.get(kind, {}).get(name)) is not None:
        return own
    option = f"--{name.replace('_', '-')}"
    if kind is Material and option not in _options():
        return "" if (kind, name) in _MAPS else f"--part NAME,{name}=VALUE"
    return option if option in _options() else ""


@cache
def _options() -> dict[str, str]:
    """Return the options of ``facerender render``, each with its value."""
    return {
        name: f"{name} {_metavar(action)}".strip()
        for _, actions in groups_of(commands_of(parser_of(["render"]))["render"])
        for action in actions
        for name in action.option_strings
        if name not in OF_THE_COMMAND
    }


def _metavar(action: Action) -> str:
    if action.nargs == 0:
        return ""
    return str(action.metavar or ("NAME" if action.choices else action.dest.upper()))


def _code(text: str) -> str:
    return f"`{text}`".replace("|", r"\|") if text else "–"
