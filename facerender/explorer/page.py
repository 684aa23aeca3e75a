"""Builds the explorer's page: scripts, and their data (mesh, maps, GLSL, registry, ranges)."""

from __future__ import annotations

import json
import shlex
import zlib
from base64 import b64encode
from collections.abc import Mapping
from html import escape
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from facerender import __version__
from facerender.explorer.mesh import drawable, encoded, packed
from facerender.glsl.code import call
from facerender.glsl.library import TARGETS, shader_dir, shader_source, term_source
from facerender.job import Job
from facerender.page.document import document
from facerender.scenes.camera import AZIMUTHS_BY_NAME, Camera
from facerender.scenes.file import part_text
from facerender.scenes.framing import region_of
from facerender.scenes.light import LIGHT_KINDS, Light
from facerender.scenes.material import Material
from facerender.scenes.mesh import Mesh
from facerender.scenes.view import FRAMING_MARGIN
from facerender.shading import SMALL_SLOPE, Term
from facerender.terms import FRESNEL, LOBES, MASKING, MODELS, AnyLobe, GPower, lobe_entry
from facerender.terms.lobe import MIN_SLOPE, Lobe
from facerender.terms.ranges import EXPOSURES, Range, range_of, ranges_of

_BROWSER = Path(__file__).parent / "browser"
_SCRIPTS = (
    *("numbers", "data", "camera", "glsl", "gl", "drawing", "errors", "state", "controls"),
    *("lobe", "cost", "code", "explorer"),
)
_SHADERS = ("level.frag", "error.glsl", "error.frag", "show.frag", "lobe.frag")
_HOST = ("shade.frag", "gbuffer.frag", "surface.vert", "screen.vert")
_CAMERA = ("azimuth", "elevation", "zoom", "fov")
_G_POWER = GPower(8, 0.25, 0.5)  # placeholders: the page replaces these numbers


def explorer_page(job: Job, mesh: Mesh) -> str:
    """Return the page as HTML.

    Features that the page cannot draw are removed, see :func:`drawable`. Maps with more than 2048
    texels per side are reduced.

    Parameters
    ----------
    job : job whose mesh file, lights, ambient light, background and camera the page shows first
    mesh : mesh of the job

    Raises
    ------
    InputError : a map is damaged
    """
    region = region_of(mesh, Camera.frame)
    mesh = drawable(mesh)
    mesh_facts, arrays, textures = packed(mesh)
    facts = {
        "version": __version__,
        "name": mesh.name,
        "mesh": _words(job),
        "center": mesh.center.tolist(),
        "radius": mesh.radius,
        "target": np.zeros(3).tolist() if region is None else region.center.tolist(),
        "profile": (region or mesh).profile.round(5).tolist(),
        "framing_margin": FRAMING_MARGIN,
        **mesh_facts,
        "camera": {name: getattr(job.camera, name) for name in _CAMERA},
        "cameras": AZIMUTHS_BY_NAME,
        "lights": [_light(light, mesh) for light in job.lights],
        "ambient": job.ambient,
        "background": job.background or (0.0, 0.0, 0.0),
        "registry": registry(),
        "ranges": _ranges(),
        "targets": TARGETS,
    }
    sources = zlib.compress(json.dumps(_sources()).encode(), 9)
    data = [
        _json("facts", facts),
        _bytes("geometry", arrays),
        _bytes("sources", sources),
        *(_bytes(f"map-{i}", encoded(*each)) for i, each in enumerate(textures)),
    ]
    body = _text("explorer.html") + "".join(data)
    files = [_BROWSER / "explorer.css", *(_BROWSER / f"{name}.js" for name in _SCRIPTS)]
    return document(f"facerender explorer: {mesh.name}", body, *files)


def registry() -> dict[str, Any]:
    """Return every model, lobe, Fresnel and masking term, as data for the page's controls."""
    return {
        "models": {
            model.name: {"title": model.title, "k": model.k, "factors": model.factors}
            for model in MODELS.values()
        },
        "lobes": {lobe.name: _lobe(lobe) for lobe in LOBES.values()},
        "g_power": _lobe(lobe_entry(_G_POWER)),
        "fresnel": [*FRESNEL],
        "masking": [*MASKING],
        "small_slope": SMALL_SLOPE,
    }


def _lobe(lobe: Lobe) -> dict[str, Any]:
    return {
        "ends": lobe.ends,
        "open": lobe.open_ends,
        "errors": lobe.errors,
        "by_angle": lobe.of_tan2 is not None,
    }


def _ranges() -> dict[str, Any]:
    """Return the ranges of the numbers that the page changes, as [low, high]."""

    def pair(limits: Range) -> list[float]:
        return [limits.low, limits.high]

    light = ("azimuth", "elevation", "radius", "irradiance")
    term = {name: range_of(Material, name) for name in ("m", "f0", "ks")}
    return {
        "term": {name: pair(each) for name, each in (term | dict(ranges_of(GPower))).items()},
        "camera": {name: pair(range_of(Camera, name)) for name in _CAMERA},
        "light": {name: pair(range_of(Light, name)) for name in light},
        "exposure": pair(EXPOSURES),
    }


def _sources() -> dict[str, Any]:
    """Return the GLSL sources of the page's programs, keyed by role.

    A term is stored as its function call and the indices of its lines in ``lines``; the #version
    line is left out.
    """
    host = shader_dir() / "host"
    lines: dict[str, int] = {}
    terms = {}
    for name, (term, smallest) in _terms().items():
        text = term_source(term, smallest, "330").rstrip("\n").split("\n")[1:]
        numbers = [lines.setdefault(line, len(lines)) for line in text]
        terms[name] = {"lines": numbers, "call": call(term)}
    return {
        "lines": [*lines],
        "terms": terms,
        "variance": shader_source("slope_variance"),
        "host": {name: shader_source(str(host / name)) for name in _HOST},
        "lights": {kind: shader_source(str(host / f"light/{kind}.glsl")) for kind in LIGHT_KINDS},
        "page": {name: _text(name) for name in _SHADERS},
    }


def _terms() -> dict[str, tuple[Term, float]]:
    """Return every term and the smallest m that its GLSL supports, keyed by the term's names,
    such as "ward exact"."""
    lobes: dict[str, AnyLobe] = {name: name for name in LOBES} | {"g-power": _G_POWER}
    terms = {}
    for model, (name, lobe) in product(MODELS.values(), lobes.items()):
        slopes = {"": MIN_SLOPE}
        if lobe_entry(lobe).of_tan2:
            slopes["plain"] = SMALL_SLOPE
        factors = product(FRESNEL, MASKING) if model.factors else [("", "")]
        for (fresnel, masking), (suffix, smallest) in product(factors, slopes.items()):
            words = filter(None, [model.name, name, fresnel, masking, suffix])
            term = Term(model.name, lobe, fresnel or Term.fresnel, masking or Term.masking)
            terms[" ".join(words)] = (term, smallest)
    return terms


def _light(light: Light, mesh: Mesh) -> dict[str, Any]:
    """Return a light as data, with its direction from the mesh's centre.

    The data of a point light include the light's distance from the centre, in the renderer's space.
    """
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
    """Return the mesh's files as command-line and Python arguments."""
    file = job.mesh
    files = ("albedo", "normal_map", "specular_map", "roughness_map")
    maps = {name: value for name in files if (value := getattr(file, name)) is not None}
    names = ("flip_v", "allow_outside", "as_is", "double_sided")
    switches = [name for name in names if getattr(file, name)]
    parts = {"parts": file.parts, "hide": file.hide}
    selected = {name: ",".join(values) for name, values in parts.items() if values}
    path = [file.path] if file.path else []

    def options(values: Mapping[str, str]) -> dict[str, str]:
        return {
            name: f"--{name.replace('_', '-')} {shlex.quote(value)}"
            for name, value in values.items()
        }

    def keywords(values: Mapping[str, Any]) -> list[str]:
        return [f"{name}={value!r}" for name, value in values.items()]

    flags = [f"--{name.replace('_', '-')}" for name in switches]
    arguments = [*map(repr, path), *keywords(maps | dict.fromkeys(switches, True))]
    select = f".select({', '.join(keywords(selected))})" if selected else ""
    materials = [f"--part {shlex.quote(part_text(*each))}" for each in job.parts.items()]
    for name, table in job.parts.items():
        select += f".with_material({', '.join([repr(name), *keywords(table)])})"
    return {
        "shell": " ".join(
            [*map(shlex.quote, path), *flags, *options(selected).values(), *materials]
        ),
        "maps": options(maps),
        "python": f"fr.load_mesh({', '.join(arguments)}){select}",
    }


def _text(name: str) -> str:
    return (_BROWSER / name).read_text(encoding="utf-8")


def _json(name: str, value: Any) -> str:
    text = json.dumps(value, separators=(",", ":")).replace("</", "<\\/")
    return f'<script type="application/json" id="{escape(name)}">{text}</script>\n'


def _bytes(name: str, content: bytes) -> str:
    return f'<script type="text/plain" id="{escape(name)}">{b64encode(content).decode()}</script>\n'
