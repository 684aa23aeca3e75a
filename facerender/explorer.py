"""The explorer: one page that draws a mesh in WebGL 2 with the library's own shaders. The mesh, its
maps, the shaders and the registry become the page's data here; what it does with them is told in
``page/explorer``. No OpenGL here."""

from __future__ import annotations

import json
import shlex
import zlib
from base64 import b64encode
from collections.abc import Mapping
from dataclasses import replace
from html import escape
from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from facerender import __version__
from facerender.drawing.prepare import part_maps
from facerender.drawing.program import part_uniforms, surface_features
from facerender.errors import warn
from facerender.glsl.library import TARGETS, shader_dir, shader_source
from facerender.job import Job
from facerender.page.document import document, file_text
from facerender.pricing.shown import shown_prices, six_digits
from facerender.pricing.table import FAMILY_NAMES, shipped
from facerender.scenes.light import LIGHT_KINDS, Light
from facerender.scenes.material import MAPS
from facerender.scenes.mesh import Mesh, drawn_alpha, slope_range
from facerender.scenes.mips import Kind
from facerender.scenes.texture import Texture
from facerender.shading import FRONTAL, MAX_WEIGHT, SMALL_SLOPE, Shading
from facerender.terms import FRESNEL, LOBES, MASKING, MODELS, GPower, lobe_entry
from facerender.terms.lobe import MAX_SLOPE, MIN_SLOPE, Lobe

if TYPE_CHECKING:
    from facerender.planning.decisions import Decision
    from facerender.planning.plan import Plan

POSITION_STEPS = 2**16 - 1  # across the bounding sphere: 2.6 micrometres on a head
NORMAL_STEPS = 2**15 - 1  # of an octahedron's coordinate: 0.003 degrees
UV_STEPS = 2**16 - 1
LARGEST_MAP = 2048  # texels a side, which every WebGL 2 takes
QUALITIES: dict[Kind, tuple[int, ...]] = {
    "color": (93, 97),
    "normal": (95, 98),
    "data": (93, 97),
}
LEAST_LOSS = 1.0  # steps of 255 in the mean, below which a map may be a JPEG

# What the page draws of a plan, by where a shading has it: the field of the page's terms.
_DRAWN = {
    "term.model": "model",
    "term.lobe": "lobe",
    "term.fresnel": "fresnel",
    "term.masking": "masking",
    "term.small_slope": "small",
    "term.m": "constant",
    "ks": "weight",
    "normal_map": "normal",
    "ambient": "ambient",
    "specular_lights": "dark",
    "frontal_lights": "frontal",
}

_SCRIPTS = (
    *("numbers", "data", "camera", "glsl", "gl", "drawing", "errors", "state"),
    *("controls", "plan", "lobe", "prices", "cost", "code", "explorer"),
)
_SHADERS = ("level.frag", "error.glsl", "error.frag", "show.frag", "lobe.frag")
_HOST = ("shade.frag", "gbuffer.frag", "surface.vert", "screen.vert")


def explorer(job: Job, mesh: Mesh, planned: Plan | None = None) -> str:
    """Return the page. What it cannot draw is left out: see :func:`plain`.

    Parameters
    ----------
    job : its mesh file, lights, ambient light, background and camera are what the page begins with
    mesh : of the job
    planned : for its scene, and the default shading as the full one; its decisions become switches

    Raises
    ------
    InputError : a map that is damaged; maps over 2048 texels a side are made smaller
    """
    mesh = plain(mesh)
    columns: list[NDArray[np.int64]] = []
    textures: list[tuple[Texture, Kind]] = []
    parts = [_part(mesh, index, columns, textures) for index in range(len(mesh.parts))]
    table = shipped()
    facts = {
        "version": __version__,
        "name": mesh.name,
        "mesh": _words(job),
        "center": mesh.center.tolist(),
        "radius": mesh.radius,
        "profile": mesh.profile.round(5).tolist(),
        "steps": {"position": POSITION_STEPS, "normal": NORMAL_STEPS, "uv": UV_STEPS},
        "parts": parts,
        "columns": [list(values.shape) for values in columns],
        "maps": [kind for _, kind in textures],
        "camera": {name: getattr(job.camera, name) for name in _ORBIT},
        "lights": [_light(light, mesh) for light in job.lights],
        "ambient": job.ambient,
        "background": job.background or (0.0, 0.0, 0.0),
        "registry": registry(),
        "prices": [
            {"name": FAMILY_NAMES.get(kind, kind), "unit": each.unit, "source": each.source}
            for kind, each in table.items()
        ],
        "targets": TARGETS,
        "plan": None if planned is None else _plan(planned),
    }
    data = [
        _json("facts", facts),
        _bytes("geometry", zlib.compress(b"".join(map(_packed, columns)), 9)),
        _bytes("sources", _deflated(_sources())),
        _bytes("prices", _deflated([shown_prices(each, mesh) for each in table.values()])),
        *(_bytes(f"map-{i}", encoded(*each)) for i, each in enumerate(textures)),
    ]
    body = file_text("explorer/explorer.html") + "".join(data)
    scripts = (f"explorer/{name}.js" for name in _SCRIPTS)
    return document(f"facerender explorer: {mesh.name}", body, "explorer/explorer.css", *scripts)


def plain(mesh: Mesh) -> Mesh:
    """Return a mesh as the page draws it: all parts opaque, but for blended ones, which are left
    out where others stay; no emission, maps as strong as they are, and those alone that lie by the
    first texture coordinates, all of them repeated and smoothed.

    Warns
    -----
    FacerenderWarning : something is left out
    """
    alphas = [*map(drawn_alpha, mesh.parts, mesh.materials)]
    kept = [number for number, alpha in enumerate(alphas) if alpha != "blend"]
    lost = ["blended parts"] * ("blend" in alphas) + ["masks"] * ("mask" in alphas)
    materials = []
    for material in mesh.materials:
        lost += ["emission"] * any(material.emissive)
        second = [name for name in MAPS if material.by_second(name)]
        lost += ["maps by second texture coordinates"] * bool(second)
        default = (material.normal_strength, material.occlusion_strength) == (1.0, 1.0)
        lost += ["strengths of maps"] * (not default)
        maps = {name: getattr(material, name) for name in MAPS if name not in second}
        if not material.packs:
            maps = {name: own and own.sampled(Texture.wrap) for name, own in maps.items()}
        bare = dict.fromkeys((*second, "opacity_map", "emissive_map"))
        further = {"alpha": "opaque", "emissive": 0.0, "second_uv": ()}
        strengths = {"normal_strength": 1.0, "occlusion_strength": 1.0}
        materials.append(replace(material, **{**maps, **bare, **further, **strengths}))
    if lost:
        warn(f"the explorer shows {mesh.name} without {', '.join(dict.fromkeys(lost))}")
    shown = kept or range(len(alphas))
    parts = tuple(mesh.parts[number] for number in shown)
    return replace(mesh, parts=parts, materials=tuple(materials[number] for number in shown))


_ORBIT = ("azimuth", "elevation", "zoom", "fov")


def registry() -> dict[str, Any]:
    """Return every model, lobe, Fresnel and masking term, as data for the page's controls and for
    its programs."""
    own = lobe_entry(GPower(8, 0.25, 0.5))
    return {
        "models": {
            model.name: {
                "title": model.title,
                "k": model.k,
                "factors": model.factors,
                "file": model.file,
                "call": model.call,
            }
            for model in MODELS.values()
        },
        "lobes": {lobe.name: _lobe(lobe) for lobe in LOBES.values()},
        "g_power": _lobe(own),
        "fresnel": {term.name: term.macro for term in FRESNEL.values()},
        "masking": {term.name: term.macro for term in MASKING.values()},
        "frontal": dict(FRONTAL),
        "small_slope": SMALL_SLOPE,
        "slopes": [MIN_SLOPE, MAX_SLOPE],
        "largest_weight": MAX_WEIGHT,
    }


def _lobe(lobe: Lobe) -> dict[str, Any]:
    return {
        "macro": lobe.macro,
        "ends": lobe.ends,
        "open": lobe.open_ends,
        "errors": lobe.errors,
        "colour": lobe.colour,
        "by_angle": lobe.of_tan2 is not None,
    }


def _plan(planned: Plan) -> dict[str, Any]:
    """Return a plan as the page has it: what is said of it, and its decisions."""
    budget = planned.budget
    return {
        "lines": {
            name: planned.lines[name]
            for name in ("budget", "basis", "shading", "error", "cost")
            if name in planned.lines
        },
        "unit": budget.unit,
        "steps": 255.0 * budget.limit if budget.unit == "display" else None,
        "decisions": [_decision(planned, each) for each in planned.decisions],
    }


def _decision(planned: Plan, decision: Decision) -> dict[str, Any]:
    """Return a decision: in words, with the planner's figures; and as fields of the page's terms
    what the cheaper choice sets, what the full shading has there, and what the choice is measured
    with by itself, all None where the page cannot draw it."""
    from facerender.planning.candidates import DECISIONS, values

    cheaper, full = decision.values, values(planned.full, [*DECISIONS])
    lights = len(planned.scene.lights)
    fields: dict[str, Any] = dict.fromkeys(("on", "off", "alone"))
    if cheaper and set(cheaper) <= set(_DRAWN):
        own = _fields(cheaper, lights)
        fitted = "term.lobe" in cheaper  # to the slope that was chosen
        slope = _fields({"term.m": planned.shading.term.m}, lights) if fitted else {}
        fields["on"] = own
        fields["off"] = _fields({path: full[path] for path in cheaper}, lights)
        fields["alone"] = slope | own
    return fields | {
        "name": decision.name,
        "taken": decision.changed,
        "words": decision.chosen if decision.changed else decision.other,
        "saving": decision.saving,
        "loss": decision.error if np.isfinite(decision.error) else None,
    }


def _fields(values: Mapping[str, Any], lights: int) -> dict[str, Any]:
    """Return what a shading has, by where it has it, as fields of the page's terms; numbers of six
    digits, as links have them; lights by index, with commas."""
    fields: dict[str, Any] = {}
    for path, value in values.items():
        if isinstance(value, GPower):
            fields |= {"lobe": "g-power", "g": value.g}
            fields |= {"factor": six_digits(value.factor), "offset": six_digits(value.offset)}
        elif path == "specular_lights":
            dark = [] if value is None else [each for each in range(lights) if each not in value]
            fields["dark"] = ",".join(map(str, dark))
        elif path == "frontal_lights":
            fields["frontal"] = ",".join(map(str, value))
        elif path == "term.small_slope":
            fields["small"] = "plain" if value is False else "exact"
        elif isinstance(value, bool):
            fields[_DRAWN[path]] = "on" if value else "off"
        elif isinstance(value, float):
            fields[_DRAWN[path]] = six_digits(value)
        else:
            fields[_DRAWN[path]] = value
    return fields


def encoded(texture: Texture, kind: Kind) -> bytes:
    """Return a map as the page has it, row 0 at the bottom: a JPEG that is less than one step off
    in the mean, or else a PNG.

    Raises
    ------
    InputError : the map is damaged
    """
    from PIL import Image

    image = texture.rgb()
    if max(image.size) > LARGEST_MAP:
        scale = LARGEST_MAP / max(image.size)
        width, height = (max(round(side * scale), 1) for side in image.size)
        image = image.resize((width, height), Image.Resampling.BOX)
    texels = np.asarray(image).astype(np.int16)
    for quality in QUALITIES[kind]:
        file = BytesIO()
        image.save(file, "JPEG", quality=quality, subsampling=0, optimize=True)
        if np.abs(np.asarray(Image.open(file)) - texels).mean() < LEAST_LOSS:
            return file.getvalue()
    file = BytesIO()
    image.save(file, "PNG", optimize=True)
    return file.getvalue()


def _part(
    mesh: Mesh,
    index: int,
    columns: list[NDArray[np.int64]],
    textures: list[tuple[Texture, Kind]],
) -> dict[str, Any]:
    """Return what the page knows of a part; its arrays and maps are appended to the lists."""
    part, material = mesh.parts[index], mesh.materials[index]
    maps: dict[str, int] = {}
    for name, texture, kind in part_maps(part, material, "color", slope_filter=True):
        if (texture, kind) not in textures:
            textures.append((texture, kind))
        maps[name] = textures.index((texture, kind))
    arrays: dict[str, int] = {}

    def column(name: str, values: NDArray[Any]) -> None:
        arrays[name] = len(columns)
        columns.append(np.round(values).astype(np.int64))

    column("position", (mesh.normalised(part.positions) + 1.0) * (0.5 * POSITION_STEPS))
    column("normal", octahedral(part.normals) * NORMAL_STEPS)
    column("faces", part.faces)
    corner, extent = np.zeros(2), np.ones(2)
    if part.uv is not None:
        corner, extent = part.uv.min(axis=0), np.ptp(part.uv, axis=0).clip(1e-9)
        column("uv", (part.uv - corner) / extent * UV_STEPS)
    if part.colors is not None:
        column("color", part.colors * 1e4)
    if part.occlusion is not None:
        column("occlusion", part.occlusion[:, None] * 1e4)
    given: Mapping[str, Any] = part_uniforms(part, material)
    uniforms = {name: np.asarray(value).tolist() for name, value in given.items()}
    return {
        "features": surface_features(part, material, Shading()),
        "uniforms": uniforms,
        "arrays": arrays,
        "uv": [corner.tolist(), extent.tolist()],
        "maps": maps,
        "slopes": slope_range(part, material),
    }


def octahedral(normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Map unit vectors (N, 3) to a square, (N, 2) in [-1, 1].

    References: Cigolle et al. (2014), "A survey of efficient representations for independent unit
    vectors".
    """
    flat = normals / np.abs(normals).sum(axis=1, keepdims=True)
    low = flat[:, 2] < 0.0
    folded = (1.0 - np.abs(flat[:, 1::-1])) * np.where(flat[:, :2] < 0.0, -1.0, 1.0)
    return np.asarray(np.where(low[:, None], folded, flat[:, :2]))


def _packed(values: NDArray[np.int64]) -> bytes:
    """Return whole numbers (N, K) as what deflate makes short: the differences of rows, signs in
    the lowest bit, byte by byte of their four."""
    steps = np.diff(values, axis=0, prepend=0)
    folded = ((steps << 1) ^ (steps >> 63)).astype("<u4")
    return folded.view(np.uint8).reshape(-1, 4).T.tobytes()


def _sources() -> dict[str, Any]:
    """Return the GLSL that the page's programs are made of, flat, by its role."""
    host = shader_dir() / "host"
    return {
        "models": {name: shader_source(model.file) for name, model in MODELS.items()},
        "variance": shader_source("slope_variance"),
        "host": {name: shader_source(str(host / name)) for name in _HOST},
        "lights": {kind: shader_source(str(host / f"light/{kind}.glsl")) for kind in LIGHT_KINDS},
        "page": {name: file_text(f"explorer/{name}") for name in _SHADERS},
    }


def _light(light: Light, mesh: Mesh) -> dict[str, Any]:
    """Return a light by its direction from the mesh's centre; of a point light with its distance
    there, in the renderer's space."""
    azimuth, elevation, distance = light.azimuth, light.elevation, None
    if light.position is not None:
        x, y, z = mesh.normalised(light.position)
        distance = float(np.linalg.norm((x, y, z)))
        azimuth = float(np.degrees(np.arctan2(x, z)))
        elevation = float(np.degrees(np.arcsin(y / max(distance, 1e-30))))
    return {
        "azimuth": azimuth,
        "elevation": elevation,
        "irradiance": light.irradiance,
        "radius": light.radius,
        "distance": distance,
    }


def _words(job: Job) -> dict[str, Any]:
    """Return the mesh's files as the command line and Python say them."""
    file = job.mesh
    maps = ("albedo", "normal_map", "specular_map", "roughness_map")
    given = {name: value for name in maps if (value := getattr(file, name)) is not None}
    words = [shlex.quote(file.path)] if file.path else []
    options = {
        name: f"--{name.replace('_', '-')} {shlex.quote(value)}" for name, value in given.items()
    }
    words += ["--flip-v"] * file.flip_v + ["--allow-outside"] * file.allow_outside
    named = {"parts": file.parts, "hide": file.hide}
    chosen = {name: ",".join(names) for name, names in named.items() if names}
    words += [f"--{name} {shlex.quote(names)}" for name, names in chosen.items()]
    called = [repr(file.path)] if file.path else []
    called += [f"{name}={value!r}" for name, value in given.items()]
    called += ["flip_v=True"] * file.flip_v + ["allow_outside=True"] * file.allow_outside
    selected = ", ".join(f"{name}={names!r}" for name, names in chosen.items())
    select = f".select({selected})" if selected else ""
    return {
        "shell": " ".join(words),
        "maps": options,
        "python": f"fr.load_mesh({', '.join(called)}){select}",
    }


def _deflated(value: Any) -> bytes:
    return zlib.compress(json.dumps(value).encode(), 9)


def _json(name: str, value: Any) -> str:
    text = json.dumps(value, separators=(",", ":")).replace("</", "<\\/")
    return f'<script type="application/json" id="{escape(name)}">{text}</script>\n'


def _bytes(name: str, content: bytes) -> str:
    return f'<script type="text/plain" id="{escape(name)}">{b64encode(content).decode()}</script>\n'
